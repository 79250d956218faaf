"""COrE's maps with PySM 3 and healpy alone, without JAX: the peer of `jaxsky simulate`.

`python -m benchmarks.pysm_healpy FOLDER OUT` reads the files that `benchmarks.simulations` makes
and writes Q and U of each band at 60 arcmin. The templates are sharp, and noise is as sharp as
the pixels, so signal and noise need different windows. In harmonic space they have them at no
cost: there CMB and uniform noise are drawn, and a band takes one analysis and one synthesis.
Noise in pixels would take a second analysis; smoothing the signal to the band's beam and its sum
with the noise to the common one would take two of each.
"""

import argparse
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import healpy
import numpy as np
from pysm3 import Model, ModifiedBlackBody, PowerLaw
from pysm3 import units as u
from pysm3.utils import bandpass_unit_conversion

INSTRUMENTS = Path(__file__).parents[1] / "jaxsky" / "instruments.toml"
NU_DUST, NU_SYNCHROTRON, T_DUST = 353.0, 30.0, 21.0
BETA_DUST, BETA_SYN = 1.53, 3.1
SAMPLES, FWHM, ITERATIONS = 10, 60.0, 3


class Channel(NamedTuple):
    """A row of `instruments.toml`: [GHz], [GHz], [arcmin], [uK_RJ arcmin]."""

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
    return [Channel(*row) for row in tomllib.loads(INSTRUMENTS.read_text())["core"]["channels"]]


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
    parser.add_argument("--scaled", action="store_true", help="transform templates, then scale")
    parser.add_argument("--foregrounds", action="store_true", help="neither CMB nor noise")
    parser.add_argument("--lmax", type=int, help="by default healpy's, 3 nside - 1")
    arguments = parser.parse_args()
    if arguments.scaled and not arguments.constant:
        parser.error("--scaled needs --constant")
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
    foregrounds = (_scaled if arguments.scaled else _band_by_band)(templates, indices, lmax)
    cmb = None if arguments.foregrounds else _cmb(arguments.folder, lmax)
    arguments.out.mkdir()
    for channel, signal in zip(_channels(), foregrounds, strict=True):
        alm = _smoothed(signal, FWHM, lmax)
        if cmb is not None:
            alm += bandpass_unit_conversion(*channel.band, u.uK_RJ, u.uK_CMB).value * cmb
            alm += _noise(channel, lmax)
        healpy.write_map(
            arguments.out / f"{channel.name}.fits",
            healpy.alm2map_spin(alm, nside, 2, lmax),
            dtype=np.float32,
            coord="G",
            column_names=["Q", "U"],
            column_units="uK_RJ",
        )


if __name__ == "__main__":
    main()
