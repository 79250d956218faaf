"""The paper's figures of the model: templates, indices, AME, small scales, B modes, and COrE."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import healpy
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fits import plots
from fits.commands.forecast import forecast, plot_b_modes
from fits.commands.report import ResultTable
from fits.paper.sky import RANGES, TEXTS, Impossible, Number, PaperFigure, PaperSky, filled
from fits.pseudo_cl import PIVOT, sky_fraction
from fits.regions import region_words, superpixels
from fits.results import with_error
from jaxsky.checks import listed
from jaxsky.experiment import cmb_spectra
from jaxsky.harmonics import analysis, expand, gaussian_beam, lmax_of, power_spectrum, synthesis
from jaxsky.interpolation import term_weights
from jaxsky.io import InputError
from jaxsky.observation import Observation, ObservedBand, Source, band_tables, load_instrument
from jaxsky.settings import BandTable, Experiment
from jaxsky.simulation import HarmonicSource, harmonic_sources, observe_bands, plan_terms
from jaxsky.small_scales import Continued
from jaxsky.templates import correlation, polarization_template, preset, steepening

#: nside of the correlation of AME with dust, and of blocks of 15 degrees for a jackknife that
#: allows for correlated pixels.
NSIDE_CORRELATION, NSIDE_BLOCKS = 64, 4
#: Change of slope for the steeper spectrum, which the paper does not give.
TILT = -1.0
#: Sizes of the patches of figures 13 and 14 [deg].
SIZE_CORE, SIZE = 30.0, 5.0
#: The paper's bands of COrE [GHz].
BANDS = ("45", "105", "315")
#: Resolution of the embedded model in a forecast, and the largest multipole.
NSIDE_FORECAST, LMAX = 128, 250
UNIT = plots.UNITS["uK_RJ"]


def figure_templates(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 1: Q of both templates."""
    rows, layers = [], {name: paper.template(name) for name in ("dust", "synchrotron")}
    for name, layer in layers.items():
        title = f"{name}, $Q$, {float(layer.component.nu_ref):g} GHz"
        rows.append([plots.MapPanel(title, np.asarray(layer.maps[0]), UNIT)])
    plots.plot_maps(picture, rows)
    return paper.described("Figure 1", layers=layers)


