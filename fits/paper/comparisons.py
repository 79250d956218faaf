"""The model against observed maps: figures 5 to 10."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fits.commands import compare_pictures as pictures
from fits.common import common_maps
from fits.comparison import Comparison, compare
from fits.full_sky import BandSpectra
from fits.inputs import Inputs, inputs_of
from fits.paper.item import Impossible, Item, Number, picture_of
from fits.paper.sources import Sources, listed
from fits.patch_comparison import compare_patches, template_patches
from fits.record import probability, with_error
from fits.regions import region_masks, region_words
from jaxsky.settings import Experiment

PLANCK, WMAP = ("30", "44", "70", "353"), ("K", "Ka", "Q", "V", "W")
#: Bands of the paper's figures 5 and 6.
SHOWN = ("30", "44", "70", "353", "K", "W")


def shared_inputs(settings: Experiment, sources: Sources) -> Inputs:
    """Templates and maps, read or drawn once."""
    galaxy = sources.galaxy if sources.embedded else None
    return sources.once("inputs", lambda: inputs_of(settings, galaxy=galaxy))


def _compared(settings: Experiment, sources: Sources) -> Comparison:
    def make() -> Comparison:
        inputs = shared_inputs(settings, sources)
        prepared = common_maps(inputs, settings.common.nside, settings.common.fwhm)
        return compare(settings, prepared, region_masks(settings, settings.compare.regions))

    return sources.once("comparison", make)


def _chosen(comparison: Comparison, wanted: Sequence[str]) -> list[str]:
    """The wanted bands; all that there are if one of those is missing."""
    bands = list(comparison.prepared.bands)
    return list(wanted) if set(wanted) <= set(bands) else bands


def _region(comparison: Comparison) -> str:
    """The paper's strip along the plane, where it is asked for."""
    return "strip" if "strip" in comparison.regions else next(iter(comparison.regions))


def _beam(settings: Experiment) -> str:
    fwhm = settings.common.fwhm
    return f"smoothed to {fwhm:g} arcmin" if fwhm else "averaged, not smoothed"


def _set_up(settings: Experiment, bands: Sequence[str], wanted: Sequence[str]) -> str:
    """What of the comparison is not as in the paper, in a sentence; or nothing."""
    common, found = settings.common, []
    if set(wanted) - set(bands):
        found.append(f"the bands are {listed(bands)}")
    if common.nside != 64:
        found.append(f"nside is {common.nside} rather than 64")
    if common.fwhm != 60:
        found.append(f"maps are {_beam(settings)} (the paper: to 60 arcmin)")
    return f"Here, {listed(found)}." if found else ""


def _differs(sources: Sources, *more: str) -> str:
    if sources.simulated:
        first = (
            "The observed maps are simulated from the model, with CMB and noise: what differs is "
            "chance."
        )
    else:
        first = sources.sky_differs
    return " ".join(filter(None, (first, *more)))


