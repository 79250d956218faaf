"""Simulated observations next to PySM 3 and healpy: the command, transforms, long runs."""

import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from statistics import median

import healpy
import jax
import jax.numpy as jnp
import numpy as np
from astropy.io import fits as pyfits

from benchmarks import pysm_healpy as peer
from benchmarks.table import Row, time_text
from benchmarks.timing import Usage, interleave, seconds, usage
from jaxsky.cmb import camb_spectra, gaussian_fields, repair
from jaxsky.galaxy import embedded_sky
from jaxsky.harmonics import (
    alm_ell,
    alm_from_healpy,
    analysis,
    expand,
    gaussian_beam,
    power_spectrum,
    smooth,
    synthesis,
)
from jaxsky.io import read_maps, write_maps
from jaxsky.observation import load_instrument

JAXSKY = str(Path(sys.executable).with_name("jaxsky"))
#: Multipoles whose power of CMB and noise is compared, in a map of 1 degree.
POWER_RANGE = slice(100, 250)

galaxy = cache(embedded_sky)


def _index(seed: int, mean: float, spread: float, fwhm: float, nside: int) -> np.ndarray:
    """A smooth random map of an index."""
    white = np.random.default_rng(seed).standard_normal((1, 12 * nside**2))
    smoothed = np.asarray(smooth(white, fwhm))
    return mean + spread * (smoothed - smoothed.mean()) / smoothed.std()


def _write_inputs(folder: Path, nside: int) -> None:
    """The files that both sides read; where indices vary, they do as in the paper."""
    sky = galaxy(nside)
    maps = {
        "dust": (sky.dust[1:], ["Q", "U"], "uK_RJ"),
        "synchrotron": (sky.synchrotron[1:], ["Q", "U"], "uK_RJ"),
        "beta_dust": (_index(1, 1.53, 0.05, 180.0, nside), ["BETA"], ""),
        "beta_syn": (_index(2, 3.0, 0.1, 600.0, nside), ["BETA"], ""),
    }
    for name, (values, names, unit) in maps.items():
        write_maps(folder / f"{name}.fits", np.asarray(values), names=names, unit=unit)
    healpy.write_cl(folder / "cmb.fits", camb_spectra(3 * nside), column_units="uK_CMB^2")


def _component(name: str, law: str, nu_ref: float, **parameters: str) -> str:
    lines = "\n".join(f"{key} = {value}" for key, value in parameters.items())
    return f"""
[sky.{name}]
law = "{law}"
file = "{name}.fits"
fields = ["Q", "U"]
nu_ref = {nu_ref}
[sky.{name}.parameters]
{lines}
"""


def _write_settings(
    folder: Path, nside: int, fwhm: float, channels: str = "", varying: bool = False
) -> Path:
    """Settings of the command for these files."""

    def index(name, number):
        return f'{{ file = "{name}.fits", fields = ["BETA"], unit = "" }}' if varying else number

    beta_dust = index("beta_dust", peer.BETA_DUST)
    beta_syn = index("beta_syn", peer.BETA_SYN)
    path = folder / "experiment.toml"
    path.write_text(
        f"[simulate]\nsheet = false\nnside = {nside}\nfwhm = {fwhm}\n"
        f'[[bands]]\ninstrument = "core"\nsamples = {peer.SAMPLES}\n{channels}'
        + _component("dust", "dust", peer.NU_DUST, T_dust=peer.T_DUST, beta_dust=beta_dust)
        + _component("synchrotron", "synchrotron", peer.NU_SYNCHROTRON, beta_syn=beta_syn)
        + '[cmb]\nfile = "cmb.fits"\n'
    )
    return path


