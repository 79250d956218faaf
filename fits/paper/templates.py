"""Templates, maps of indices, and AME: figures 1, 3 and 4."""

from collections.abc import Mapping
from pathlib import Path

import healpy
import jax.numpy as jnp
import numpy as np

from fits.paper.indices import STEEPENING, SYMBOLS, Index
from fits.paper.item import Item, Number, picture_of
from fits.paper.sources import NSIDE, Sources
from fits.plots import UNITS, MapPanel, color_limit, plot_maps
from fits.record import with_error
from jaxsky.presets import preset
from jaxsky.settings import Experiment
from jaxsky.templates import coarse_pixels, correlation, polarization_template, steepening

#: The paper's correlations of dust and AME.
CORRELATIONS = {"Q": "0.71 ± 0.01", "U": "0.73 ± 0.01"}
#: Blocks of the honest jackknife: pixels of 15 degrees.
NSIDE_BLOCKS = 4


def _draw(path: Path, panels: Mapping[str, tuple[np.ndarray, str, float | None]]) -> None:
    """Maps below each other: title, values, label of the colours, and their middle or None."""
    rows = [
        [MapPanel(title, values, color_limit(values - (middle or 0.0)), label, middle)]
        for title, (values, label, middle) in panels.items()
    ]
    plot_maps(path, rows)


def figure_templates(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 1: Q of both templates."""
    panels, beams = {}, {}
    for name in ("dust", "synchrotron"):
        layer = sources.template(name)
        nu, beams[name] = float(layer.component.nu_ref), layer.fwhm
        title = f"{name}, $Q$, {nu:g} GHz"
        panels[title] = np.asarray(layer.maps[0]), UNITS["uK_RJ"], None
    picture = picture_of("Figure 1")
    _draw(out / picture, panels)
    return Item(
        "Figure 1",
        "templates",
        "Stokes Q of the templates of thermal dust (top) and synchrotron (bottom) at their "
        f"reference frequencies, with beams of {beams['dust']:g} and {beams['synchrotron']:g} "
        "arcmin. "
        "Colours are linear up to a tenth of the scale and logarithmic beyond.",
        sources.sky_differs,
        picture,
    )


def figure_indices(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 3: maps of both spectral indices."""
    panels, origins, numbers = {}, [], []
    paper = {"beta_dust": ("1.53", "not given"), "beta_syn": ("2.9", "0.1")}
    for name, word, symbol in (
        ("beta_dust", "dust", "d"),
        ("beta_syn", "synchrotron", "s"),
    ):
        index = sources.index(name)
        values = np.asarray(index.values)
        mean, spread = float(values.mean()), float(values.std())
        title = f"{word}, {index.fwhm / 60:g}° beam"
        panels[title] = values, rf"$\beta_{{\rm {symbol}}}$", round(mean, 2)
        origins.append(index.origin)
        note = "by construction" if index.steepening is None else ""
        numbers += [
            Number(f"mean of {SYMBOLS[name]}", paper[name][0], f"{mean:.3f}", note),
            Number(
                f"scatter of {SYMBOLS[name]}",
                paper[name][1],
                f"{spread:.3f}",
                note,
            ),
        ]
    numbers.append(_steepening(sources.index("beta_syn")))
    picture = picture_of("Figure 3")
    _draw(out / picture, panels)
    return Item(
        "Figure 3",
        "spectral indices",
        "Spectral index of the thermal dust (top) and of the synchrotron (bottom), for which "
        "antenna temperature falls as frequency to the power of it. Colours are linear about the "
        "mean.",
        f"Here, {' and '.join(origins)}. The paper has Commander's index of the dust and that of "
        "Giardino et al. (2002), made steeper by 0.13.",
        picture,
        numbers=tuple(numbers),
    )


def _steepening(index: Index) -> Number:
    """How much steeper the index was made, and what a published curved law would say."""
    curved = preset("s3", np.zeros((2, 12)), beta_syn=3.0)
    nu = jnp.geomspace(0.4, 40.0, 200)
    other = float(steepening(nu, curved.sed(nu)))
    drawn = index.steepening is None
    return Number(
        "steepening of β_syn from 0.49 ... 2.12 to 20 ... 30 GHz",
        f"{STEEPENING:g}",
        f"{index.steepening:.2f}" if index.steepening else "none",
        ("the map is drawn about the paper's mean, steepening included; " if drawn else "")
        + "GALPROP's spectrum is not part of jaxsky, but is taken from a file if given; the curved "
        f"law of Kogut (2012), as in PySM's s3, gives {other:.2f}",
    )


def figure_ame(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 4: Q of AME, and its correlation with the dust."""
    ame = sources.ame()
    picture = picture_of("Figure 4")
    title = "AME, $Q$, 23 GHz, 1 % polarized"
    _draw(out / picture, {title: (np.asarray(ame.maps[0]), UNITS["uK_RJ"], None)})
    numbers = _correlations(sources)
    return Item(
        "Figure 4",
        "AME",
        f"Stokes Q of AME at 23 GHz with {ame.resolution} and a polarization "
        "fraction of 0.01: an intensity, polarized along the dust.",
        f"{sources.sky_differs} {_capital(ame.origin)}.",
        picture,
        numbers=numbers,
    )


def _correlations(sources: Sources) -> tuple[Number, ...]:
    """Pearson's correlation of dust and AME at 1 degree and nside 64, with jackknife errors."""
    ame = sources.ame()
    own = healpy.npix2nside(ame.maps.shape[-1])
    nside = min(NSIDE, own)
    maps = [
        each if nside == own else polarization_template(each, 0.0, 0.0, nside)
        for each in (ame.dust, ame.maps)
    ]
    blocks = coarse_pixels(nside, NSIDE_BLOCKS)
    numbers = []
    for stokes, x, y in zip("QU", *maps, strict=True):
        r, error = correlation(x, y)
        wide = correlation(x, y, blocks).error
        numbers.append(
            Number(
                f"correlation of dust and AME, {stokes}",
                CORRELATIONS[stokes],
                with_error(float(r), float(error)),
                f"jackknife over pixels of nside {nside}; over blocks of 15° the error is "
                f"{float(wide):.2g}",
            )
        )
    return tuple(numbers)


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