def figure_indices(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 3: maps of both spectral indices."""
    rows, origins, numbers, texts = [], [], [], TEXTS["Figure 3"]
    for name, word, symbol in (("beta_dust", "dust", "d"), ("beta_syn", "synchrotron", "s")):
        index, fwhm, steeper, origin = paper.index(name)
        values = np.asarray(index)
        beta, mean, spread = name.replace("beta", "β"), float(values.mean()), float(values.std())
        title, label = f"{word}, {fwhm / 60:g}° beam", rf"$\beta_{{\rm {symbol}}}$"
        rows.append([plots.MapPanel(title, values, label, round(mean, 2))])
        origins.append(f"{beta} {origin}")
        note = "by construction" if steeper is None else ""
        numbers += [
            Number(f"mean of {beta}", f"{mean:.3f}", note),
            Number(f"scatter of {beta}", f"{spread:.3f}", note),
        ]
    # How much steeper beta_syn, the last, was made, next to a published law with a curvature.
    nu, curved = jnp.geomspace(0.4, 40.0, 200), preset("s3", np.zeros((2, 12)), beta_syn=3.0)
    said = filled(texts["steepening"], curved=float(steepening(nu, curved.sed(nu))))
    note = said if steeper is not None else texts["drawn"] + said
    what = "steepening of β_syn from 0.49 ... 2.12 to 20 ... 30 GHz"
    numbers.append(Number(what, f"{steeper:.2f}" if steeper else "none", note))
    plots.plot_maps(picture, rows)
    return paper.described("Figure 3", numbers, origins=" and ".join(origins))


def figure_ame(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 4: Q of AME, and Pearson's correlation with the dust, with jackknife errors."""
    ame, dust, resolution, origin = paper.ame()
    title = "AME, $Q$, 23 GHz, 1 % polarized"
    plots.plot_maps(picture, [[plots.MapPanel(title, np.asarray(ame[0]), UNIT)]])
    own, numbers = healpy.npix2nside(ame.shape[-1]), []
    nside = min(NSIDE_CORRELATION, own)
    if nside != own:
        dust, ame = (polarization_template(each, 0.0, 0.0, nside) for each in (dust, ame))
    blocks = superpixels(nside, NSIDE_BLOCKS)
    for stokes, x, y in zip("QU", dust, ame, strict=True):
        r, error = map(float, correlation(x, y))
        wide = float(correlation(x, y, blocks).error)
        note = f"jackknife over pixels of nside {nside}; over blocks of 15° the error is {wide:.2g}"
        what = f"correlation of dust and AME, {stokes}"
        numbers.append(Number(what, with_error(r, error), note))
    return paper.described("Figure 4", numbers, origin=origin, resolution=resolution)


def figure_spectra(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 2: EE of both templates, of their power laws, and with small scales added."""
    fwhm, numbers = paper.settings.paper.fwhm, []
    with plots.draw_panels(picture, "", (plots.COLUMN, 5.2), 2, sharex=True) as panels:
        for axes, name in zip(panels[:, 0], RANGES, strict=True):
            layer, continued = paper.template(name), paper.continued(name)
            (alm,), (part,), small = continued.alms, continued.parts, layer.small_scales
            (start, join), lmax = small.EE, lmax_of(alm)
            original = analysis(layer.maps, part.measured.shape[-1] - 1)
            law = np.where(np.arange(lmax + 1) < start, np.nan, part.target[0])
            final = np.asarray(power_spectrum(alm[:1])[0] * gaussian_beam(fwhm, lmax) ** 2)
            for label, spectrum, color, lw, ls in (
                (f"with small scales, {fwhm:g}'", final, 1, 0.9, "-"),
                (f"template, {layer.fwhm:g}'", power_spectrum(original)[0], 2, 1.8, "-"),
                ("power law, no beam", law, 0, 1.4, "--"),
            ):
                style: Any = {"color": plots.COLORS[color], "lw": lw, "ls": ls}
                plots.draw_spectra(axes, {label: spectrum}, "uK_RJ", **style)
            axes.axvline(join, color="0.4", ls=":", lw=1)
            shown = plots.with_powers(final)[1]
            axes.set_ylim(shown[-1] * 1e-2, shown.max() * 2)
            axes.set_title(f"{name} $EE$, {float(layer.component.nu_ref):g} GHz")
            axes.legend(frameon=False, loc="lower left", handlelength=1.4)
            for i, kind in enumerate(("EE", "BB")):
                slope, error = part.laws[i].slope, jnp.sqrt(part.laws[i].covariance[1, 1])
                used, theirs = getattr(small, kind), getattr(RANGES[name], kind)
                note = f"l = {used[0]} to {used[1]}"
                note += "" if used == theirs else f"; the paper: {theirs[0]} to {theirs[1]}"
                ours = with_error(float(slope), float(error))
                numbers.append(Number(f"slope of {name} {kind}", ours, note))
        panels[0, 0].set_xlabel("")
    return paper.described("Figure 2", numbers, ranges=_ranges(paper))


def _ranges(paper: PaperSky) -> str:
    """Return a sentence on the ranges of the fits."""
    texts = TEXTS["Figure 2"]["ranges"]
    layers = [paper.template(name) for name in RANGES]
    used = [(one.small_scales.EE, one.small_scales.BB) for one in layers]
    if used != [(paper.small_scales[law].EE, paper.small_scales[law].BB) for law in RANGES]:
        ends = sorted({layer.nside for layer in layers})
        return filled(texts["clipped"], ends=listed(f"l = {2 * n}" for n in ends))
    if used == [(one.EE, one.BB) for one in RANGES.values()]:
        return filled(texts["paper"])
    return filled(texts["model" if paper.embedded else "other"])


def _disc(
    values: Float[np.ndarray, " pix"], center: tuple[float, float], size: float
) -> Float[np.ndarray, " inside"]:
    """Return the pixels in a disc about (l, b) of diameter `size`, all in degrees."""
    nside, vector = healpy.npix2nside(values.size), healpy.ang2vec(*center, lonlat=True)
    return values[healpy.query_disc(nside, vector, np.radians(size / 2))]


def _draw_patches(
    path: Path,
    panels: Mapping[str, tuple[Float[np.ndarray, " pix"], float, str]],
    center: tuple[float, float],
    size: float,
) -> None:
    """Draw four square patches of the sky; `panels` has map, colour limit and unit by title."""
    with plots.draw_panels(path, "", (5.4, 4.4), 2, 2) as grid:
        for axes, (title, (values, limit, unit)) in zip(grid.flat, panels.items(), strict=True):
            plots.draw_patch(axes, values, center, size, limit, plots.UNITS[unit])
            axes.set_title(title)
            axes.label_outer()


def figure_randomised(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 14: a patch of synchrotron without small scales, and with three versions of them."""
    layer, nside = paper.template("synchrotron"), paper.nside_fine
    fwhm, center = paper.settings.paper.fwhm, paper.settings.paper.center
    # Made one after the other: each takes as much memory as all the rest of the figure.
    makers: dict[str, Callable[[str], Continued]] = {
        f"with small scales, {fwhm:g}'": paper.continued,
        "another realisation": partial(paper.with_small_scales, kind="other small scales"),
        f"steeper by {-TILT:g}": partial(paper.with_small_scales, tilt=TILT),
    }
    original = polarization_template(layer.maps, layer.fwhm, layer.fwhm, nside)[0]
    panels = {f"template, {layer.fwhm / 60:.2g}°": np.asarray(original, np.float32)}
    del original
    for title, make in makers.items():
        (alm,) = make("synchrotron").alms
        beam = gaussian_beam(fwhm, lmax_of(alm))
        panels[title] = np.asarray(synthesis(alm * expand(beam), nside)[0], np.float32)
    template, *rest = [_disc(values, center, SIZE) for values in panels.values()]
    middle = float(template.mean())
    limit = plots.color_limit(rest[0] - middle, 0.995)
    shifted = {title: (values - middle, limit, "uK_RJ") for title, values in panels.items()}
    _draw_patches(picture, shifted, center, SIZE)
    rms = listed(f"{float((values - template).std()):.2f}" for values in rest)
    return paper.described("Figure 14", size=SIZE, mean=middle, steeper=-TILT, rms=rms)


def forecast_settings(paper: PaperSky) -> Experiment:
    """Return the settings of a forecast for COrE with the sky of the figures."""
    settings, lmax = paper.settings, LMAX
    sky = settings.sky
    if sky.embedded is not None:
        embedded = sky.embedded.model_copy(update={"nside": NSIDE_FORECAST})
        sky = sky.model_copy(update={"embedded": embedded})
    if not paper.embedded:
        lmax = min(LMAX, 2 * min(paper.template(name).nside for name in RANGES) - 8)
    fit = (20, min(200, lmax - 10))
    spec = settings.forecast.model_copy(update={"bands": list(BANDS), "lmax": lmax, "fit": fit})
    bands = [BandTable.model_validate(band) for band in band_tables("core")]
    cmb = settings.cmb.model_copy(update={"include": True, "file": None})
    changes = {"sky": sky, "bands": bands, "cmb": cmb, "free": {}, "forecast": spec}
    return settings.model_copy(update=changes)


def figure_b_modes(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 12: BB of the foregrounds in three bands of COrE, and of gravitational waves."""
    try:
        settings = forecast_settings(paper)
        found = forecast(settings)
    except InputError:
        raise
    except ValueError as reason:
        raise Impossible(str(reason)) from None
    plot_b_modes(picture, found, settings)
    differs, where = paper.differs, f"l = {PIVOT}"
    if paper.embedded:
        differs = filled(TEXTS["Figure 12"]["model"], nside=NSIDE_FORECAST)
    numbers = [
        Number(f"r with as much BB at {where}, {name} GHz", f"{equal[where]:.3g}")
        for name, equal in found.equal_r.items()
    ]
    region, percent = settings.forecast.region, 100 * sky_fraction(found.inputs.mask)
    words = region_words(settings, region)
    return paper.described("Figure 12", numbers, region=words, percent=percent, differs=differs)


def core_observation(paper: PaperSky) -> Observation:
    """Return three bands of COrE with its beams, or that of the small scales if it is wider."""
    fwhm = paper.settings.paper.fwhm
    channels = {
        name: ObservedBand(one.band, max(float(one.beam), fwhm), noise=one.noise)
        for name, one in load_instrument("core", BANDS).items()
    }
    return Observation(channels, paper.nside_fine, finest=fwhm, precision="single")


def prepared_templates(paper: PaperSky, observation: Observation) -> dict[str, HarmonicSource]:
    """Prepare both foregrounds, from the shared small scales if the laws of both are constant."""
    given = {name: Source(*paper.template(name)) for name in ("dust", "synchrotron")}
    terms = plan_terms(given, observation)
    constant = {name: one for name, one in terms.items() if one is not None and not one.counts}
    if len(constant) < len(terms):
        return harmonic_sources(paper.key, given, observation, terms)
    return {
        name: HarmonicSource(
            tuple(alm.astype(observation.dtype) for alm in paper.continued(name).alms),
            term_weights(given[name].component, observation.bands, one),
            0.0,
        )
        for name, one in constant.items()
    }


def figure_patch(paper: PaperSky, picture: Path) -> PaperFigure:
    """Figure 13: Q of the CMB and of three bands in a patch."""
    settings, center = paper.settings, paper.settings.paper.center
    observation = core_observation(paper)
    prepared = prepared_templates(paper, observation)
    cmb = jnp.asarray(cmb_spectra(settings, observation.lmax))
    panels, numbers = {}, []
    for name, maps in observe_bands(paper.key, prepared, observation, cmb, components=True):
        channel = observation.channels[name]
        Q = {which: np.asarray(values[0]) for which, values in maps.items()}
        inside = {which: _disc(values, center, SIZE_CORE) for which, values in Q.items()}
        numbers.append(_brightest(name, inside))
        limit, beam = plots.color_limit(inside["total"]), f"{float(channel.beam):g}'"
        panels[f"{name} GHz, {beam}"] = Q["total"], limit, "uK_RJ"
    # The CMB is that of the last band, which has the finest beam.
    to_cmb = float(channel.band.conversion("uK_RJ", "uK_CMB"))
    limit = plots.color_limit(inside["cmb"] * to_cmb)
    panels = {f"CMB, {beam}": (Q["cmb"] * to_cmb, limit, "uK_CMB"), **panels}
    _draw_patches(picture, panels, center, SIZE_CORE)
    words = f"spectra of {settings.cmb.label}" if settings.cmb.file else f"r = {settings.cmb.r:g}"
    return paper.described("Figure 13", numbers, size=SIZE_CORE, cmb=words, nside=observation.nside)


def _brightest(band: str, inside: Mapping[str, Float[np.ndarray, " inside"]]) -> Number:
    """Return what dominates a band in the patch, by its rms including the mean."""
    rms = {which: float(np.sqrt(np.mean(values**2))) for which, values in inside.items()}
    parts = [which for which in rms if which not in ("total", "noise")]
    order = sorted(parts, key=rms.__getitem__, reverse=True)
    names = ["CMB" if which == "cmb" else which for which in order]
    each = ", ".join(f"{n} {rms[which]:.2g}" for n, which in zip(names, order, strict=True))
    note = f"rms of Q [µK_RJ]: {each}, noise {rms['noise']:.2g} a pixel"
    return Number(f"brightest in the patch at {band} GHz", names[0], note)


def table_core(paper: PaperSky, picture: Path) -> PaperFigure:
    """Table 1: COrE."""
    bands = band_tables("core")
    header = ("Band [GHz]", *(f"{band['bandpass']['center']:g}" for band in bands))
    rows = [
        ("Beam FWHM [arcmin]", *(f"{band['fwhm']:.1f}" for band in bands)),
        ("Noise [µK_RJ arcmin]", *(f"{band['noise']['level']:.2f}" for band in bands)),
        ("Width [GHz]", *(f"{band['bandpass']['width']:.3g}" for band in bands)),
    ]
    return paper.described("Table 1", table=ResultTable(header, rows))
