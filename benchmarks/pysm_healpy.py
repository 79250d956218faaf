"""COrE's maps with PySM 3 and healpy alone, without JAX: the peer of `jaxsky simulate`.

`python -m benchmarks.pysm_healpy FOLDER OUT` reads the files that `benchmarks.simulations` makes
and writes Q and U of each band at 60 arcmin, as one writes it with the two libraries: the
emission of PySM's sky and the CMB, smoothed by `healpy.smoothing`, and noise from
`healpy.synfast`, which has its window at no cost. `--lean` is the fastest that the two libraries
allow: CMB and noise stay in harmonic space, and Q and U are transformed without I.
"""

import argparse
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import healpy
import numpy as np
from pysm3 import Model, ModifiedBlackBody, PowerLaw, Sky
from pysm3 import units as u
from pysm3.utils import bandpass_unit_conversion

INSTRUMENTS = Path(__file__).parents[1] / "jaxsky" / "instruments.toml"
NU_DUST, NU_SYNCHROTRON, T_DUST = 353.0, 30.0, 21.0
BETA_DUST, BETA_SYN = 1.53, 3.1
SAMPLES, FWHM, ITERATIONS = 10, 60.0, 3


class Channel(NamedTuple):
    """A band of `instruments.toml`: [GHz], [GHz], [arcmin], [uK_RJ arcmin]."""

    name: str
    center: float
    width: float
    fwhm: float
    noise: float

    @property
    def band(self) -> tuple[u.Quantity, np.ndarray]:
        """Frequencies, and weights flat in antenna temperature: PySM's refer to Jy/sr."""
        nu = self.center + self.width * np.linspace(-0.5, 0.5, SAMPLES)
        return nu * u.GHz, nu**-2


def _channels() -> list[Channel]:
    bands = tomllib.loads(INSTRUMENTS.read_text())["core"]["bands"]
    return [
        Channel(b["name"], **b["bandpass"], fwhm=b["fwhm"], noise=b["noise"]["level"])
        for b in bands
    ]


def _read(path: Path, fields: int | tuple[int, ...]) -> np.ndarray:
    return healpy.read_map(path, fields, dtype=np.float64)


def _templates(folder: Path) -> list[np.ndarray]:
    """Q, U of dust and of synchrotron."""
    return [_read(folder / f"{name}.fits", (0, 1)) for name in ("dust", "synchrotron")]


def _models(templates: list[np.ndarray], indices: list[np.ndarray | float]) -> list[Model]:
    """PySM's models of dust and synchrotron, without intensity."""
    nside = healpy.npix2nside(templates[0].shape[-1])
    nothing = np.zeros(templates[0].shape[-1]) * u.uK_RJ
    (dust_q, dust_u), (synchrotron_q, synchrotron_u) = (maps * u.uK_RJ for maps in templates)
    beta_dust, beta_syn = indices
    return [
        ModifiedBlackBody(
            map_I=nothing,
            map_Q=dust_q,
            map_U=dust_u,
            freq_ref_I=NU_DUST * u.GHz,
            freq_ref_P=NU_DUST * u.GHz,
            map_mbb_index=beta_dust,
            map_mbb_temperature=T_DUST,
            unit_mbb_temperature="K",
            nside=nside,
        ),
        PowerLaw(
            map_I=nothing,
            map_Q=synchrotron_q,
            map_U=synchrotron_u,
            freq_ref_I=NU_SYNCHROTRON * u.GHz,
            freq_ref_P=NU_SYNCHROTRON * u.GHz,
            map_pl_index=-beta_syn,
            nside=nside,
        ),
    ]


def _analysis(maps: np.ndarray, lmax: int) -> np.ndarray:
    """E and B as `healpy.map2alm` gives them, which transforms I as well."""
    nside = healpy.npix2nside(maps.shape[-1])
    alm = np.array(healpy.map2alm_spin(maps, 2, lmax))
    for _ in range(ITERATIONS):
        alm += healpy.map2alm_spin(maps - healpy.alm2map_spin(alm, nside, 2, lmax), 2, lmax)
    return alm


def _smoothed(alm: np.ndarray, fwhm: float, lmax: int) -> np.ndarray:
    """E and B times the window of a beam [arcmin]."""
    window = healpy.gauss_beam(np.radians(fwhm / 60), lmax, pol=True)[:, 1]
    return np.stack([healpy.almxfl(row, window) for row in alm])


def _band_by_band(
    templates: list[np.ndarray], indices: list[np.ndarray | float], lmax: int
) -> Iterator[np.ndarray]:
    """Coefficients of the foregrounds in each band."""
    models = _models(templates, indices)
    for channel in _channels():
        yield _analysis(sum(model.get_emission(*channel.band).value[1:] for model in models), lmax)


