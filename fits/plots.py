"""Draw what all pictures share: style, panels, titles, symbols, maps and spectra."""

import itertools
import re
import textwrap
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import healpy
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis

from fits.results import FitResult
from jaxsky.arrays import STOKES
from jaxsky.bandpass import Bandpass
from jaxsky.components import parameter_declaration
from jaxsky.io import whole
from jaxsky.io.stacks import Maps, ranges
from jaxsky.sed import cmb_derivative
from jaxsky.sky import Sky, observe_components

T = TypeVar("T")
#: A map of the full sky.
Map: TypeAlias = Float[np.ndarray, " pix"]
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
TRUTH = {"color": COLORS[3], "linewidth": 0.9}
#: What pictures are written as, besides PNG, if matplotlib's `savefig.format` says so.
VECTOR_FORMATS = ("pdf", "svg")
#: Said below maps whose colours are not linear.
SCALE = "colour scales with unequal ticks: linear between the inner ticks, logarithmic beyond"
#: Width of a column of a paper [inch].
COLUMN = 3.5
#: Largest nside of a map that is drawn.
FINEST = 512
#: Height of a map in it, with its title [inch].
MAP_HEIGHT = 1.85
UNITS = {"uK_RJ": r"$\mu{\rm K}_{\rm RJ}$", "uK_CMB": r"$\mu{\rm K}_{\rm CMB}$"}
#: Symbols of parameters of bands, and their units.
BAND_SYMBOLS = {
    "gain": ("g", ""),
    "shift": (r"\Delta\nu/\nu", ""),
    "width": ("w", ""),
    "angle": (r"\psi", r"\ [^\circ]"),
}


def plain(text: str) -> str:
    """Return a text that is drawn literally: dollar signs do not enclose a formula.

    A thin space goes before an underscore, since legends omit labels that begin with one.
    """
    return ("\N{THIN SPACE}" if text.startswith("_") else "") + text.replace("$", r"\$")


def band_title(name: str) -> str:
    """Return a band's name as it is drawn, with GHz if it is a number."""
    return plain(f"{name} GHz" if name.replace(".", "", 1).isdigit() else name)


def pages(stem: str, bands: Sequence[T], most: int) -> dict[str, Sequence[T]]:
    """Return file names of pictures, `stem.png`, `stem_2.png`, ..., and what each shows."""
    parts = [bands[i : i + most] for i in range(0, len(bands), most)]
    return {f"{stem}_{n}.png" if n > 1 else f"{stem}.png": p for n, p in enumerate(parts, 1)}


def in_formula(text: str) -> str:
    """Return a name as upright letters of a formula, drawn literally."""
    escaped = re.sub(r"([$%#&_{} ])", r"\\\1", re.sub(r"[\\^~]", "?", text))
    return rf"{{\rm {escaped}}}"


def label(name: str) -> str:
    """Return TeX for a parameter's name, without dollar signs."""
    if region := re.fullmatch(r"(.+)(\[\d+\])", name):
        return rf"{label(region[1])}\ {region[2]}"
    parts = name.split(".")
    if parts[0] in BAND_SYMBOLS:
        symbol, unit = BAND_SYMBOLS[parts[0]]
        return rf"{symbol}_{in_formula(parts[1])}{unit}"
    if parts[0] == "offset":
        return rf"o_{in_formula(parts[1])}^{in_formula(parts[2])}\ [\mu{{\rm K}}_{{\rm RJ}}]"
    shift = r"\Delta " if parts[-1] == "offset" else ""
    number = "".join(rf"\ ({int(p) + 1})" for p in parts[2:] if p.isdigit())
    known = parameter_declaration(parts[1])
    unit = rf"\ [{{\rm {known['unit']}}}]" if known.get("unit") else ""
    return shift + (known.get("symbol") or in_formula(parts[1])) + number + unit


def draw_title(figure: plt.Figure, title: str, fontsize: float = 9, **options: Any) -> None:
    """Write a title literally above a figure; each of its lines is wrapped to at most three."""
    # A letter is some 0.55 times as wide as high, in points of 1/72 inch.
    letters = int(figure.get_figwidth() * 72 / (0.55 * fontsize))
    lines = [textwrap.fill(line, letters, max_lines=3) for line in title.strip().splitlines()]
    figure.suptitle(plain("\n".join(lines)), fontsize=fontsize, **options)


