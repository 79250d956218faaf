"""Small scales: their spectra, and how they can be varied; figures 2 and 14."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.paper.item import Item, Number, picture_of
from fits.paper.patches import disc, draw_patches
from fits.paper.sources import Layer, Sources, listed
from fits.plots import COLORS, COLUMN, draw_panels, draw_spectra
from fits.record import with_error
from jaxsky.harmonics import (
    analysis,
    expand,
    gaussian_beam,
    lmax_of,
    power_spectrum,
    synthesis,
)
from jaxsky.keys import stream
from jaxsky.settings import Experiment
from jaxsky.small_scales import DUST, SYNCHROTRON, SmallScales, continue_templates
from jaxsky.templates import polarization_template

NAMES = ("synchrotron", "dust")
#: The paper's ranges and the slopes it finds, EE and BB.
RANGES = {"synchrotron": SYNCHROTRON, "dust": DUST}
SLOPES = {
    "synchrotron": ("-1.7 ± 0.04", "-1.4 ± 0.05"),
    "dust": ("-2.36 ± 0.005", "-2.16 ± 0.007"),
}
#: By how much the steeper spectrum is steeper; the paper does not say.
TILT = -1.0
#: Size of the patch [deg].
SIZE = 5.0


def _numbers(sources: Sources) -> tuple[Number, ...]:
    """Slopes of the power laws."""
    numbers = []
    for name in NAMES:
        layer, (part,) = sources.template(name), sources.continued(name).parts
        for i, kind in enumerate(("EE", "BB")):
            slope, error = (
                float(x) for x in (part.laws[i].slope, jnp.sqrt(part.laws[i].covariance[1, 1]))
            )
            used, paper = getattr(layer.small, kind), getattr(RANGES[name], kind)
            note = f"l = {used[0]} to {used[1]}"
            note += "" if used == paper else f"; the paper: {paper[0]} to {paper[1]}"
            ours = with_error(slope, error)
            numbers.append(Number(f"slope of {name} {kind}", SLOPES[name][i], ours, note))
    return tuple(numbers)


def _ranges(sources: Sources) -> str:
    """What is to be said about the ranges of the fits."""
    layers = [sources.template(name) for name in NAMES]
    if any(layer.clipped for layer in layers):
        return (
            "The templates end at "
            + listed(f"l = {2 * n}" for n in sorted({layer.nside for layer in layers}))
            + ", so that fits which the paper makes beyond are made at lower multipoles."
        )
    paper = [(RANGES[name].EE, RANGES[name].BB) for name in NAMES]
    if [(layer.small.EE, layer.small.BB) for layer in layers] == paper:
        return "The fits have the paper's ranges of multipoles."
    if sources.embedded:
        return (
            "The fits are at higher multipoles than the paper's: below, the model's smooth disc "
            "outshines its turbulence, and its spectra are no power laws."
        )
    return "The fits have other ranges of multipoles than the paper's, as the settings say."


def figure_spectra(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 2: EE of both templates, of what continues them, and of both together."""
    fwhm, picture = settings.paper.fwhm, picture_of("Figure 2")
    with draw_panels(out / picture, "", (COLUMN, 5.2), 2, sharex=True) as panels:
        for axes, name in zip(panels[:, 0], NAMES, strict=True):
            layer, continued = sources.template(name), sources.continued(name)
            (alm,), (part,) = continued.alms, continued.parts
            (start, join), lmax = layer.small.EE, lmax_of(alm)
            ell = np.arange(lmax + 1)
            original = power_spectrum(analysis(layer.maps, part.measured.shape[-1] - 1))[0]
            law = np.where(ell < start, np.nan, part.target[0])
            final = np.asarray(power_spectrum(alm[:1])[0] * gaussian_beam(fwhm, lmax) ** 2)
            draw_spectra(
                axes, {f"with small scales, {fwhm:g}'": final}, "uK_RJ", color=COLORS[1], lw=0.9
            )
            draw_spectra(
                axes, {f"template, {layer.fwhm:g}'": original}, "uK_RJ", color=COLORS[2], lw=1.8
            )
            draw_spectra(
                axes, {"power law, no beam": law}, "uK_RJ", color=COLORS[0], ls="--", lw=1.4
            )
            axes.axvline(join, color="0.4", ls=":", lw=1)
            shown = (ell * (ell + 1) * final)[2:] / (2 * np.pi)
            axes.set_ylim(shown[-1] * 1e-2, shown.max() * 2)
            axes.set_title(f"{name} $EE$, {float(layer.component.nu_ref):g} GHz")
            axes.legend(frameon=False, loc="lower left", handlelength=1.4)
        panels[0, 0].set_xlabel("")
    return Item(
        "Figure 2",
        "spectra with small scales",
        "EE spectra of synchrotron (top) and dust (bottom): of the template, of the power law "
        "that is fitted to it and extrapolated, without a beam, and of the template with small "
        f"scales, with a beam of {fwhm:g} arcmin. The dotted line is the upper end of the fit, "
        "where small scales begin.",
        f"{sources.sky_differs} {_ranges(sources)} Random maps are modulated by the polarized "
        "intensity, which does not change sign, rather than by the template.",
        picture,
        numbers=_numbers(sources),
    )


