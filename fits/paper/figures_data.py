"""The paper's figures of observed maps against the model: pixels, spectra, patches, indices."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fits.commands import compare as pictures
from fits.commands.fit import plot_grids
from fits.common import prepared_maps
from fits.comparison import Comparison
from fits.discs import compare_patches, template_patches
from fits.paper.sky import TEXTS, Impossible, Number, PaperFigure, PaperSky, filled
from fits.regions import region_masks, region_words
from fits.results import probability, with_error, with_errors
from fits.spectral_index import fit_regions, known_truth
from jaxsky.checks import listed
from jaxsky.settings import SettingsError

#: Spectra by experiment: figure, bands, and the band whose largest error the paper gives.
FULL_SKY = {
    "Planck": ("Figure 7", ("30", "44", "70", "353"), "70"),
    "WMAP": ("Figure 8", ("K", "Ka", "Q", "V", "W"), "V"),
}
#: Bands of the paper's figures 5 and 6, and of figure 11.
SHOWN, FITTED = ("30", "44", "70", "353", "K", "W"), ("44", "70")


def _chosen(comparison: Comparison) -> list[str]:
    """Return the bands of the paper, or all bands if one of those is missing."""
    bands = list(comparison.prepared.bands)
    return list(SHOWN) if set(SHOWN) <= set(bands) else bands


def _beam(paper: PaperSky) -> str:
    fwhm = paper.settings.common.fwhm
    return f"smoothed to {fwhm:g} arcmin" if fwhm else "averaged, not smoothed"


def _here(
    paper: PaperSky, nside: str, bands: Sequence[str], wanted: Sequence[str], *more: str
) -> str:
    """Return a sentence on how the comparison differs from the paper's, "" if it does not."""
    others = f"the bands are {listed(bands)}" if set(wanted) - set(bands) else ""
    wide = paper.settings.common.fwhm != 60
    beam = f"maps are {_beam(paper)} (the paper: to 60 arcmin)" if wide else ""
    found = [words for words in (nside, others, beam, *more) if words]
    return f"Here, {listed(found)}." if found else ""


def _pixels_here(paper: PaperSky) -> str:
    nside, bands = paper.settings.common.nside, list(paper.comparison.prepared.bands)
    return _here(paper, f"nside is {nside} rather than 64" * (nside != 64), bands, SHOWN)