class _Beside:
    """Both sides on the same files, each run in a process and a folder of its own."""

    def __init__(self, folder: Path, nside: int, varying: bool) -> None:
        folder.mkdir()
        _write_inputs(folder, nside)
        self.folder, self.names = folder, tuple(load_instrument("core"))
        self.settings = _write_settings(folder, nside, peer.FWHM, varying=varying)
        self.options = [] if varying else ["--constant"]
        self.runs = 0

    def _out(self) -> Path:
        self.runs += 1
        return self.folder / str(self.runs)

    def ours(self, *options: str) -> tuple[Usage, Path]:
        """A run of the command, and where its maps are."""
        out = self._out()
        return _command(self.settings, out, *options), out / "sim_00000"

    def ours_double(self) -> Usage:
        """A run of the command in double precision."""
        return _command(self.settings, self._out(), "--set", "simulate.precision=double")

    def theirs(self, *options: str) -> tuple[Usage, Path]:
        """A run of the peer, and where its maps are."""
        out = self._out()
        line = [sys.executable, "-m", "benchmarks.pysm_healpy", str(self.folder), str(out)]
        return usage([*line, *self.options, *options]), out

    def _maps(self, run: tuple[Usage, Path]) -> list[np.ndarray]:
        folder = run[1]
        return [read_maps(folder / f"{name}.fits", fields=["Q", "U"]).maps for name in self.names]

    def agreement(self) -> tuple[float, float]:
        """Largest difference of foregrounds, and of the power of CMB and noise (other draws)."""
        ours, total = self._maps(self.ours("--only", "foregrounds")), self._maps(self.ours())
        theirs, their_total = self._maps(self.theirs("--foregrounds")), self._maps(self.theirs())
        difference = max(np.std(y - x) / np.std(x) for x, y in zip(ours, theirs, strict=True))
        rest = [_power(b - a) for a, b in zip(ours, total, strict=True)]
        their_rest = [_power(b - a) for a, b in zip(theirs, their_total, strict=True)]
        power = max(abs(np.mean(x / y) - 1) for x, y in zip(rest, their_rest, strict=True))
        return float(difference), float(power)


def _command(settings: Path, out: Path, *options: str) -> Usage:
    return usage([JAXSKY, "simulate", str(settings), "--out", str(out), *options])


def _pace(out: Path) -> float:
    """Seconds from one map of a simulation to the next."""
    written = sorted(path.stat().st_mtime for path in out.glob("sim_*/*.fits"))
    return float(np.median(np.diff(written)))


def _power(maps: np.ndarray) -> np.ndarray:
    """Mean spectrum of E and B."""
    alm = analysis(jnp.asarray(maps), POWER_RANGE.stop)
    return np.asarray(power_spectrum(alm).mean(axis=0))[POWER_RANGE]


def _beside_pysm(quick: bool, varying: bool, target: float) -> list[Row]:
    nside, small = (128, 128) if quick else (512, 256)
    with tempfile.TemporaryDirectory() as folder:
        difference, power = _Beside(Path(folder) / "small", small, varying).agreement()
        beside = _Beside(Path(folder) / "large", nside, varying)
        first, maps = beside.ours()
        lmax = pyfits.getval(maps / f"{beside.names[0]}.fits", "LMAX", 1)
        theirs, _ = beside.theirs()
        second, _ = beside.ours()
        variants = {
            f"lmax {lmax} as here": ["--lmax", str(lmax)],
            "CMB and noise in harmonic space, without I": ["--lean"],
        }
        if not varying:
            variants["besides, templates transformed once, then scaled"] = ["--lean", "--scaled"]
        others = {name: beside.theirs(*options)[0] for name, options in variants.items()}
        double = beside.ours_double()
        runs = [first, second, beside.ours()[0]]
    wall, peak = median(run.seconds for run in runs), median(run.peak for run in runs)
    ratio, memory = theirs.seconds / wall, theirs.peak / peak
    remarks = [
        f"{time_text(theirs.seconds)} / {time_text(wall)} "
        f"(runs {', '.join(time_text(run.seconds) for run in runs)}; in double precision "
        f"{time_text(double.seconds)}, {double.peak:.2f} GiB)",
        *(
            f"with {name} {time_text(run.seconds)}, {run.seconds / wall:.1f}x, "
            f"{run.peak / peak:.1f}x in memory"
            for name, run in others.items()
        ),
        f"at nside {small} foregrounds differ by {difference:.0e} of their rms in the worst band, "
        f"mean power of CMB and noise (other draws) by {power:.1%}",
    ]
    which = "beta maps" if varying else "constant indices"
    work = f"COrE, 15 bands at 60 arcmin, {which}, nside {nside}, cold process: PySM 3, healpy"
    rows = [
        Row(
            f"{work} / `jaxsky simulate`",
            f"{ratio:.1f}x",
            f">= {target:.0f}x",
            ratio >= target and difference <= 1e-3 and power < 0.05,
            "; ".join(remarks),
        )
    ]
    sizes = f"{theirs.peak:.2f} / {peak:.2f} GiB"
    rows.append(Row("the same: peak memory", f"{memory:.1f}x", ">= 2x", memory >= 2, sizes))
    return rows


