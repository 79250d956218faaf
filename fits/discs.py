"""The paper's small patches of the sky: discs at high latitude, and the field of BICEP2.

A disc does not mix orders m about its middle, so what it does to harmonics can be said exactly.
"""

from collections.abc import Iterator
from typing import NamedTuple

import ducc0
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsky.harmonics import alm_to_healpy, gaussian_beam, lmax_of, smooth

#: Radius of the paper's discs: 400 square degrees.
RADIUS = 11.3
#: FWHM of the Gaussian with which masks are smoothed [deg].
APODIZATION = 2.0
#: The field of BICEP2 and Keck: right ascension within +-50 deg, declination -65 to -50 deg.
BICEP2 = (50.0, -65.0, -50.0)
#: Part of a mask's variance that may depend on longitude about its middle for it to be a disc.
ASYMMETRY = 1e-3
#: Part of a symmetric mask's largest value that counts as nothing.
NOTHING = 1e-5
#: Orders m of harmonics that are held at a time.
CHUNK = 32


class Patch(NamedTuple):
    """A part of the sky.

    Parameters
    ----------
    name : for tables and pictures
    lon, lat : Galactic coordinates of its middle [deg]
    mask : weight of each pixel, RING
    """

    name: str
    lon: float
    lat: float
    mask: Float[np.ndarray, " pix"]


def disc_centers(nside: int = 4, latitude: float = 45.0) -> Float[np.ndarray, "2 disc"]:
    """Galactic longitude and latitude [deg] of pixels at |b| above a latitude.

    The paper has 48 discs there, and names the pixels of nside 8; 48 are those of nside 4, while
    nside 8 has 224.
    """
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    return np.stack([lon, lat])[:, np.abs(lat) > latitude]


def _smoothed_disc(radius: float, fwhm: float, angle: np.ndarray) -> np.ndarray:
    """A disc of ones smoothed by a Gaussian, at angles from its middle [deg]; closed form."""
    lmax = int(np.ceil(6.0 / np.radians(fwhm) * np.sqrt(8 * np.log(2)))) if fwhm else 0
    ell = np.arange(lmax + 2)
    legendre = np.polynomial.legendre.legvander(np.array([np.cos(np.radians(radius))]), lmax + 2)[0]
    # 2 pi int P_l over the disc, times (2l+1)/4 pi of the sum over harmonics
    coefs = np.empty(lmax + 2)
    coefs[0] = (1 - legendre[1]) / 2
    coefs[1:] = (legendre[ell[1:] - 1] - legendre[ell[1:] + 1]) / 2
    window = np.asarray(gaussian_beam(60 * fwhm, lmax + 1))
    return np.polynomial.legendre.legval(np.cos(np.radians(angle)), coefs * window)


def disc_mask(
    nside: int, lon: float, lat: float, radius: float = RADIUS, fwhm: float = APODIZATION
) -> Float[np.ndarray, " pix"]:
    """A disc smoothed by a Gaussian.

    Parameters
    ----------
    nside : resolution
    lon, lat : Galactic coordinates of its middle [deg]
    radius : of the disc [deg]
    fwhm : of the Gaussian [deg]; what it leaves below 1e-5 is zero
    """
    if not (np.isfinite(lon) and -90 <= lat <= 90):
        raise ValueError(
            f"Arguments `lon` and `lat` must be a direction in degrees, not {lon} and {lat}."
        )
    if not 0 < fwhm <= radius <= 180:
        raise ValueError(
            f"Argument `fwhm`, {fwhm:g} deg, must be positive and not wider than the disc's "
            f"`radius`, {radius:g} deg."
        )
    middle = healpy.ang2vec(lon, lat, lonlat=True)
    reach = radius + 2 * fwhm
    near = healpy.query_disc(nside, middle, np.radians(reach))
    directions = np.stack(healpy.pix2vec(nside, near))
    across = np.linalg.norm(np.cross(middle, directions, axisb=0), axis=-1)
    angle = np.degrees(np.arctan2(across, middle @ directions))
    grid = np.linspace(0, reach, 4000)
    profile = _smoothed_disc(radius, fwhm, grid)
    profile = np.where(profile > 1e-5, np.minimum(profile, 1.0), 0.0)
    mask = np.zeros(healpy.nside2npix(nside))
    mask[near] = np.interp(angle, grid, profile)
    return mask


def bicep2_mask(nside: int, fwhm: float = APODIZATION) -> Float[np.ndarray, " pix"]:
    """The field of BICEP2 and Keck, smoothed as the discs are."""
    lon, lat = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)), lonlat=True)
    ra, dec = healpy.Rotator(coord=["G", "C"])(lon, lat, lonlat=True)
    half, south, north = BICEP2
    inside = (np.abs((ra + 180) % 360 - 180) < half) & (dec > south) & (dec < north)
    mask = np.asarray(smooth(inside[None].astype(float), 60 * fwhm))[0]
    return np.where(mask > 1e-3, np.minimum(mask, 1.0), 0.0)


def paper_patches(nside: int) -> Iterator[Patch]:
    """The paper's 48 discs at |b| > 45 deg, and the field of BICEP2."""
    for lon, lat in disc_centers().T:
        yield Patch(f"l {lon:.0f}, b {lat:.0f}", lon, lat, disc_mask(nside, lon, lat))
    lon, lat = healpy.Rotator(coord=["C", "G"])(0.0, -57.5, lonlat=True)
    yield Patch("BICEP2", float(lon), float(lat), bicep2_mask(nside))