def figure_scatter(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 5: observed against modelled pixels along the plane."""
    found, picture = _compared(settings, sources), picture_of("Figure 5")
    bands, region = _chosen(found, SHOWN), _region(found)
    pictures.plot_scatter(out / picture, found, region, bands, settings.title)
    numbers = []
    for band in bands:
        scatter = found.scatter(band, region, "QU")
        numbers.append(
            Number(
                f"slope, {band}, Q and U",
                "1 by eye",
                with_error(scatter.slope, scatter.error),
                f"r = {scatter.correlation:.3f}, PTE {scatter.pte_text}",
            )
        )
    return Item(
        "Figure 5",
        "observed and modelled pixels",
        f"Pixels of nside {settings.common.nside} in {region_words(settings, region)}, "
        f"{_beam(settings)}: Q in the upper row of each pair, U in the lower. "
        "Slopes have the errors of noise and CMB; PTE is the probability that these alone "
        "leave larger differences.",
        _differs(
            sources,
            _set_up(settings, bands, SHOWN),
            "Slopes, errors and probabilities are added; the paper shows the points and the line.",
        ),
        picture,
        numbers=tuple(numbers),
    )


def figure_maps(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 6: observed maps beside the model."""
    found, picture = _compared(settings, sources), picture_of("Figure 6")
    nside = min(settings.compare.panel_nside, settings.common.nside)
    pictures.plot_model_maps(
        out / picture, found, "QU", _chosen(found, SHOWN), nside, settings.title
    )
    return Item(
        "Figure 6",
        "observed maps and the model",
        f"Q (left) and U (right), observed and modelled, averaged to nside {nside}, each pair in "
        "one scale of colours.",
        _differs(
            sources,
            _set_up(settings, list(found.prepared.bands), SHOWN),
            "Colours are linear up to a tenth of the scale and logarithmic beyond.",
        ),
        picture,
    )


def _spectra(
    settings: Experiment, sources: Sources, out: Path, label: str, wanted: Sequence[str]
) -> Item:
    found, picture = _compared(settings, sources), picture_of(label)
    spectra = [s for s in found.spectra if s.band in wanted]
    if not found.spectra:
        raise Impossible("Spectra of the full sky take maps without missing pixels.")
    if not spectra:
        raise Impossible(f"None of the bands {', '.join(wanted)} is there.")
    pictures.plot_full_sky(out / picture, spectra, settings.title)
    name, (what, paper) = (
        ("Planck", ("70", "10 %")) if wanted is PLANCK else ("WMAP", ("V", "23 %"))
    )
    numbers = [_probabilities(s) for s in spectra]
    numbers += [
        Number(
            f"largest error of a spectrum, {s.band}",
            paper,
            f"EE {100 * s.largest_error[0]:.0f} %, BB {100 * s.largest_error[1]:.0f} %",
        )
        for s in spectra
        if s.band == what
    ]
    return Item(
        label,
        f"spectra of the full sky, {name}",
        f"EE (left) and BB (right) to l = {settings.compare.lmax}: observed with the paper's error "
        "of CMB and noise, and the complete model with one realisation of each. The chi2 of the "
        f"bins is that among {settings.compare.nsims} realisations of the complete model.",
        _differs(
            sources,
            _spectra_set_up(settings, [s.band for s in spectra], wanted),
            "The shaded error is the paper's; the probabilities count the chance correlation of "
            "foregrounds with CMB and noise as well, which it leaves out.",
        ),
        picture,
        numbers=tuple(numbers),
    )


def _spectra_set_up(settings: Experiment, bands: Sequence[str], wanted: Sequence[str]) -> str:
    nside, lmax, r = settings.common.nside, settings.compare.lmax, settings.cmb.r
    found = [f"the spectra are of maps of nside {nside} rather than 256"]
    if set(wanted) - set(bands):
        found.append(f"the bands are {listed(bands)}")
    if settings.common.fwhm != 60:
        found.append(f"maps are {_beam(settings)} (the paper: to 60 arcmin)")
    if lmax != 100:
        found.append(f"they end at l = {lmax} rather than 100")
    if not settings.cmb.include or r != 0.1:
        found.append(f"r is {r:g} rather than 0.1" if settings.cmb.include else "there is no CMB")
    return f"Here, {listed(found)}."


def _probabilities(spectra: BandSpectra) -> Number:
    EE, BB = (probability(p) for p in spectra.pte)
    return Number(f"PTE of the spectra, {spectra.band}", "not given", f"EE {EE}, BB {BB}")


def figure_planck(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 7: spectra of the Planck bands."""
    return _spectra(settings, sources, out, "Figure 7", PLANCK)


def figure_wmap(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 8: spectra of the WMAP bands."""
    return _spectra(settings, sources, out, "Figure 8", WMAP)


def figure_leakage(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 9: BB at 70 GHz before and after leakage is subtracted."""
    found, picture = _compared(settings, sources), picture_of("Figure 9")
    leaky = [s for s in found.spectra if s.uncorrected is not None]
    if not leaky:
        raise Impossible("No band has a map of leakage to subtract.")
    pictures.plot_leakage(out / picture, leaky, settings.title)
    differs = _differs(sources)
    if sources.simulated:
        fractions = listed(
            f"{100 * fraction:g} % of the intensity at {name} GHz leaks along the meridians of the "
            "ecliptic"
            for name, fraction in settings.simulate.leakage.items()
        )
        differs = (
            f"The leakage is simulated: {fractions}. Its correction is exact, where Planck's takes "
            "noise away as well, so the high multipoles do not change."
        )
    return Item(
        "Figure 9",
        "before and after leakage is subtracted",
        "BB of the full sky before and after the correction, with noise and the foregrounds of the "
        "model. PTE: probability of bins as far from the complete model.",
        differs,
        picture,
        numbers=tuple(
            Number(
                f"PTE of BB, {s.band}",
                "not given",
                f"before {probability(s.pte_uncorrected[1])}, after {probability(s.pte[1])}",
            )
            for s in leaky
            if s.pte_uncorrected is not None
        ),
    )


def figure_patches(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 10: power laws on small patches."""
    picture = picture_of("Figure 10")
    if settings.compare.patches is None:
        return _template_patches(settings, sources, out, picture)
    found = compare_patches(settings, shared_inputs(settings, sources))
    pictures.plot_patches(out / picture, found, settings.title)
    numbers = []
    for i, name in enumerate(("EE", "BB")):
        A, alpha = found.correlation(i)
        numbers += [
            Number(f"A observed / model, {name}", "near 1 by eye", with_error(*found.ratio(i)),
                   f"correlation {A:.2f}"),
            Number(f"alpha observed - model, {name}", "above 0 by eye",
                   with_error(*found.slope_difference(i)), f"correlation {alpha:.2f}"),
        ]  # fmt: skip
    return Item(
        "Figure 10",
        "small patches",
        f"D_l = A (l/80)^(alpha+2) at l = 40 to 100 on discs of 400 square degrees and the field "
        f"of BICEP2, {found.band} GHz: those where A is twice its error in both.",
        _differs(
            sources,
            "The paper draws a line through log C_l of maps with their noise; here noise is "
            "subtracted and A and alpha are fitted with the variance of few modes, alpha with a "
            "prior of -2.4 +- 3. The 48 discs lie on pixels of nside 4 (nside 8, which the paper "
            "names, has 224 there); errors are drawn, and patches lost in noise left out.",
        ),
        picture,
        numbers=tuple(numbers),
    )  # fmt: skip


def _template_patches(settings: Experiment, sources: Sources, out: Path, picture: str) -> Item:
    layer = sources.template("dust")
    found = template_patches(layer.maps, layer.fwhm)
    pictures.plot_template_patches(out / picture, found, settings.title)
    both = found.detected.all(axis=1)
    ratio = np.median(found.A[both, 1] / found.A[both, 0])
    slopes = np.median(found.alpha[both], axis=0)
    return Item(
        "Figure 10",
        "small patches of the dust template",
        "D_l = A (l/80)^(alpha+2) at l = 40 to 100 on discs of 400 square degrees and the field of "
        "BICEP2, in the dust template itself: BB against EE.",
        f"{sources.sky_differs} There is no map at 353 GHz to compare with.",
        picture,
        numbers=(
            Number("median A of BB / EE", "not given", f"{ratio:.2f}"),
            Number("median alpha, EE, BB", "not given",
                   ", ".join(f"{slope:.2f}" for slope in slopes)),
        ),
    )  # fmt: skip
