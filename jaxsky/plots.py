"""Pictures of maps and spectra."""

import re
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import healpy
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from jaxsky.harmonics import analysis, power_spectrum
from jaxsky.io import whole

STYLE: Any = {
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 10,
    "legend.fontsize": 8,
    "figure.dpi": 150,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
#: Okabe & Ito's colours, which the colour-blind can tell apart.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#222222")
#: Bands shown on a contact sheet, and multipoles in its spectra.
SHOWN, LMAX_SHOWN = 5, 1024
#: Spectra are shown down to this fraction of the largest.
DEPTH = 1e-7
UNITS = {"uK_RJ": r"$\mu{\rm K}_{\rm RJ}$", "uK_CMB": r"$\mu{\rm K}_{\rm CMB}$"}


def plain(text: str) -> str:
    """Text that is drawn as it is: between its dollar signs there is no formula.

    Behind a thin space, as labels that begin with an underscore are left out of legends.
    """
    return ("\N{THIN SPACE}" if text.startswith("_") else "") + text.replace("$", r"\$")


def in_formula(text: str) -> str:
    """A name as upright letters of a formula, drawn as it is."""
    escaped = re.sub(r"([$%#&_{} ])", r"\\\1", re.sub(r"[\\^~]", "?", text))
    return rf"{{\rm {escaped}}}"


def draw_title(figure: plt.Figure, title: str, **options: Any) -> None:
    """Write a title above a figure as it is; what is longer than three lines is cut."""
    lines = [textwrap.fill(line, 110, max_lines=3) for line in title.splitlines()]
    figure.suptitle(plain("\n".join(lines)), **options)


def save(figure: plt.Figure, path: Path) -> None:
    """Write a figure as PNG, whole, and close it."""
    # A constrained layout fits already; cropping would draw it once more.
    box = None if figure.get_layout_engine() is not None else "tight"
    with (
        whole(path) as beside,
        plt.rc_context({"savefig.bbox": box}),
        warnings.catch_warnings(action="ignore", category=UserWarning),  # glyphs a font lacks
    ):
        figure.savefig(beside, format="png")
    plt.close(figure)


def _image(
    axes: Axes,
    pixels: np.ndarray,
    limit: float,
    label: str,
    linear: bool = False,
    middle: float = 0.0,
    **options: Any,
) -> None:
    """Values about zero with a bar of colours, linear up to a tenth of the limit, then logarithmic.

    So the Galactic plane and high latitudes show in one picture. Or linear throughout, about any
    value. The limit is rounded to one digit.
    """
    limit = float(f"{limit:.1g}")
    norm: mpl.colors.Normalize
    if linear:
        norm, between = mpl.colors.Normalize(middle - limit, middle + limit), limit / 2
    else:
        norm, between = mpl.colors.AsinhNorm(limit / 10, -limit, limit), limit / 10
    image = axes.imshow(pixels, origin="lower", cmap="RdBu_r", norm=norm, **options)
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02, extend="both")
    bar.set_ticks([middle + tick for tick in (-limit, -between, 0, between, limit)])
    bar.ax.yaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.minorticks_off()
    bar.set_label(label)


def draw_map(
    axes: Axes,
    values: Float[np.ndarray, " pix"],
    limit: float,
    label: str,
    middle: float | None = None,
) -> None:
    """A map of the full sky in Galactic coordinates, centred on l = 0, l growing to the left.

    With a middle, the colours are linear about it.
    """
    nside = healpy.npix2nside(values.size)
    projector = healpy.projector.MollweideProj(xsize=600)
    pixels = projector.projmap(np.asarray(values), lambda x, y, z: healpy.vec2pix(nside, x, y, z))
    pixels = np.ma.masked_invalid(np.where(pixels == -np.inf, np.nan, pixels))
    _image(axes, pixels, limit, label, middle is not None, middle or 0.0)
    axes.axis("off")