def beta_maps(quick: bool) -> list[Row]:
    """Indices that vary from pixel to pixel."""
    return _beside_pysm(quick, True, 10)


def constant(quick: bool) -> list[Row]:
    """Indices that are the same everywhere."""
    return _beside_pysm(quick, False, 20)


def monte_carlo(quick: bool) -> list[Row]:
    """Realisations of CMB and noise with the same foregrounds."""
    nside, nsims = 64, 3 if quick else 100
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _write_inputs(folder, nside)
        settings = _write_settings(folder, nside, 120.0, 'channels = ["105", "225"]\n')
        run = _command(settings, folder / "out", "--nsims", str(nsims))
        pace = _pace(folder / "out")
    return [
        Row(
            f"`jaxsky simulate --nsims {nsims}`, two bands, nside {nside}, cold process",
            time_text(run.seconds),
            "< 30 s",
            run.seconds < 30,
            f"{time_text(pace)} a map; peak memory {run.peak:.2f} GiB",
        )
    ]


def high_resolution(quick: bool) -> list[Row]:
    """COrE with small scales at high resolution, one band in memory at a time."""
    return (
        [_core(128, 64, 60.0, 15)]
        if quick
        else [_core(2048, 512, 3.0, 15), _core(4096, 512, 3.0, 3)]
    )


def _core(nside: int, template: int, finest: float, number: int) -> Row:
    """The highest bands of COrE, with beams of `finest` [arcmin] at least."""
    small = (20, 60) if nside < 512 else (100, 600)
    channels = list(load_instrument("core").items())[-number:]
    bands = "".join(
        f'[[bands]]\nname = "{n}"\ninstrument = "core"\nfwhm = {max(float(c.beam), finest)}\n'
        for n, c in channels
    )
    scales = "".join(
        f"[sky.{name}.small_scales]\nEE = {list(small)}\nBB = {list(small)}\n"
        for name in ("dust", "synchrotron")
    )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = folder / "experiment.toml"
        settings.write_text(
            f"[simulate]\nnside = {nside}\n[sky.embedded]\nnside = {template}\n{scales}{bands}"
        )
        run = _command(settings, folder / "out")
        pace = _pace(folder / "out")
        file = folder / "out" / "sim_00000" / f"{channels[0][0]}.fits"
        lmax = pyfits.getval(file, "LMAX", 1)
    return Row(
        f"`jaxsky simulate`, {number} bands of COrE with beams of at least {finest:g} "
        f"arcmin, small scales on templates of nside {template}, nside {nside}: peak memory",
        f"{run.peak:.1f} GiB",
        "<= 16 GiB",
        run.peak <= 16,
        f"{time_text(pace)} a band, {time_text(run.seconds)} in all; l <= {lmax}",
    )


def _band_limited(nside: int) -> tuple[np.ndarray, np.ndarray]:
    """Maps Q, U of a white spectrum up to 2 nside, and their coefficients."""
    lmax = 2 * nside
    alm = np.random.default_rng(5).standard_normal((2, (lmax + 1) ** 2))
    alm[:, alm_ell(lmax) < 2] = 0  # a field of spin 2 has none
    return np.asarray(synthesis(jnp.asarray(alm), nside)), alm


def _error(values: np.ndarray, exact: np.ndarray) -> float:
    """rms of the difference, relative."""
    return float(np.sqrt(np.mean((np.asarray(values) - exact) ** 2) / np.mean(exact**2)))


def smoothing(quick: bool) -> list[Row]:
    """Smoothing a map of polarization, next to healpy."""
    nside = 64 if quick else 512
    maps, alm = _band_limited(nside)
    lmax, zero = 2 * nside, np.zeros(maps.shape[-1])
    exact = np.asarray(synthesis(alm * expand(gaussian_beam(60.0, lmax)), nside))
    sigma = np.radians(1) / np.sqrt(8 * np.log(2))

    def theirs(lmax=None):
        return healpy.smoothing([zero, *maps], fwhm=np.radians(1), lmax=lmax)

    calls: dict[str, Callable] = {
        "ours": lambda: smooth(maps, 60.0),
        "healpy": theirs,
        "equal": lambda: theirs(lmax),
    }
    errors = {"ours": _error(calls["ours"](), exact)}
    for name in ("healpy", "equal"):
        # healpy's polarized beam is larger by this at all multipoles.
        errors[name] = _error(calls[name]()[1:] / np.exp(2 * sigma**2), exact)
    times = interleave(calls, 2 if quick else 5)
    ratio = times.ratio("healpy", "ours")
    return [
        Row(
            f"smoothing Q, U to 1 degree, nside {nside}: healpy / jaxsky",
            f"{ratio:.1f}x",
            ">= 8x",
            ratio >= 8 and errors["ours"] <= errors["healpy"],
            f"{time_text(times['healpy'])} / {time_text(times['ours'])}, errors "
            f"{errors['healpy']:.0e} and {errors['ours']:.0e}; healpy with lmax {lmax} "
            f"{times.ratio('equal', 'ours'):.1f}x, error {errors['equal']:.0e}; healpy "
            "transforms I as well",
        )
    ]