def save(figure: plt.Figure, path: Path) -> None:
    """Write a figure as PNG, atomically, and close it.

    Where matplotlib's own settings say `savefig.format: pdf` (in a file `matplotlibrc` of the
    working folder, for example), or svg, that is written next to it.
    """
    wanted = str(mpl.rcParams["savefig.format"])
    forms = ["png", *(form for form in VECTOR_FORMATS if form == wanted)]
    # A constrained layout fits already; cropping would draw it once more.
    box = None if figure.get_layout_engine() is not None else "tight"
    for form in forms:
        with (
            whole(path.with_suffix(f".{form}")) as beside,
            plt.rc_context({"savefig.bbox": box}),
            warnings.catch_warnings(action="ignore", category=UserWarning),  # glyphs a font lacks
        ):
            figure.savefig(beside, format=form)
    plt.close(figure)


@contextmanager
def draw_panels(
    path: Path,
    title: str,
    size: tuple[float, float],
    rows: int = 1,
    columns: int = 1,
    fontsize: float = 9,
    **options: Any,
) -> Iterator[np.ndarray]:
    """Yield panels to draw on, an array (rows, columns) of axes, and write them to a file.

    `size` is width and height [inch], `fontsize` that of the title above all panels, which may be
    empty; `options` are those of `matplotlib.pyplot.subplots`.
    """
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            rows, columns, figsize=size, squeeze=False, layout="constrained", **options
        )
        yield panels
        if title:
            draw_title(figure, title, fontsize=fontsize)
        save(figure, path)


def legend_below(axes: Axes, columns: int = 4, **options: Any) -> None:
    """Draw the legend of one panel below all panels."""
    handles, labels = axes.get_legend_handles_labels()
    options = {"loc": "outside lower center", "ncols": columns, "frameon": False, **options}
    axes.figure.legend(handles, labels, **options)


def spread(names: Sequence[str], count: int) -> list[str]:
    """Return a few names, evenly spread from the first to the last."""
    at = np.unique(np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int))
    return [names[i] for i in at]


def color_limit(values: np.ndarray, quantile: float = 0.99) -> float:
    """Return the end of a colour scale about zero that contains nearly all values."""
    known = np.abs(values[np.isfinite(values)])
    return (float(np.quantile(known, quantile)) if known.size else 0.0) or 1.0


def _image(axes, pixels, limit, label, middle, **options):
    """Draw values and a colour bar: linear up to a tenth of the limit, then logarithmic.

    So both the Galactic plane and high latitudes show in one picture. With a middle, the scale is
    linear about it. The limit is rounded to one digit.
    """
    limit, center = float(f"{limit:.1g}"), middle or 0.0
    norm: mpl.colors.Normalize = mpl.colors.AsinhNorm(limit / 10, -limit, limit)
    between = limit / 10
    if middle is not None:
        norm, between = mpl.colors.Normalize(middle - limit, middle + limit), limit / 2
    image = axes.imshow(pixels, origin="lower", cmap="RdBu_r", norm=norm, **options)
    bar = axes.figure.colorbar(image, ax=axes, shrink=0.8, pad=0.02, extend="both")
    bar.set_ticks([center + tick for tick in (-limit, -between, 0, between, limit)])
    bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.minorticks_off()
    bar.set_label(label)


def draw_map(
    axes: Axes, values: Map, limit: float, label: str, middle: float | None = None
) -> None:
    """Draw a map of the full sky in Galactic coordinates, centred on l = 0, l growing leftwards.

    With a middle, the colours are linear about it.
    """
    nside = healpy.npix2nside(values.size)
    projector = healpy.projector.MollweideProj(xsize=600)
    pixels = projector.projmap(np.asarray(values), lambda x, y, z: healpy.vec2pix(nside, x, y, z))
    pixels = np.ma.masked_invalid(np.where(pixels == -np.inf, np.nan, pixels))
    _image(axes, pixels, limit, label, middle)
    axes.axis("off")


class MapPanel(NamedTuple):
    """A map with its title and the arguments of `draw_map`; by default the limit fits the map."""

    title: str
    values: Map
    label: str
    middle: float | None = None
    limit: float | None = None


def stokes_panels(
    name: str, maps: Sequence[Map], limit: float, unit: str, middle: float | None = None
) -> list[MapPanel]:
    """Return panels of the Stokes parameters; the name may hold formulas, see `plain`."""
    return [
        MapPanel(f"{name}: {stokes}", values, f"{stokes} [{UNITS[unit]}]", middle, limit)
        for values, stokes in zip(maps, STOKES[len(maps)], strict=True)
    ]