def zonal(alm: Float[np.ndarray, " alm"]) -> Float[np.ndarray, " ell"] | None:
    """Coefficients a_l0 of a mask about its own middle, or None if it depends on longitude, too.

    Parameters
    ----------
    alm : packed coefficients of the mask
    """
    lmax = lmax_of(alm)
    # The middle is where the dipole points to; a mask without one has none.
    x, y, z = -alm[lmax + 1], alm[lmax + 2], alm[1]
    if np.hypot(np.hypot(x, y), z) < 1e-6 * abs(alm[0]):
        x, y, z = 0.0, 0.0, 1.0
    angles = -np.arctan2(y, x), -np.arctan2(np.hypot(x, y), z), 0.0
    turned = ducc0.sht.rotate_alm(alm_to_healpy(alm, lmax), lmax, *angles, nthreads=0)
    coefs = turned[: lmax + 1].real
    whole = np.sum(alm**2)
    return coefs if whole - np.sum(coefs**2) < ASYMMETRY * whole else None


def ring_functions(
    spin: int, lmax: int, theta: Float[np.ndarray, " ring"], orders: Int[np.ndarray, " m"]
) -> Float[np.ndarray, "2 m ell ring"]:
    """How harmonics depend on colatitude, in ducc0's signs; sums of squares integrate to 1.

    The maps of E = 1 are the first times exp(i m phi), and i times the second. Those of spin 0
    have the first only.

    Parameters
    ----------
    spin : of the maps, 0, 1 or 2
    lmax : largest multipole
    theta : colatitudes [rad]
    orders : orders m
    """
    values = np.zeros((2, orders.size, lmax + 1, theta.size))
    starts = np.arange(orders.size) * (lmax + 1)
    m, mstart = orders.astype(np.uintp), starts.astype(np.uintp)
    for ell in range(max(spin, int(orders.min())), lmax + 1):
        alm = np.zeros((1 + (spin > 0), orders.size * (lmax + 1)), complex)
        alm[0, (starts + ell)[orders <= ell]] = 1
        leg = ducc0.sht.alm2leg(
            alm=alm, lmax=lmax, spin=spin, theta=theta, mval=m, mstart=mstart, nthreads=0
        )
        values[0, :, ell] = leg[0].real.T
        if spin:
            values[1, :, ell] = leg[1].imag.T
    return values


def zonal_products(
    mask: Float[np.ndarray, "3 reach"],
    fields: Float[np.ndarray, "field 2 ell"],
    factors: Float[np.ndarray, "3 ell"] | None = None,
) -> Float[np.ndarray, "field field 2 ell 2 ell"]:
    """Half the covariance of pseudo-spectra EE, BB with a symmetric mask, for pairs of fields.

    Such a mask does not mix orders m. With K_m from the E and B of the sky to those of the masked
    map, G = K C K^T is their covariance at one order, and that of pseudo-spectra sum_m 2 G^2 /
    ((2 l + 1) (2 l' + 1)). Nothing is neglected but power beyond the last multipole.

    Parameters
    ----------
    mask : coefficients a_l0 of the mask and of its derivatives, as maps of spin 0, 1, 2
    fields : spectra EE, BB of each field
    factors : of the three terms of purified B; None leaves it as it is
    """
    lmax, reach = fields.shape[-1] - 1, mask.shape[1] - 1
    nodes = (2 * lmax + reach) // 2 + 1
    theta, weight = ducc0.misc.GL_thetas(nodes), ducc0.misc.GL_weights(nodes, 1)
    zero = np.zeros(1, int)
    rings = [row @ ring_functions(n, reach, theta, zero)[0, 0] for n, row in enumerate(mask)]
    size = sum(np.abs(row) / float(lmax) ** n for n, row in enumerate(rings))
    kept = size > NOTHING * size.max()
    theta, weight = theta[kept], weight[kept]
    value, first, second = (row[kept] for row in rings)
    sums = np.zeros((len(fields), len(fields), 2, lmax + 1, 2, lmax + 1))
    for orders in np.array_split(np.arange(lmax + 1), lmax // CHUNK + 1):
        # Q and -i U of E = 1 and of B = 1, up to a phase; (field, component, m, ell, ring).
        spin2 = ring_functions(2, lmax, theta, orders)
        sky = np.stack([spin2, spin2[::-1]])
        seen = sky * value
        if factors is not None:
            _, once, twice = factors[:, :, None]
            seen[1] -= once * first * ring_functions(1, lmax, theta, orders)[::-1]
            seen[1, 1] += twice * second * ring_functions(0, lmax, theta, orders)[0]
        low = max(int(orders[0]), 2)
        sky, seen = (np.moveaxis(x[..., low:, :], 2, 0) for x in (sky, seen * weight))
        count = np.where(orders == 0, 1.0, 2.0)  # those of -m are alike
        sums[:, :, :, low:, :, low:] += _squares(sky, seen, count, fields[..., low:])
    degrees = 2 * np.arange(lmax + 1) + 1
    return sums / (degrees[:, None, None] * degrees)


@jax.jit
def _squares(sky, seen, count, fields):
    """Products of the covariances of harmonics, summed over orders, for each pair of fields."""

    def add(total, of_order):
        sky, seen, count = of_order
        rings = jnp.einsum("jclr,xjl,jdls->xcrds", sky, fields, sky)
        covariance = jnp.einsum("iclr,xcrds,jdms->xiljm", seen, rings, seen)
        return total + count * covariance[:, None] * covariance, None

    n, _, ell = fields.shape
    return jax.lax.scan(add, jnp.zeros((n, n, 2, ell, 2, ell)), (sky, seen, count))[0]