def _fine(alm: Float[Array, "2 alm"], fwhm: float, nside: int) -> Float[np.ndarray, " pix"]:
    """Q at a beam."""
    beam = gaussian_beam(fwhm, lmax_of(alm))
    return np.asarray(synthesis(alm * expand(beam), nside)[0])


def _varied(
    sources: Sources, layer: Layer, small: SmallScales, key: Array | None = None
) -> Float[Array, "2 alm"]:
    key = sources.small_scales_key("synchrotron") if key is None else key
    continued = continue_templates(key, [layer.maps], [layer.fwhm], [small], sources.nside_fine)
    return continued.alms[0]


def figure_randomised(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 14: a patch of the synchrotron, its small scales, and two others."""
    layer, nside = sources.template("synchrotron"), sources.nside_fine
    small, fwhm, center = layer.small, settings.paper.fwhm, settings.paper.center
    steeper = SmallScales(
        small.EE,
        small.BB,
        small.slope,
        small.tilt + TILT,
        small.amplitude,
        small.modulation_fwhm,
    )
    other = stream(sources.key, "other small scales", "synchrotron")
    wide = polarization_template(layer.maps, layer.fwhm, layer.fwhm, nside)
    first = sources.continued("synchrotron").alms[0]
    alms = {
        f"with small scales, {fwhm:g}'": first,
        "another realisation": _varied(sources, layer, small, other),
        f"steeper by {-TILT:g}": _varied(sources, layer, steeper),
    }
    panels = {
        f"template, {layer.fwhm / 60:.2g}°": np.asarray(wide[0]),
        **{title: _fine(alm, fwhm, nside) for title, alm in alms.items()},
    }
    template, *rest = panels
    inside = {title: disc(values, center, SIZE) for title, values in panels.items()}
    middle = float(inside[template].mean())
    rms = {title: float((inside[title] - inside[template]).std()) for title in rest}
    scale = float(np.quantile(np.abs(inside[rest[0]] - middle), 0.995)) or 1.0
    picture = picture_of("Figure 14")
    shifted = {title: (values - middle, scale, "uK_RJ") for title, values in panels.items()}
    draw_patches(out / picture, shifted, center, SIZE)
    return Item(
        "Figure 14",
        "randomised small scales",
        f"Stokes Q of the synchrotron at 30 GHz in a patch of {SIZE:g}° about (l, b) = "
        f"({center[0]:g}°, {center[1]:g}°), less the template's mean of {middle:.2f} µK: the "
        f"template, with small scales and a beam of {fwhm:g} arcmin, with another realisation of "
        f"them, and with those of the first and a spectrum steeper by {-TILT:g} beyond the join. "
        f"What is added to the template has an rms of {listed(f'{v:.2f}' for v in rms.values())} "
        "µK.",
        f"{sources.sky_differs} The paper does not say by how much its steeper spectrum is "
        "steeper.",
        picture,
    )