def thinned(maps: Maps, rows: Sequence[int]) -> np.ndarray:
    """Return some maps, those that are finer than a picture resolves at nside 512."""
    nside = healpy.npix2nside(maps.shape[-1])
    least = min(nside, FINEST)

    def pixels(part: slice) -> Any:
        if nside == least:
            return part
        return healpy.ang2pix(nside, *healpy.pix2ang(least, np.arange(part.start, part.stop)))

    parts = ranges(healpy.nside2npix(least))
    return np.concatenate([maps[..., pixels(part)][list(rows)] for part in parts], axis=-1)


def plot_maps(path: Path, rows: Sequence[Sequence[MapPanel]], title: str = "") -> None:
    """Draw maps of the sky in rows and columns."""
    columns = len(rows[0])
    size = columns * COLUMN, len(rows) * MAP_HEIGHT + (0.6 if title else 0.2)
    with draw_panels(path, title, size, len(rows), columns) as panels:
        for axes, panel in zip(panels.flat, (one for row in rows for one in row), strict=True):
            limit = panel.limit or color_limit(panel.values - (panel.middle or 0.0))
            draw_map(axes, panel.values, limit, panel.label, panel.middle)
            axes.set_title(panel.title)
        if any(panel.middle is None for row in rows for panel in row):
            panels[0, 0].figure.supxlabel(SCALE, fontsize=7)


def draw_patch(
    axes: Axes, values: Map, center: tuple[float, float], size: float, limit: float, label: str
) -> None:
    """Draw a square patch of the sky about (l, b), in degrees; gnomonic, l growing leftwards.

    Unlike in `draw_map`, colours are linear, and where pixels of the picture are finer than those
    of the map, values are interpolated.
    """
    nside, values, xsize = healpy.npix2nside(values.size), np.asarray(values), 300
    step = size * 60 / xsize  # arcmin
    projector = healpy.projector.GnomonicProj(rot=(*center, 0.0), xsize=xsize, reso=step)
    if step < healpy.nside2resol(nside, arcmin=True):
        vectors = projector.xy2vec(projector.ij2xy())
        angles = healpy.vec2ang(np.stack(vectors, axis=-1).reshape(-1, 3))
        pixels = healpy.get_interp_val(values, *angles).reshape(xsize, xsize)
    else:
        pixels = projector.projmap(values, lambda x, y, z: healpy.vec2pix(nside, x, y, z))
    half = size / 2
    _image(axes, pixels, limit, label, 0.0, extent=(half, -half, -half, half))
    axes.set_xlabel(rf"$(l - {center[0]:g}^\circ)\,\cos b$ [deg]")
    axes.set_ylabel(rf"$b - {center[1]:g}^\circ$ [deg]")


def with_powers(spectrum: Float[np.ndarray, " ell"]) -> tuple[np.ndarray, np.ndarray]:
    """Return multipoles from 2 on, and D_l = l (l+1) C_l / 2 pi."""
    ell = np.arange(2, len(spectrum))
    return ell, ell * (ell + 1) / (2 * np.pi) * spectrum[2:]


def round_numbers(axis: Axis, digits: Sequence[float] = (1, 2, 5)) -> None:
    """Label a logarithmic axis with round numbers, those with the given first digits.

    Matplotlib's own labels run into each other where there is less than a decade.
    """
    axis.set_major_locator(mpl.ticker.LogLocator(subs=digits))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(mpl.ticker.NullFormatter())


def label_b_modes(axes: Axes, first: float, last: float, columns: int) -> None:
    """Label axes of BB as D_l in uK_CMB^2 between two multipoles, and draw a legend below."""
    axes.set(yscale="log", xlim=(first, last), xlabel=r"multipole $\ell$")
    axes.set_ylabel(rf"$\ell(\ell+1)C_\ell^{{BB}}/2\pi$ [{UNITS['uK_CMB']}$^2$]")
    axes.yaxis.set_major_locator(mpl.ticker.LogLocator(numticks=20))
    legend_below(axes, columns, fontsize=7)


def draw_spectra(
    axes: Axes, spectra: Mapping[str, Float[np.ndarray, " ell"]], unit: str, **options: Any
) -> None:
    """Draw spectra as D_l = l (l+1) C_l / 2 pi against l, both logarithmic; one colour each."""
    for (name, spectrum), color in zip(spectra.items(), COLORS, strict=False):
        axes.plot(*with_powers(spectrum), label=plain(name), **{"color": color, **options})
    axes.set(xscale="log", yscale="log")
    round_numbers(axes.xaxis, (1, 3))
    axes.set_xlabel(r"multipole $\ell$")
    axes.set_ylabel(rf"$\ell(\ell+1)C_\ell/2\pi$ [{UNITS[unit]}$^2$]")