def _scaled(
    templates: list[np.ndarray], indices: list[np.ndarray | float], lmax: int
) -> Iterator[np.ndarray]:
    """The same where the laws are constant: templates are transformed once, then scaled."""
    alms = [_analysis(maps, lmax) for maps in templates]
    units = _models([np.ones((2, 12))] * 2, indices)
    for channel in _channels():
        factors = [unit.get_emission(*channel.band).value[1, 0] for unit in units]
        yield sum(factor * alm for factor, alm in zip(factors, alms, strict=True))


def _plain(folder: Path, models: list[Model], lmax: int, foregrounds: bool) -> Iterator[np.ndarray]:
    """Q and U of each band by the libraries' own ways."""
    nside = models[0].nside
    sky = Sky(nside=nside, component_objects=models)
    fwhm = np.radians(FWHM / 60)
    white, zero = np.ones(lmax + 1), np.zeros(lmax + 1)
    if not foregrounds:
        spectra = healpy.read_cl(folder / "cmb.fits")[:, : lmax + 1]
        cmb = healpy.synfast(spectra, nside, lmax, new=True)
    for channel in _channels():
        maps = sky.get_emission(*channel.band).value
        if foregrounds:
            yield healpy.smoothing(maps, fwhm, lmax=lmax)[1:]
            continue
        maps += bandpass_unit_conversion(*channel.band, u.uK_RJ, u.uK_CMB).value * cmb
        level = np.radians(channel.noise / 60) ** 2 * white
        rest = np.radians(np.sqrt(FWHM**2 - channel.fwhm**2) / 60)
        noise = healpy.synfast([level, level, level, zero], nside, lmax, new=True, fwhm=rest)
        yield (healpy.smoothing(maps, fwhm, lmax=lmax) + noise)[1:]


def _lean(
    folder: Path,
    coefficients: Iterator[np.ndarray],
    nside: int,
    lmax: int,
    foregrounds: bool,
) -> Iterator[np.ndarray]:
    """Q and U of each band with one synthesis a band."""
    cmb = None if foregrounds else _cmb(folder, lmax)
    for channel, signal in zip(_channels(), coefficients, strict=True):
        alm = _smoothed(signal, FWHM, lmax)
        if cmb is not None:
            alm += bandpass_unit_conversion(*channel.band, u.uK_RJ, u.uK_CMB).value * cmb
            alm += _noise(channel, lmax)
        yield np.array(healpy.alm2map_spin(alm, nside, 2, lmax))


def _cmb(folder: Path, lmax: int) -> np.ndarray:
    """Coefficients E, B of a realisation [uK_CMB]."""
    spectra = healpy.read_cl(folder / "cmb.fits")[:, : lmax + 1]
    return _smoothed(np.array(healpy.synalm(spectra, lmax, new=True))[1:], FWHM, lmax)


def _noise(channel: Channel, lmax: int) -> np.ndarray:
    """Coefficients E, B of a channel's noise at the common resolution."""
    white = np.full(lmax + 1, np.radians(channel.noise / 60) ** 2)
    alm = np.array([healpy.synalm(white, lmax) for _ in range(2)])
    return _smoothed(alm, np.sqrt(FWHM**2 - channel.fwhm**2), lmax)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser("python -m benchmarks.pysm_healpy", description="The peer.")
    parser.add_argument("folder", type=Path, help="what `benchmarks.simulations` made")
    parser.add_argument("out", type=Path, help="folder for the maps, made here")
    parser.add_argument("--constant", action="store_true", help="indices that are numbers")
    parser.add_argument("--lean", action="store_true", help="the fewest and smallest transforms")
    parser.add_argument("--scaled", action="store_true", help="transform templates, then scale")
    parser.add_argument("--foregrounds", action="store_true", help="neither CMB nor noise")
    parser.add_argument("--lmax", type=int, help="by default healpy's, 3 nside - 1")
    arguments = parser.parse_args()
    if arguments.scaled and not (arguments.constant and arguments.lean):
        parser.error("--scaled needs --constant and --lean")
    return arguments


def main() -> None:
    arguments = _arguments()
    templates = _templates(arguments.folder)
    nside = healpy.npix2nside(templates[0].shape[-1])
    lmax = arguments.lmax or 3 * nside - 1
    indices: list[np.ndarray | float] = [BETA_DUST, BETA_SYN]
    if not arguments.constant:
        indices = [
            _read(arguments.folder / f"{name}.fits", 0) for name in ("beta_dust", "beta_syn")
        ]
    if arguments.lean:
        method = _scaled if arguments.scaled else _band_by_band
        coefficients = method(templates, indices, lmax)
        seen = _lean(arguments.folder, coefficients, nside, lmax, arguments.foregrounds)
    else:
        models = _models(templates, indices)
        seen = _plain(arguments.folder, models, lmax, arguments.foregrounds)
    arguments.out.mkdir()
    for channel, maps in zip(_channels(), seen, strict=True):
        healpy.write_map(
            arguments.out / f"{channel.name}.fits",
            maps,
            dtype=np.float32,
            coord="G",
            column_names=["Q", "U"],
            column_units="uK_RJ",
        )


if __name__ == "__main__":
    main()
