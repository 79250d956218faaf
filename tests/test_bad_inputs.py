"""What is read right or refused: a table of inputs as they occur, and what jaxsky says of each.

A row is made small, read by what a command reads it with, and either gives the right values or
one sentence that names the file or the argument, and what is wrong with it. Nothing in it may end
in any other exception, and the file stays as it was.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import healpy
import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits as pyfits

from fits.inputs import inputs_of
from fits.separated_data import separation_data
from jaxsky import Bandpass, Dust, Synchrotron
from jaxsky.io import read_bandpass, read_beam, read_maps, read_mask, unit_factor
from jaxsky.settings import load, of_file
from settings_fuzz import changed_at, written

NSIDE = 4
NPIX = 12 * NSIDE**2
UNSEEN = healpy.UNSEEN
RNG = np.random.default_rng(5)
T, Q, U = RNG.normal(size=(3, NPIX))
HOLE = 7


@dataclass(frozen=True)
class Row:
    """An input, made in a folder, with what reads it; the words of its refusal, or right values."""

    given: str
    make: Callable[[Path], Callable[[], Any]]
    refused: tuple[str, ...] = ()
    right: Callable[[Any], None] | None = None


def equal(expected: Any, of: Callable[[Any], Any] = lambda found: found) -> Callable[[Any], None]:
    """A check that what was read has these values."""
    return lambda found: np.testing.assert_allclose(of(found), expected, rtol=1e-6, atol=1e-12)


# Maps and masks in FITS files


def save(folder: Path, columns: dict[str, Any], header: dict[str, Any]) -> Path:
    """A table of columns, arrays or ready-made, with a header that leaves nothing open."""
    made = [
        c if isinstance(c, pyfits.Column) else pyfits.Column(name, "D", unit="K_CMB", array=c)
        for name, c in columns.items()
    ]
    table = pyfits.BinTableHDU.from_columns(made)
    said = {"PIXTYPE": "HEALPIX", "ORDERING": "RING", "NSIDE": NSIDE, "COORDSYS": "G"} | header
    table.header.update({key: value for key, value in said.items() if value is not None})
    path = folder / "given.fits"
    table.writeto(path)
    return path


def fits_row(
    given: str,
    columns: dict[str, Any],
    *refused: str,
    right: Callable[[Any], None] | None = None,
    header: dict[str, Any] | None = None,
    reader: Callable[..., Any] = read_maps,
    **arguments: Any,
) -> Row:
    def make(folder: Path) -> Callable[[], Any]:
        return partial(reader, save(folder, columns, header or {}), **arguments)

    return Row(given, make, refused and ("given.fits", *refused), right)


def column(name: str, code: str, values: Any, **said: Any) -> pyfits.Column:
    return pyfits.Column(name, code, array=values, **({"unit": "K_CMB"} | said))


QU = {"Q_STOKES": Q, "U_STOKES": U}
IAU = {"POLCCONV": "IAU"}
CELESTIAL = {"COORDSYS": "C"}
values_of = lambda found: found.maps  # noqa: E731
kept = np.arange(NPIX) != HOLE


def with_pixels(name: str, pixels: Any, code: str = "J") -> dict[str, Any]:
    """Columns of a partial map."""
    pixels = np.asarray(pixels)
    values = np.arange(pixels.size, dtype=float) + 1
    return {name: column(name, code, pixels, unit=None)} | {
        s: column(s, "D", values) for s in ("Q_STOKES", "U_STOKES")
    }


EXPLICIT = {"INDXSCHM": "EXPLICIT", "OBJECT": "PARTIAL"}

MAPS = [
    # Which Stokes parameter a column is
    fits_row("IAU, one column UNKNOWN1", {"UNKNOWN1": U}, "UNKNOWN1", "stokes", header=IAU),
    fits_row("celestial, a name that only begins with U", {"UNITS": Q, "QUALITY": U}, "stokes",
             header=CELESTIAL, fields=["UNITS", "QUALITY"]),
    fits_row("Galactic and COSMO, no name needed", {"COLUMN_2": Q, "COLUMN_3": U},
             right=equal([Q, U], values_of), fields=[0, 1]),
    fits_row("celestial, Q alone", {"Q_STOKES": Q}, "Q_STOKES", header=CELESTIAL),
    fits_row("more letters than columns", QU, "stokes", fields=["Q_STOKES"], stokes="QU"),
    # Missing values
    fits_row("zeros in one of two columns", {"Q_STOKES": Q, "U_STOKES": 0 * U},
             right=equal([Q, 0 * U], values_of)),
    fits_row("a complex column", {"I_STOKES": column("I_STOKES", "M", T + 1j)}, "I_STOKES"),
    fits_row("a logical column", {"I_STOKES": column("I_STOKES", "L", T > 0)}, "I_STOKES"),
    fits_row("a column of text", {"I_STOKES": column("I_STOKES", "4A", ["1.5"] * NPIX)},
             "I_STOKES"),
    fits_row("nothing but missing pixels", {"I_STOKES": np.full(NPIX, np.nan)}, "no pixel"),
    # Pixel numbers
    fits_row("pixel -1", with_pixels("PIXEL", [0, -1]), "-1", header=EXPLICIT),
    fits_row("pixel 12 nside^2", with_pixels("PIXEL", [0, NPIX]), str(NPIX), header=EXPLICIT),
    fits_row("a pixel twice", with_pixels("PIXEL", [3, 3]), "more than once", header=EXPLICIT),
    fits_row("half a pixel", with_pixels("PIXEL", [0.5, 2.0], "D"), "0.5", header=EXPLICIT),
    fits_row("no column of pixels", QU, "PIX", header=EXPLICIT),
    fits_row("nside -4", QU, "NSIDE", "-4", header={"NSIDE": -4}),
    fits_row("nside 0", with_pixels("PIXEL", [0]), "NSIDE", header=EXPLICIT | {"NSIDE": 0}),
    fits_row("nside abc", QU, "NSIDE", "ABC", header={"NSIDE": "abc"}),
    fits_row("nside 8 of 192 pixels", QU, "NSIDE", "8", header={"NSIDE": 8}),
    fits_row("nside 16.0", QU, right=equal([Q, U], values_of), header={"NSIDE": float(NSIDE)}),
    fits_row("nside 4.5", QU, "NSIDE", "4.5", header={"NSIDE": 4.5}),
    fits_row("180 pixels", {"I_STOKES": T[:180]}, "180", header={"NSIDE": None}),
    # What a header says
    fits_row("no ORDERING", QU, "ORDERING", "ordering", header={"ORDERING": None}),
    fits_row("no COORDSYS", QU, "COORDSYS", "coordinates", header={"COORDSYS": None}),
    fits_row("COORDSYS of Mars", QU, "COORDSYS", "MARS", header={"COORDSYS": "MARS"}),
    fits_row("POLCCONV XYZ", QU, "POLCCONV", "XYZ", header={"POLCCONV": "XYZ"}),
    fits_row("PIXTYPE other", QU, "PIXTYPE", header={"PIXTYPE": "CAR"}),
    fits_row("given ordering contradicts", QU, "ordering", "RING", ordering="NESTED"),
    fits_row("a bare K", {"I_STOKES": column("I_STOKES", "D", T, unit="K")}, "unit", "'K'"),
    fits_row("no unit", {"I_STOKES": column("I_STOKES", "D", T, unit=None)}, "unit"),
    fits_row("no such column", QU, "I_STOKES", fields=["I_STOKES"]),
    fits_row("column number -1", QU, "-1", fields=[-1]),
    fits_row("no column wanted", QU, "fields", fields=[]),
    fits_row("no such HDU", QU, "HDU", hdu=5),
    fits_row("HDU 0 has no table", QU, "HDU", hdu=0),
    # Masks
    fits_row("a mask with 0.5", {"MASK": np.where(kept, 1.0, 0.5)}, "0.5", reader=read_mask),
    fits_row("a mask with 2", {"MASK": np.where(kept, 1.0, 2.0)}, "2", reader=read_mask),
    fits_row("a mask of nothing", {"MASK": np.zeros(NPIX)}, "no pixel", reader=read_mask),
]  # fmt: skip


def raw(
    given: str, content: bytes, *refused: str, reader: Any = read_maps, name="given.fits"
) -> Row:
    """A file that is no FITS file."""

    def make(folder: Path) -> Callable[[], Any]:
        path = folder / name
        path.write_bytes(content)
        return partial(reader, path)

    return Row(given, make, (name, *refused))


DAMAGED = [
    raw("an empty file", b"", "FITS"),
    raw("a page of words", b"<html><body>moved</body></html>", "FITS"),
    raw("random bytes", RNG.bytes(5000), "FITS"),
    raw("a FITS header and no more", b"SIMPLE  =                    T".ljust(80), "FITS"),
    raw("an .npz of words", b"no zip", "npz", reader=read_mask, name="given.npz"),
]

# Text files


read_rj = partial(read_bandpass, convention="RJ")


def text(
    given: str,
    content: str | bytes,
    *refused: str,
    nu: Any = None,
    reader: Any = read_rj,
    **arguments: Any,
) -> Row:
    def make(folder: Path) -> Callable[[], Any]:
        path = folder / "given.txt"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return partial(reader, path, **arguments)

    right = None if nu is None else equal(nu, lambda found: found.nu)
    return Row(given, make, refused and ("given.txt", *refused), right)


TABLE = "30 1\n31 2\n32 1\n"
nus = [30.0, 31.0, 32.0]
BANDPASSES = [
    text("two columns", TABLE, nu=nus),
    text("commas between numbers", TABLE.replace(" ", ", "), nu=nus),
    text("a line of names", "nu weight\n" + TABLE, nu=nus),
    text("a byte-order mark", "\ufeff" + TABLE, nu=nus),
    text("a byte-order mark and a comment", "\ufeff# nu weight\n" + TABLE, nu=nus),
    text("decimal commas", "30,5 2,0\n31,5 2,0\n32,5 2,0\n", "line 1"),
    text("decimal commas and semicolons", "30,5;2,0\n31,5;2,0\n", nu=[30.5, 31.5]),
    text("a damaged first row", "3O 1\n" + TABLE, "line 1", "3O"),
    text("a damaged later row", TABLE + "33 x\n", "line 4", "33 x"),
    text("one number in a row", TABLE + "33\n", "line 4"),
    text("a nan", "30 1\n31 nan\n", "finite"),
    text("an index before the frequency", "0 30 1\n1 31 2\n2 32 1\n", "fields"),
    text("an index from 1", "1 30 1\n2 31 2\n3 32 1\n", "fields"),
    text("MHz", "30000 1\n31000 2\n32000 1\n", "unit"),
    text("THz", "0.030 1\n0.031 2\n0.032 1\n", "unit"),
    text("Hz", "30e9 1\n31e9 2\n32e9 1\n", "unit"),
    text("MHz, in the header", "# nu [MHz]  weight\n30000 1\n31000 2\n32000 1\n", nu=nus),
    text("THz, in the header", "# nu (THz), weight\n0.030 1\n0.031 2\n0.032 1\n", nu=nus),
    text("Hz, given", "30e9 1\n31e9 2\n32e9 1\n", nu=nus, unit="Hz"),
    text("a unit that is none of frequency", TABLE, "unit", "kg", unit="kg"),
    text("weight at nu = 0", "0 1\n30 1\n31 2\n", "0"),
    text("weight at negative nu", "-5 1\n30 1\n31 2\n", "nu <= 0"),
    text("no weight at nu = 0", "0 0\n" + TABLE, nu=nus),
    text("frequencies that fall", "32 1\n31 2\n30 1\n", "increase"),
    text("a frequency twice", "30 1\n30 2\n31 1\n", "increase"),
    text("no row", "# nothing\n", "no line"),
    text("an empty table", "", "no line"),
    text("weights of zero", "30 0\n31 0\n", "integral"),
    text("UTF-16", TABLE.encode("utf-16"), nu=nus),
    text("bytes for a table", bytes(range(128, 200)), "text"),
    text("no convention", TABLE, "convention", reader=read_bandpass),
    text("a beam that ends early", "0 1\n1 0.9\n", "l", reader=partial(read_beam, lmax=2)),
]  # fmt: skip

# Settings


FREE = {"dust.beta_dust": {"start": 1.6, "uniform": [0.5, 2.5]}}
TEMPLATES = {
    "dust": {"law": "dust", "file": "dust.fits", "nu_ref": 353.0},
    "synchrotron": {"law": "synchrotron", "file": "synchrotron.fits", "nu_ref": 30.0},
}
BAND = {
    "name": "44",
    "file": "44.fits",
    "bandpass": {"center": 44.0, "width": 8.0},
    "noise": {"rms": 1.0},
}


def and_then(build: Callable[[Any], Any]) -> Callable[[Path], Any]:
    """What reads settings and builds what they name, as a command does."""

    def read(path: Path) -> Any:
        with of_file(path):
            return build(load(path))

    return read


EMBEDDED: dict[str, Any] = {"sky": {"embedded": {}}, "bands": [{"instrument": "planck"}]}
#: A complete file of settings of each command, and what reads it.
BASES: dict[str, tuple[dict[str, Any], Callable[[Path], Any]]] = {
    "fit": (
        {
            "common": {"nside": NSIDE, "fwhm": 0},
            "free": FREE,
            "sky": TEMPLATES,
            "bands": [BAND, BAND | {"name": "70", "bandpass": {"center": 70.0, "width": 14.0}}],
        },
        load,
    ),
    "simulate": (EMBEDDED | {"simulate": {"nside": 16, "fwhm": 300.0}}, load),
    "separate": (
        {
            "common": {"nside": 16, "fwhm": 300.0, "components": ["dust"]},
            "sky": {"embedded": {"nside": 16}, "dust": {"law": "dust"}},
            "bands": [{"instrument": "litebird", "channels": ["40", "140", "402"]}],
            "free": FREE,
        },
        and_then(separation_data),
    ),
    "forecast": (
        EMBEDDED | {"regions": {"clean": "|b| > 20"}, "forecast": {"region": "clean"}},
        load,
    ),
    "paper": (EMBEDDED | {"free": FREE}, load),
}


def settings(command: str, key: str, value: Any, *refused: str) -> Row:
    """Settings of a command with one entry changed; its key is "/" between its parts."""
    base, load = BASES[command]

    def make(folder: Path) -> Callable[[], Any]:
        return partial(
            load, written(folder / "given.toml", changed_at(base, key, value) if key else value)
        )

    words = ("given.toml", *refused) if refused else ()
    return Row(f"{command}: {key} = {value!r}", make, words)


STRICT = [
    *(settings(command, "", base[0]) for command, base in BASES.items()),
    *(
        settings("fit", "common/nside", value, "common.nside")
        for value in (True, "16", 16.5, 12, 0, -4, 2**40, [16], float("nan"))
    ),
    *(settings("fit", "seed", value, "seed") for value in (-1, 2**32, 2**53, 1.5, True, "1")),
    settings("fit", "seed", 2**32 - 1),
    *(
        settings("fit", "common/fwhm", value, "common.fwhm")
        for value in (True, "60", -1, float("inf"), float("nan"))
    ),
    settings("fit", "common/fwhm", 60),
    settings("fit", "fit/regions", [], "fit.regions"),
    settings("fit", "fit/regions", "strip", "fit.regions"),
    settings("fit", "fit/regions", ["strip", "strip"], "fit.regions"),
    settings("fit", "fit/methods", ["guess"], "fit.methods"),
    settings("fit", "fit/stokes", ["V"], "fit.stokes"),
    settings("fit", "regions/strip", "|b| <= 95", "regions.strip"),
    settings("fit", "fit/colour", 1, "fit.colour"),
    settings("fit", "fit/nsteps", 0, "fit.nsteps"),
    settings("fit", "fit/nwalkers", "32", "fit.nwalkers"),
    settings("fit", "fit/points", 1e3, "fit.points"),
    settings("fit", "cmb/include", "yes", "cmb.include"),
    settings("fit", "cmb/include", 1, "cmb.include"),
    settings("fit", "cmb/r", -0.1, "cmb.r"),
    settings("fit", "title", 5, "title"),
    settings("fit", "bands/0/noise", {}, "bands.0.noise"),
    settings("fit", "bands/0/noise/rms", "1.0", "bands.0.noise.rms"),
    settings("fit", "bands/0/noise/rms", -1.0, "bands.0.noise.rms"),
    settings("fit", "bands/0/noise/rms", 0.0, "bands.0.noise", "not 0"),
    settings("fit", "bands/0/name", "", "bands.0.name"),
    settings("fit", "bands/0/name", 44, "bands.0.name"),
    settings("fit", "bands/0/name", "70", "names of the bands", "70, 70"),
    settings("fit", "bands/0/bandpass/width", -8.0, "bands.0.bandpass.width"),
    settings("fit", "bands/0/bandpass", {"center": 44.0, "file": "a.txt"}, "bands.0.bandpass"),
    settings("fit", "free/dust.beta_dust/uniform", [2.5, 0.5], "free.dust.beta_dust", "2.5, 0.5"),
    settings("fit", "free/dust.beta_dust/start", 5.0, "free.dust.beta_dust", "start 5"),
    settings("fit", "free/dust.beta_dust/start", "1.6", "free.dust.beta_dust.start"),
    settings("fit", "free/synchrotron.beta_syn", {"start": -3.1}, "synchrotron.beta_syn", "3.1"),
    settings("fit", "fixed", {"synchrotron.beta_syn": -3.1}, "synchrotron.beta_syn", "3.1"),
    settings("fit", "fixed", {"dust.beta_dust": 1.5}, "dust.beta_dust"),
    settings("fit", "sky/dust/nu_ref", -353.0, "sky.dust.nu_ref"),
    settings("fit", "sky/dust/nu_ref", 353e9, "sky.dust: nu_ref", "3.53e+11"),
    settings("fit", "sky/dust/parameters", {"nu_ref": 353.0}, "sky.dust: nu_ref", "353"),
    settings("fit", "sky/dust/law", "ash", "sky.dust.law"),
    settings("fit", "sky/dust/hdu", "1.5", "sky.dust.hdu"),
    settings("fit", "sky/dust/stokes", "QX", "sky.dust.stokes"),
    *(
        settings("fit", f"sky/{name}", TEMPLATES["dust"], f"sky.{name}:")
        for name in ("cmb", "noise", "total", "", "a.b", "x" * 81)
    ),
    *(
        settings("simulate", "simulate/include", value, "simulate.include")
        for value in ([], "dust", ["dust", "dust"])
    ),
    settings("simulate", "simulate/components", "dust", "simulate.components"),
    settings("simulate", "simulate/sheet", "true", "simulate.sheet"),
    settings("separate", "sky/dust/nu_ref", "353", "sky.dust.nu_ref"),
    settings("separate", "truth", {"dust.beta_dust": "1.5"}, "truth.dust.beta_dust", "1.5"),
    settings("separate", "separate/lmin", 1, "separate.lmin"),
    settings("forecast", "regions/clean", "20", "regions.clean"),
    settings("forecast", "regions/clean", {}, "regions.clean"),
    settings("forecast", "forecast/free", [], "forecast.free"),
    settings("forecast", "forecast/free", ["r", "r"], "forecast.free"),
    settings("forecast", "forecast/lmax", 10.5, "forecast.lmax"),
    settings("forecast", "sky/embedded/seed", 2**32, "sky.embedded.seed"),
    settings("paper", "paper/fwhm", "5", "paper.fwhm"),
    settings("paper", "paper/center", [180.0], "paper.center"),
    settings("paper", "bands/0/channels", ["999", "999"], "bands.0.channels"),
]


def file_of_settings(
    given: str, content: str | bytes, *refused: str, read: Callable[[Path], Any] = load
) -> Row:
    def make(folder: Path) -> Callable[[], Any]:
        path = folder / "given.toml"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return partial(read, path)

    return Row(given, make, ("given.toml", *refused))


STRICT += [
    file_of_settings("no TOML", "this is not TOML", "TOML"),
    file_of_settings("a key twice", "title = 'a'\ntitle = 'b'\n", "TOML"),
    file_of_settings("bytes", b"\xff\xfe\x00", "TOML"),
    file_of_settings("deeper than Python counts", "a = " + "[" * 20000 + "]" * 20000, "nested"),
    file_of_settings("nothing", "", "bands", read=and_then(inputs_of)),
]


def instrument(given: str, bands: list[dict[str, Any]], *refused: str) -> Row:
    """A file with the bands of an instrument."""

    def make(folder: Path) -> Callable[[], Any]:
        written(folder / "own.toml", {"bands": bands})
        return partial(
            load, written(folder / "given.toml", {"bands": [{"instrument": "own.toml"}]})
        )

    words = ("given.toml", "bands.0.instrument", "own.toml", *refused) if refused else ()
    return Row(f"an instrument {given}", make, words)


OWN = {"name": "a", "bandpass": {"center": 44.0}, "fwhm": 27.0, "noise": {"level": 240.0}}
STRICT += [
    instrument("of one's own", [OWN]),
    instrument("without bands", [], "none"),
    instrument("with a band without a name", [{"fwhm": 27.0}], "name"),
    instrument("with a band twice", [OWN, OWN], "a, a"),
    instrument("with a beam in quotes", [OWN | {"fwhm": "27"}], "band a: fwhm", "'27'"),
    instrument("with negative noise", [OWN | {"noise": {"level": -1.0}}], "noise.level", "-1.0"),
    instrument("with another key", [OWN | {"colour": 1}], "band a: colour"),
    instrument("with a band of another", [OWN | {"instrument": "planck"}], "band a: instrument"),
]

# What settings and files say together


def sky(given: str, changes: dict[str, Any], *refused: str, right: Any = None, **files: Any) -> Row:
    """A fit of files at nside 4, with entries changed and files replaced."""
    base, load = BASES["fit"]

    def make(folder: Path) -> Callable[[], Any]:
        for name, columns in (dict.fromkeys(("dust", "synchrotron", "44"), QU) | files).items():
            save(folder, columns, {}).rename(folder / f"{name}.fits")
        settings = base
        for key, value in changes.items():
            settings = changed_at(settings, key, value)
        path = written(folder / "given.toml", settings)
        return lambda: inputs_of(load(path))

    return Row(given, make, refused, right)


def of_pixels(values: Any, unit: str | None = "1", name: str = "MAP") -> dict[str, Any]:
    return {name: column(name, "D", values, unit=unit)}


BETA = {"sky/dust/parameters": {"beta_dust": {"file": "beta.fits"}}}
LEVELS = 1.5 + 0.1 * RNG.random(NPIX)
RMS = {"bands/0/noise": {"rms": {"file": "rms.fits"}}}
PIXEL = healpy.nside2resol(NSIDE, arcmin=True)
BAND_44 = Bandpass.top_hat(44.1, 10.72)
rms_of = lambda found: found.bands["44"].noise / PIXEL  # noqa: E731
TOGETHER = [
    sky("files that are right", {}),
    sky("a map of beta_dust", BETA, beta=of_pixels(LEVELS)),
    sky("beta_dust in K", BETA, "beta.fits", "'K'", beta=of_pixels(LEVELS, "K")),
    sky("beta_dust in uK_CMB", BETA, "beta_dust", "uK_CMB", beta=of_pixels(LEVELS, "uK_CMB")),
    sky("T_dust without unit K", {"sky/dust/parameters": {"T_dust": {"file": "T.fits"}}}, "T_dust",
        T=of_pixels(20 * LEVELS, "mK_CMB")),
    sky("beta_syn of the other sign",
        {"sky/synchrotron/parameters": {"beta_syn": {"file": "beta.fits"}}}, "beta_syn",
        beta=of_pixels(-2 * LEVELS)),
    sky("beta_syn = -3.1", {"sky/synchrotron/parameters": {"beta_syn": -3.1}}, "beta_syn", "3.1"),
    sky("a parameter that is not there", {"sky/dust/parameters": {"beta": 1.5}}, "dust", "beta"),
    sky("no such file", {"bands/0/file": "none.fits"}, "none.fits"),
    sky("noise of a map without a file", {"bands/0/noise": {"rms": {"hdu": 1}}}, "noise.rms.file"),
    sky("a rms of 160 K", {"bands/0/noise/rms": 160.0}, "44", "160", "K_CMB"),
    sky("a rms of 1e-9 K", {"bands/0/noise/rms": 1e-9}, "44", "1e-09", "K_CMB"),
    sky("a rms of 160 K that is meant", {"bands/0/noise": {"rms": 160.0, "plausible": True}}),
    sky("a map of rms in the wrong unit", RMS, "44", "K_CMB", rms=of_pixels(1e3 * LEVELS, "K_CMB")),
    sky("a map of rms of 48 pixels", RMS, "rms.fits", "48", rms=of_pixels(LEVELS[:48], "K_CMB")),
    sky("a map of rms with zeros", RMS, "rms.fits", "missing", rms=of_pixels(0 * LEVELS, "K_CMB")),
    sky("the noise of an instrument in uK_CMB, and a map in uK_RJ",
        {"bands/0": {"name": "44", "instrument": "planck", "file": "44.fits"}},
        right=equal(240.0 / PIXEL / BAND_44.conversion("uK_RJ", "uK_CMB"), rms_of),
        **{"44": {n: column(n, "D", v, unit="uK_RJ") for n, v in QU.items()}}),
    sky("a map of U alone", {"bands/0/fields": ["U_STOKES"]}, "44"),
    sky("U before Q", {"bands/0/fields": ["U_STOKES", "Q_STOKES"]}, "44", "U_STOKES"),
    sky("a band table without a convention", {"bands/0/bandpass": {"file": "dust.fits"}},
        "dust.fits"),
]  # fmt: skip

# Python


def python(given: str, call: Callable[[], Any], *refused: str) -> Row:
    return Row(given, lambda folder: call, refused)


MAPS_QU = np.array([Q, U])
PYTHON = [
    python("a shift in MHz", lambda: BAND_44.shifted(1 * u.MHz), "delta"),
    python("a bandpass in Hz", lambda: Bandpass([30e9, 31e9], [1, 1]), "nu", "GHz"),
    python("a bandpass with a unit", lambda: Bandpass([30, 31] * u.GHz, [1, 1]), "nu", "unit"),
    python("a bandpass that falls", lambda: Bandpass([31, 30], [1, 1]), "nu"),
    python("negative frequencies", lambda: Bandpass([-30, 30], [1, 1]), "nu"),
    python("weights of nan", lambda: Bandpass([30, 31], [1, np.nan]), "weights"),
    python("a convention that is none", lambda: Bandpass([30, 31], [1, 1], "Jy"), "convention"),
    python("a width of zero", lambda: Bandpass.top_hat(44.0, 0.0), "width"),
    python("one sample", lambda: Bandpass.top_hat(44.0, 8.0, samples=1), "samples"),
    python("a template in uK", lambda: Dust(MAPS_QU * u.uK), "amplitude", "unit"),
    python("a template of one row", lambda: Dust(Q), "amplitude", "shape"),
    python("a template with nan", lambda: Dust(MAPS_QU * np.nan), "amplitude"),
    python("a complex template", lambda: Dust(MAPS_QU * 1j), "amplitude"),
    python("negative nu_ref", lambda: Dust(MAPS_QU, nu_ref=-353.0), "nu_ref"),
    python("nu_ref in Hz", lambda: Dust(MAPS_QU, nu_ref=353e9), "nu_ref", "GHz"),
    python("nu_ref with a unit", lambda: Dust(MAPS_QU, nu_ref=353 * u.GHz), "nu_ref", "unit"),
    python("beta_syn of nan", lambda: Synchrotron(MAPS_QU, np.nan), "beta_syn"),
    python("beta_syn of another shape", lambda: Synchrotron(MAPS_QU, np.ones(7)), "beta_syn"),
    python("T_dust of zero", lambda: Dust(MAPS_QU, T_dust=0.0), "T_dust"),
    python("a unit that is none", lambda: unit_factor("K_CMB", "parsec"), "parsec"),
    python("kelvin of no kind", lambda: unit_factor("K", "uK_RJ", 44.0), "'K'"),
    python("a unit that needs a frequency", lambda: unit_factor("K_CMB", "uK_RJ"), "at"),
]  # fmt: skip

ROWS = [*MAPS, *DAMAGED, *BANDPASSES, *STRICT, *TOGETHER, *PYTHON]


def state(folder: Path) -> dict[str, str]:
    """Hashes of all files in a folder."""
    return {
        str(path): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.given.replace("/", "."))
def test_right_or_refused(row, tmp_path):
    read = row.make(tmp_path)
    before = state(tmp_path)
    if not row.refused:
        found = read()
        if row.right is not None:
            row.right(found)
    else:
        # TypeError is that of arguments in Python; the border has sentences of its own.
        with pytest.raises((ValueError, TypeError)) as caught:
            read()
        message = str(caught.value)
        for word in row.refused:
            assert word in message, message
        assert message.endswith("."), message
        assert "\n" not in message, message
    assert state(tmp_path) == before


def test_table_is_long_enough():
    assert len(ROWS) >= 150
    assert len({row.given for row in ROWS}) == len(ROWS)