def figure_scatter(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 5: observed against modelled pixels along the plane."""
    settings, found = paper.settings, paper.comparison
    bands = _chosen(found)
    region = "strip" if "strip" in found.regions else next(iter(found.regions))
    pictures.plot_scatter(picture, found, region, bands, settings.title)
    numbers = []
    for band in bands:
        scatter = found.scatters[band, region, "QU"]
        slope = with_error(scatter.slope, scatter.error)
        note = f"r = {scatter.correlation:.3f}, PTE {scatter.pte_text}"
        numbers.append(Number(f"slope, {band}, Q and U", slope, note))
    where, beam = region_words(settings, region), _beam(paper)
    return paper.described("Figure 5", numbers, here=_pixels_here(paper), region=where, beam=beam)


def figure_maps(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 6: observed maps next to the model."""
    settings, found = paper.settings, paper.comparison
    nside = min(pictures.NSIDE, settings.common.nside)
    pictures.plot_model_maps(picture, found, "QU", _chosen(found), settings.title)
    return paper.described("Figure 6", nside=nside, here=_pixels_here(paper))


def figure_full_sky(experiment: str, paper: PaperSky, picture: Path) -> PaperFigure:
    """Figures 7 and 8: spectra of Planck's or WMAP's bands."""
    label, wanted, largest = FULL_SKY[experiment]
    settings, found = paper.settings, paper.comparison
    spectra = [s for s in found.spectra if s.band in wanted]
    if not found.spectra:
        raise Impossible("Spectra of the full sky take maps without missing pixels.")
    if not spectra:
        raise Impossible(f"None of the bands {', '.join(wanted)} is there.")
    pictures.plot_full_sky(picture, spectra, settings.title)
    numbers = []
    for s in spectra:
        EE, BB = map(probability, s.pte)
        numbers.append(Number(f"PTE of the spectra, {s.band}", f"EE {EE}, BB {BB}"))
    for s in (s for s in spectra if s.band == largest):
        EE, BB = (f"{100 * error:.0f} %" for error in s.largest_error)
        numbers.append(Number(f"largest error of a spectrum, {s.band}", f"EE {EE}, BB {BB}"))
    nside, lmax, r = settings.common.nside, settings.compare.lmax, settings.cmb.r
    end = f"they end at l = {lmax} rather than 100" * (lmax != 100)
    cmb = f"r is {r:g} rather than 0.1" * (r != 0.1) if settings.cmb.include else "there is no CMB"
    first = f"the spectra are of maps of nside {nside} rather than 256"
    here = _here(paper, first, [s.band for s in spectra], wanted, end, cmb)
    return paper.described(
        label, numbers, texts="Figures 7 and 8", experiment=experiment, here=here
    )


def figure_leakage(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 9: BB at 70 GHz before and after leakage is subtracted."""
    settings, texts, numbers = paper.settings, TEXTS["Figure 9"], []
    leaky = [s for s in paper.comparison.spectra if s.uncorrected is not None]
    if not leaky:
        raise Impossible("No band has a map of leakage to subtract.")
    pictures.plot_leakage(picture, leaky, settings.title)
    for s in leaky:
        if s.pte_uncorrected is not None:
            before, after = probability(s.pte_uncorrected[1]), probability(s.pte[1])
            numbers.append(Number(f"PTE of BB, {s.band}", f"before {before}, after {after}"))
    leakage = paper.differs
    if paper.simulated:
        fractions = listed(
            filled(texts["fraction"], percent=100 * band.leakage, name=band.name)
            for band in settings.bands
            if isinstance(band.leakage, float)
        )
        leakage = filled(texts["simulated"], fractions=fractions)
    return paper.described("Figure 9", numbers, leakage=leakage)


def figure_patches(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 10: power laws on small patches."""
    settings, numbers = paper.settings, []
    if settings.compare.patches is None:
        return _template_patches(paper, picture)
    found = compare_patches(settings, paper.inputs)
    if not pictures.plot_patches(picture, found, settings.title):
        raise Impossible(f"None of the patches is detected in band {found.band}.")
    for i, name in enumerate(("EE", "BB")):
        A, alpha = found.correlation(i)
        ratio, difference = with_error(*found.ratio(i)), with_error(*found.slope_difference(i))
        numbers += [
            Number(f"A observed / model, {name}", ratio, f"correlation {A:.2f}"),
            Number(f"alpha observed - model, {name}", difference, f"correlation {alpha:.2f}"),
        ]
    return paper.described("Figure 10", numbers, band=found.band)


def _template_patches(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 10 without a band to compare with: BB against EE of the dust."""
    dust = paper.template("dust")
    found = template_patches(dust.maps, dust.fwhm)
    both = found.detected.all(axis=1)
    slopes = ", ".join(f"{slope:.2f}" for slope in np.median(found.alpha[both], axis=0))
    ratio = f"{np.median(found.A[both, 1] / found.A[both, 0]):.2f}"
    heads = f"median BB / EE: {ratio}", f"median of EE, BB: {slopes}"
    pictures.plot_template_patches(picture, found, heads, paper.settings.title)
    numbers = [Number("median A of BB / EE", ratio), Number("median alpha, EE, BB", slopes)]
    return paper.described("Figure 10", numbers, texts="Figure 10 of the template")


def figure_probability(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 11: the probability of beta_dust and beta_syn on a grid, from Q and from U."""
    settings, inputs = paper.settings, paper.inputs
    bands = {name: inputs.bands[name] for name in FITTED if name in inputs.bands} or inputs.bands
    if len(settings.free_in("fit")) != 2:
        raise Impossible("A grid takes two free parameters, in the table `free`.")
    spec = settings.fit.model_copy(
        update={"methods": ["grid"], "stokes": ["Q", "U", "QU"], "regions": ["strip", "full"]}
    )
    chosen = settings.model_copy(update={"fit": spec})
    prepared = prepared_maps(settings, inputs._replace(bands=bands))
    try:
        fits = fit_regions(chosen, prepared, region_masks(chosen, spec.regions))
    except SettingsError as error:
        raise Impossible(str(error)) from None
    plot_grids(picture, fits, known_truth(inputs, fits), settings.title)
    truth = inputs.truth or {}
    grids = {f.region: f.results["grid"] for f in fits if f.stokes == "QU"}
    numbers = [
        Number(
            f"{name}, {region}, Q and U",
            with_errors(grid.best_fit[name], *grid.interval_68[name]),
            f"truth {truth[name]:g}" if name in truth else "",
        )
        for region, grid in grids.items()
        for name in grid.free
    ]
    maps = TEXTS["Figure 11"]["simulated"] if paper.simulated else paper.differs
    region = region_words(settings, "strip")
    return paper.described("Figure 11", numbers, bands=listed(bands), region=region, maps=maps)