def plot_sed(
    sky: Sky,
    bands: Mapping[str, Bandpass],
    cmb_rms: float | None = None,
    axes: Axes | None = None,
    samples: int = 60,
) -> Axes:
    """Draw the rms of each component against frequency, with the bands shaded; return the axes.

    The rms over the pixels is that of sqrt(Q^2 + U^2) where the sky has Q and U, else that of I,
    in uK_RJ, at `samples` frequencies from 2/3 of the lowest to 3/2 of the highest band's centre.
    A band is shaded where its weight is half the largest at least. `cmb_rms` [uK_CMB] adds the CMB.

    Raises
    ------
    TypeError, ValueError
        If `sky` is no Sky, or `bands` is not at least one Bandpass by name.
    """
    if not isinstance(bands, Mapping) or not bands:
        raise ValueError("Argument `bands` must be at least one Bandpass by name.")
    centers = [float(band.center) for band in bands.values()]
    nu = np.geomspace(min(centers) / 1.5, max(centers) * 1.5, samples)
    rms: dict[str, list[float]] = {}
    for at in nu:
        for name, maps in observe_components(sky, [Bandpass.delta(at)]).items():
            rms.setdefault(name, []).append(_rms(np.asarray(maps[0])))
    if axes is None:
        axes = plt.subplots(figsize=(COLUMN, 3.0), layout="constrained")[1]
    for (name, values), color in zip(rms.items(), itertools.cycle(COLORS[:6])):
        axes.plot(nu, values, color=color, label=plain(name))
    if cmb_rms is not None:
        axes.plot(nu, cmb_rms * np.asarray(cmb_derivative(nu)), "--", color=COLORS[6], label="CMB")
    for band in bands.values():
        inside = np.asarray(band.nu)[np.asarray(band.weights) >= band.weights.max() / 2]
        axes.axvspan(inside[0], inside[-1], color="0.5", alpha=0.2, zorder=0)
    axes.set(xscale="log", yscale="log", xlim=(nu[0], nu[-1]), xlabel="frequency [GHz]")
    axes.set_ylabel(f"rms [{UNITS['uK_RJ']}]")
    round_numbers(axes.xaxis)
    axes.legend(frameon=False)
    return axes


def _rms(maps: np.ndarray) -> float:
    """Return the rms of P, or of I where maps (stokes, pix) have nothing else."""
    return float(np.sqrt((maps[-2:] ** 2).sum(axis=0).mean()))


def plot_chains(
    path: Path, results: Mapping[str, FitResult], truth: Mapping[str, float] | None, title: str
) -> None:
    """Draw the posteriors of chains with the same parameters, by label, one colour each."""
    from getdist import plots  # slow to import

    samples = [result.to_getdist(plain(name), label) for name, result in results.items()]
    rows = next(iter(results.values())).labels
    plotter = plots.get_subplot_plotter(width_inch=max(4.0, 1.6 * len(rows)))
    plotter.settings.axes_fontsize = 9
    plotter.settings.axes_labelsize = 11
    plotter.settings.legend_fontsize = 9
    plotter.settings.title_limit_fontsize = 9
    plotter.triangle_plot(
        samples,
        list(rows),
        filled=[True, *[False] * (len(samples) - 1)],  # else one hides the other
        contour_colors=list(COLORS[: len(samples)]),
        title_limit=1 if len(samples) == 1 else 0,
        markers={n: v for n, v in (truth or {}).items() if n in rows},
        marker_args={"color": TRUTH["color"], "lw": TRUTH["linewidth"], "ls": "-"},
    )
    for i, name in enumerate(rows):
        for result, color in zip(results.values(), COLORS, strict=False):
            interval = result.of_row(result.interval_68, name)
            plotter.subplots[i, i].axvspan(*interval, color=color, alpha=0.15, linewidth=0)
    said = "68 % shaded; contours of 68 and 95 %" + ("; lines: truth" if truth else "")
    draw_title(plotter.fig, f"{title}\n{said}", fontsize=8, y=0.99, va="bottom")
    with mpl.rc_context(STYLE | {"savefig.dpi": 200}):
        save(plotter.fig, path)
