"""Beams and rotations of maps in harmonic space, as PySM applies them."""

from typing import Any

import healpy
import numpy as np
from astropy import units as u

from jaxsky.public import takes_quantities

#: Steps and tolerance of the least-squares analysis, those of PySM.
STEPS, TOLERANCE = 10, 1e-7


def _multipoles(nside: int, output_nside: int) -> int:
    """Return PySM's highest multipole: 2.5 nside, or 1.5 nside where the resolution is reduced."""
    return int((1.5 if output_nside < nside else 2.5) * nside)


def _analysis(maps: np.ndarray, lmax: int, steps: int | None) -> np.ndarray:
    nside = healpy.get_nside(maps)
    if lmax <= 1.5 * nside:
        return np.asarray(healpy.map2alm(maps, lmax=lmax, use_pixel_weights=nside > 16))
    if steps == 0:
        return np.asarray(healpy.map2alm(maps, lmax=lmax, iter=0))
    steps = STEPS if steps is None else steps
    alm, _, _ = healpy.map2alm_lsq(maps, lmax, lmax, tol=TOLERANCE, maxiter=steps)
    return np.asarray(alm)


@takes_quantities
def apply_smoothing_and_coord_transform(
    input_map: u.Quantity,
    fwhm: u.Quantity | None = None,
    beam_window: np.ndarray | None = None,
    rot: healpy.Rotator | None = None,
    lmax: int | None = None,
    output_nside: int | None = None,
    output_car_resol: None = None,
    return_healpix: bool = True,
    return_car: bool = False,
    input_alm: bool = False,
    map2alm_lsq_maxiter: int | None = None,
    map_dist: None = None,
) -> u.Quantity:
    """Smooth maps of I, Q, U and rotate them, as PySM's function; HEALPix maps only.

    Parameters
    ----------
    input_map : I, Q, U with or without a unit, RING, shape (3, pix); or coefficients (`input_alm`)
    fwhm, beam_window : width of a Gaussian beam with its unit, or its window, shape (ell,) or
        (3, ell); not both
    rot : rotation of coordinates, such as healpy.Rotator(coord=("G", "C"))
    lmax : highest multipole; by default 2.5 nside of the input, and 1.5 nside where the output
        has a lower resolution
    output_nside : resolution of the result, by default that of the input
    input_alm : whether `input_map` are coefficients T, E, B of healpy, shape (3, alm)
    map2alm_lsq_maxiter : steps of the analysis by least squares beyond 1.5 nside, by default 10;
        0 for one transform without
    output_car_resol, return_healpix, return_car, map_dist : must be as by default

    Raises
    ------
    ValueError
        For what is not supported, two beams, or coefficients without `output_nside`.
    """
    refused: dict[str, Any] = {"output_car_resol": output_car_resol, "map_dist": map_dist}
    refused |= {"return_car": return_car, "return_healpix": not return_healpix}
    for name, value in refused.items():
        if value is not None and value is not False:
            raise ValueError(f"Argument `{name}` must be as by default: there is HEALPix only.")
    if fwhm is not None and beam_window is not None:
        raise ValueError("Arguments `fwhm` and `beam_window` exclude each other.")
    if input_alm and output_nside is None:
        raise ValueError("Argument `output_nside` is missing: `input_map` are coefficients.")
    values, unit = np.asarray(input_map), getattr(input_map, "unit", None)
    if input_alm:
        alm = values.copy()
    else:
        nside = healpy.get_nside(values)
        output_nside = output_nside or nside
        highest = lmax or _multipoles(nside, output_nside)
        alm = _analysis(values, highest, map2alm_lsq_maxiter)
    alm = _smoothed(alm, fwhm, beam_window)
    if rot is not None:
        alm = np.asarray(rot.rotate_alm(alm))
    maps = np.asarray(healpy.alm2map(alm, output_nside, pixwin=False))
    return u.Quantity(maps, unit, copy=False)


def _smoothed(alm: np.ndarray, fwhm: Any, beam_window: np.ndarray | None) -> np.ndarray:
    """Return coefficients seen through a beam."""
    if fwhm is not None:
        return np.asarray(healpy.smoothalm(alm, fwhm=u.Quantity(fwhm).to_value(u.rad), pol=True))
    if beam_window is None:
        return alm
    own = beam_window[: len(alm)] if np.ndim(beam_window) > 1 else beam_window
    windows = np.broadcast_to(own, (len(alm), np.shape(own)[-1]))
    return np.stack([healpy.almxfl(row, window) for row, window in zip(alm, windows, strict=True)])