def transform(quick: bool) -> list[Row]:
    """Analysis of a band-limited map, next to healpy with its three iterations."""
    nside = 64 if quick else 512
    maps, alm = _band_limited(nside)
    lmax, zero = 2 * nside, np.zeros(maps.shape[-1])
    calls = {
        "ours": lambda: analysis(maps, lmax),
        "healpy": lambda: healpy.map2alm([zero, *maps], lmax=lmax, iter=3),
        "default": lambda: healpy.map2alm([zero, *maps], iter=3),
    }
    error = _error(calls["ours"](), alm)
    theirs = _error(alm_from_healpy(calls["healpy"]()[1:], lmax), alm)
    times = interleave(calls, 2 if quick else 5)
    ratio = times.ratio("ours", "healpy")
    return [
        Row(
            f"analysis of Q, U with l <= {lmax}, nside {nside}: jaxsky / healpy, iter=3",
            f"{ratio:.2f}x, error {error:.0e}",
            "<= 1/3, 1e-6",
            ratio <= 1 / 3 and error <= 1e-6,
            f"{time_text(times['ours'])} / {time_text(times['healpy'])}; healpy's error "
            f"{theirs:.0e}; it transforms I as well; with its default lmax "
            f"{time_text(times['default'])}, {times.ratio('ours', 'default'):.2f}x",
        )
    ]


def growth(quick: bool) -> list[Row]:
    """Time of smoothing against nside."""
    nsides = (16, 32, 64) if quick else (64, 128, 256, 512, 1024)
    rng = np.random.default_rng(6)
    maps = {nside: rng.standard_normal((2, 12 * nside**2)) for nside in nsides}
    calls = {nside: lambda m=m: smooth(m, 60.0) for nside, m in maps.items()}
    for call in calls.values():
        jax.block_until_ready(call())
    times = interleave(calls, 2 if quick else 5)
    slope = np.polyfit(np.log(nsides), np.log([times[nside] for nside in nsides]), 1)[0]
    return [
        Row(
            f"smoothing Q, U to 1 degree, nside {nsides[0]} to {nsides[-1]}",
            f"{time_text(times[nsides[0]])} to {time_text(times[nsides[-1]])}",
            remarks=", ".join(f"{nside}: {time_text(times[nside])}" for nside in nsides)
            + f"; nside^{slope:.1f}",
        )
    ]


def correlated_alm(quick: bool) -> list[Row]:
    """Correlated fields E, B of dust and AME, with matrices that need repair."""
    lmax = 255 if quick else 2047
    ell = np.maximum(np.arange(lmax + 1), 2)
    # Extrapolated cross-spectra exceed what the auto-spectra allow, as in the paper.
    cross = 1.1 * (ell / lmax) ** 0.2
    both = np.array([[np.ones(lmax + 1), cross], [cross, np.ones(lmax + 1)]])
    matrix = np.einsum("abl,ij->aibjl", both, np.eye(2)).reshape(4, 4, -1)
    spectra = jnp.asarray(matrix * (ell / 100) ** -2.4)

    def ours():
        mended, repaired = repair(spectra)
        return gaussian_fields(jax.random.key(0), mended), repaired

    first = seconds(ours)
    repaired = int(ours()[1])
    time = interleave({"ours": ours}, 3)["ours"]
    return [
        Row(
            f"correlated coefficients of dust and AME, four fields, l <= {lmax}",
            time_text(time),
            "< 5 s",
            time < 5,
            f"{repaired} multipoles repaired; first call {time_text(first)}",
        )
    ]