def draw_patch(
    axes: Axes,
    values: Float[np.ndarray, " pix"],
    center: tuple[float, float],
    size: float,
    limit: float,
    label: str,
) -> None:
    """A square patch of the sky about (l, b), all in degrees; gnomonic, l growing to the left.

    Unlike those of `draw_map`, its colours are linear, and where its pixels are finer than those
    of the map, values are interpolated between them.
    """
    nside, values = healpy.npix2nside(values.size), np.asarray(values)
    xsize = 300
    projector = healpy.projector.GnomonicProj(
        rot=(*center, 0.0), xsize=xsize, reso=size * 60 / xsize
    )
    if size * 60 / xsize < healpy.nside2resol(nside, arcmin=True):
        vectors = projector.xy2vec(projector.ij2xy())
        theta, phi = healpy.vec2ang(np.stack(vectors, axis=-1).reshape(-1, 3))
        pixels = healpy.get_interp_val(values, theta, phi).reshape(xsize, xsize)
    else:
        pixels = projector.projmap(values, lambda x, y, z: healpy.vec2pix(nside, x, y, z))
    half = size / 2
    _image(axes, pixels, limit, label, linear=True, extent=(half, -half, -half, half))
    axes.set_xlabel(rf"$(l - {center[0]:g}^\circ)\,\cos b$ [deg]")
    axes.set_ylabel(rf"$b - {center[1]:g}^\circ$ [deg]")


def draw_spectra(
    axes: Axes, spectra: Mapping[str, Float[np.ndarray, " ell"]], unit: str, **options: Any
) -> None:
    """Spectra as D_l = l (l+1) C_l / 2 pi against l, both logarithmic; one colour each."""
    for (name, spectrum), color in zip(spectra.items(), COLORS, strict=False):
        ell = np.arange(len(spectrum))
        shown = slice(2, None)
        scaled = ell * (ell + 1) / (2 * np.pi) * spectrum
        axes.loglog(ell[shown], scaled[shown], label=plain(name), **{"color": color, **options})
    # A few round numbers: by default, labels run into each other where there is less than a decade.
    axes.xaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 3)))
    axes.xaxis.set_major_formatter(mpl.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(mpl.ticker.NullFormatter())
    axes.set_xlabel(r"multipole $\ell$")
    axes.set_ylabel(rf"$\ell(\ell+1)C_\ell/2\pi$ [{UNITS[unit]}$^2$]")


def _chosen(names: Sequence[str]) -> list[str]:
    """A few names, the first and the last among them, evenly spread."""
    at = np.unique(np.linspace(0, len(names) - 1, min(SHOWN, len(names))).round().astype(int))
    return [names[i] for i in at]


def contact_sheet(
    path: Path,
    files: Mapping[str, Path],
    read: Any,
    lmax: int,
    unit: str,
    title: str,
) -> None:
    """Q and U of some bands and the spectra of their totals, on one sheet.

    Parameters
    ----------
    path : picture to write
    files : map of each band
    read : function from a file to Q, U, shape (2, pix)
    lmax : largest multipole of the maps
    unit : of the maps
    title : what the maps are
    """
    names = _chosen(list(files))
    lmax = min(lmax, LMAX_SHOWN)
    spectra = {}
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(names) + 1,
            2,
            figsize=(7.2, 1.75 * len(names) + 3.2),
            height_ratios=[1.0] * len(names) + [1.6],
            layout="constrained",
        )
        for row, name in zip(grid, names, strict=False):
            maps = np.asarray(read(files[name]))
            # Without refinement: good to 1e-3 here, which no eye sees.
            alm = analysis(jnp.asarray(maps), min(lmax, 2 * healpy.npix2nside(maps.shape[-1])), 0)
            spectra[name] = np.asarray(power_spectrum(alm))
            limit = float(np.quantile(np.abs(maps), 0.99)) or 1.0
            for axes, values, which in zip(row, maps, "QU", strict=True):
                draw_map(axes, values, limit, UNITS[unit])
                axes.set_title(plain(f"{name}: {which}"))
        for axes, index, which in zip(grid[-1], (0, 1), ("EE", "BB"), strict=True):
            draw_spectra(axes, {n: s[index] for n, s in spectra.items()}, unit)
            axes.set_title(which)
            axes.set_ylim(bottom=axes.get_ylim()[1] * DEPTH)
        grid[-1, 0].legend(title="band", ncols=2, frameon=False)
        draw_title(figure, title, fontsize=10)
        save(figure, path)
