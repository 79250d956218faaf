"""Noise of maps for component separation: its weights, streamed over pixels."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxsky.checks import Numeric
from jaxsky.public import refuse_unit, takes_quantities

#: Pixels per pass.
CHUNK = 1 << 15
#: Ratios of sigma between bands that are constant to this accuracy make noise separable: smoothed
#: maps of the variance of uniform noise ring by 1e-7.
ROUNDING = 1e-6
#: A band that has less than this share of the weight of any component has none.
LEAST_SHARE = 1e-6


def chunks(npix: int, size: int = CHUNK) -> Iterator[slice]:
    """Slices that cover the pixels."""
    for start in range(0, npix, size):
        yield slice(start, min(start + size, npix))


@takes_quantities
def bare(name: str, value: object) -> np.ndarray:
    """A numeric array without a copy, in whatever precision it has."""
    refuse_unit(name, value)
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise TypeError(f"Argument `{name}` must be a real array, but is {array.dtype}.")
    return array


class Noise(NamedTuple):
    """Gaussian noise, independent between pixels and bands; see `as_noise`.

    There are standard deviations, with a factor on them in each pixel that is infinite where it is
    masked, or covariances of Q and U instead.
    """

    sigma: Float[np.ndarray, "band stokes #pix"] | None
    pixel_sigma: Float[np.ndarray, " pix"] | None = None
    covariance: Float[np.ndarray, "band 2 2 pix"] | None = None

    @property
    def separable(self) -> bool:
        """True if it is a number for each band and Stokes parameter times a map."""
        return self.sigma is not None and self.sigma.shape[-1] == 1

    def band_weights(self) -> Float[np.ndarray, "stokes band"]:
        """1 / sigma^2 where the noise is separable, without the factor of the pixel."""
        assert self.sigma is not None
        return (1 / self.sigma[..., 0] ** 2).T

    def pixel_weights(self, pixels: slice | np.ndarray) -> Float[np.ndarray, " pix"] | float:
        """1 / pixel_sigma^2 in some of the pixels."""
        if self.pixel_sigma is None:
            return 1.0
        return 1 / np.asarray(self.pixel_sigma[pixels], float) ** 2

    def weights(self, pixels: slice | np.ndarray) -> Float[np.ndarray, "stokes band #pix"]:
        """Inverse variances, or the diagonal of inverse covariances; 0 where masked."""
        if self.covariance is not None:
            (QQ, UU), determinant = self._elements(pixels)[:2]
            return np.stack([UU, QQ]) / determinant
        assert self.sigma is not None
        sigma = self.sigma if self.sigma.shape[-1] == 1 else self.sigma[..., pixels]
        weights = (1 / np.asarray(sigma, float) ** 2).swapaxes(0, 1)
        return weights * self.pixel_weights(pixels)

    def cross(self, pixels: slice | np.ndarray) -> Float[np.ndarray, "band pix"] | None:
        """Element QU of the inverse covariances; None if Q and U are independent."""
        if self.covariance is None:
            return None
        _, determinant, QU = self._elements(pixels)
        return -QU / determinant

    def heavy(
        self, used: Bool[np.ndarray, " pix"], squares: Float[np.ndarray, "band component"]
    ) -> Bool[np.ndarray, " band"]:
        """Bands that carry weight, from the pixels used and the squares of the laws."""
        weights = np.zeros(len(squares))
        for part in chunks(used.size):
            weights += (self.weights(part) * used[part]).sum(axis=(0, 2))
        share = weights[:, None] * squares
        return (share >= LEAST_SHARE * share.sum(axis=0)).any(axis=1)

    def number(
        self, used: Bool[np.ndarray, " pix"], bands: Bool[np.ndarray, " band"], stokes: int
    ) -> int:
        """Number of data in some bands and the pixels used."""
        if self.separable:
            return int(used.sum()) * int(bands.sum()) * stokes
        if self.covariance is not None:
            return 2 * int(np.isfinite(self.covariance[bands, 0, 0]).sum())
        return int(np.isfinite(self.sigma[bands]).sum())  # type: ignore[index]

    def _elements(self, pixels):
        assert self.covariance is not None
        block = np.asarray(self.covariance[..., pixels], float)
        masked = ~np.isfinite(block[:, 0, 0]) | ~np.isfinite(block[:, 1, 1])
        QQ, UU = (np.where(masked, 1.0, block[:, s, s]) for s in range(2))
        QU = np.where(masked, 0.0, block[:, 0, 1])
        determinant = np.where(masked, np.inf, QQ * UU - QU**2)
        return np.stack([QQ, UU]), determinant, QU


def as_noise(
    noise: Noise | Numeric,
    shape: tuple[int, int, int],
    pixel_sigma: Numeric | None = None,
) -> Noise:
    """Noise of data from standard deviations or covariances.

    Parameters
    ----------
    noise : standard deviations in the unit of the data, of shape (band,), (band, stokes) or
        (band, stokes, pix), infinite where masked; or covariances of Q and U (band, 2, 2, pix),
        with an infinite diagonal where masked
    shape : (band, stokes, pix) of the data
    pixel_sigma : factor on the standard deviations in each pixel, (pix,)

    Returns
    -------
    The noise. Standard deviations whose ratios between bands and Stokes parameters are the same
    in all pixels are recognised as such: it makes the likelihood independent of the pixels.
    """
    if isinstance(noise, Noise):
        return noise
    array = bare("noise", noise)
    bands, stokes, npix = shape
    known = [(bands,), (bands, stokes), shape, (bands, 2, 2, npix)]
    if array.shape not in known or (array.ndim == 4 and stokes != 2):
        shapes = "(band,), (band, stokes), (band, stokes, pix) or, for Q and U, (band, 2, 2, pix)"
        raise ValueError(
            f"Argument `noise` must have shape {shapes} for data of shape {shape}, "
            f"but has shape {array.shape}."
        )
    pixel = None if pixel_sigma is None else bare("pixel_sigma", pixel_sigma)
    if pixel is not None:
        if pixel.shape != (npix,) or array.ndim > 2:
            raise ValueError(
                f"Argument `pixel_sigma` must have shape ({npix},) and go with `noise` of shape "
                f"(band,) or (band, stokes), but they have shapes {pixel.shape} and {array.shape}."
            )
        _check_positive("pixel_sigma", pixel)
    if array.ndim == 4:
        return _covariance(array)
    _check_positive("noise", array)
    if array.ndim < 3:
        if not np.isfinite(array).all():
            raise ValueError("Argument `noise` must be finite for a whole band; leave it out.")
        sigma = array.reshape(bands, -1)[..., None]
        return Noise(np.broadcast_to(sigma, (bands, stokes, 1)), pixel)
    return _separated(array) or Noise(array)


def _check_positive(name: str, sigma: np.ndarray) -> None:
    if bad := int(sigma.size - np.sum(sigma > 0)):
        raise ValueError(f"Argument `{name}` has {bad} of {sigma.size} values that are not > 0.")


def _separated(sigma: np.ndarray) -> Noise | None:
    """The noise as separable noise, if it is."""
    first = sigma[0, 0]
    finite = np.isfinite(first)
    if not finite.any():
        return None
    at = int(np.argmax(finite))
    ratio = (sigma[:, :, at] / first[at])[..., None]
    if not np.isfinite(ratio).all():
        return None
    for part in chunks(sigma.shape[-1]):
        expected = ratio * first[part]
        with np.errstate(invalid="ignore"):
            off = np.abs(sigma[..., part] - expected) > ROUNDING * expected
        if off.any() or np.any(np.isfinite(sigma[..., part]) != finite[part]):
            return None
    return Noise(ratio, first)


def _covariance(covariance: np.ndarray) -> Noise:
    noise = Noise(None, None, covariance)
    bad = 0
    for part in chunks(covariance.shape[-1]):
        (QQ, UU), determinant, _ = noise._elements(part)
        block = covariance[..., part]
        asymmetric = np.isfinite(determinant) & (block[:, 0, 1] != block[:, 1, 0])
        bad += int(np.sum(~((QQ > 0) & (UU > 0) & (determinant > 0)) | asymmetric))
    if bad:
        size = covariance.shape[0] * covariance.shape[-1]
        raise ValueError(
            f"Argument `noise` is not positive definite in {bad} of {size} values (band, pix)."
        )
    return noise
