"""Add small scales to templates by extrapolating their spectra, as in the paper.

A template is trusted up to the join, the upper end of the range over which a power law is fitted
to its spectrum; beyond it, the sky is assumed to follow the power law. Up to the join the
template's beam is divided out. Beyond, the beam stays, and the template is scaled down where it
exceeds the power law: the paper's templates are noise there, and the law takes precedence also
where a template's spectrum is merely curved. What is missing is filled with a Gaussian realisation
times a modulation, the normalised polarized intensity, so that the mean spectrum of the sum is the
power law: at each multipole the injected power is the extrapolation minus that of the template,
never negative.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxsky.arrays import Map, Scalar, Spectrum
from jaxsky.checks import (
    Parameter,
    as_array,
    as_number,
    check_finite,
    check_not_negative,
    check_positive,
    check_shape,
)
from jaxsky.cmb import Spectra, gaussian_fields, repair
from jaxsky.harmonics import (
    NEGLIGIBLE,
    analysis,
    expand,
    gaussian_beam,
    lmax_of,
    power_spectrum,
    resample,
    resize,
    shortened,
    synthesis,
)
from jaxsky.noise import positive_root


class SmallScales(eqx.Module):
    """How small scales continue a template.

    Parameters
    ----------
    EE, BB : ranges of l over which the power laws are fitted, four multipoles from l = 2 on at
        least; their upper ends are the joins
    slope : slopes of the laws of E and B, instead of the fitted ones; one number serves both
    tilt : added to the slopes; negative is steeper. The pivot is the join.
    amplitude : of the injected map; 1 makes the mean spectrum continuous
    modulation_fwhm : beam with which the modulating polarized intensity is smoothed [arcmin]

    Raises
    ------
    TypeError, ValueError
        For ranges that are no integers or too short, and numbers that are not finite or negative.
    """

    EE: tuple[int, int] = eqx.field(static=True)
    BB: tuple[int, int] = eqx.field(static=True)
    slope: Float[Array, "2"] | None = None
    tilt: Parameter = 0.0
    amplitude: Parameter = 1.0
    modulation_fwhm: Parameter = 180.0

    def __post_init__(self) -> None:
        for name in ("EE", "BB"):
            ends = getattr(self, name)
            if [type(end) for end in ends] != [int, int]:
                raise TypeError(f"Argument `{name}` must be two integers, but is {ends!r}.")
            if not 2 <= ends[0] <= ends[1] - 3:
                raise ValueError(
                    f"Argument `{name}` must span four multipoles from l = 2 on, but is {ends!r}."
                )
            setattr(self, name, tuple(ends))
        if self.slope is not None:
            slope = as_array("slope", self.slope)
            check_shape("slope", slope, slope.shape in ((), (2,)), "be a number or 2 numbers")
            check_finite("slope", slope)
            self.slope = jnp.broadcast_to(slope, 2)
        for name in ("tilt", "amplitude", "modulation_fwhm"):
            positive = name == "modulation_fwhm"
            setattr(self, name, as_number(name, getattr(self, name), positive))
        check_not_negative("amplitude", self.amplitude)


class PowerLaw(NamedTuple):
    """C_l = exp(log_amplitude) (l / pivot)^slope, with the covariance of the two numbers."""

    log_amplitude: Scalar
    slope: Scalar
    covariance: Float[Array, "2 2"]
    pivot: int

    def __call__(self, lmax: int) -> Spectrum:
        """Return C_l for l = 0 ... lmax, zero below l = 2."""
        ell = jnp.arange(lmax + 1)
        log = jnp.log(jnp.maximum(ell, 1) / self.pivot)
        return jnp.where(ell < 2, 0.0, jnp.exp(self.log_amplitude + self.slope * log))


def fit_power_law(spectrum: Spectrum, lmin: int, lmax: int) -> PowerLaw:
    """Fit a straight line to log C_l against log l by least squares, each l alike, as in the paper.

    From lmin to lmax, both included; lmax is the pivot. Errors are from the scatter about the line.
    """
    if not 2 <= lmin <= lmax - 3 or lmax >= len(spectrum):
        raise ValueError(
            f"A power law cannot be fitted from l = {lmin} to {lmax} to a spectrum that ends at "
            f"{len(spectrum) - 1}; it needs four multipoles from l = 2 on."
        )
    part = spectrum[lmin : lmax + 1]
    check_positive("spectrum", part)
    log = jnp.log(jnp.arange(lmin, lmax + 1) / lmax)
    (slope, log_amplitude), covariance = jnp.polyfit(log, jnp.log(part), 1, cov=True)
    return PowerLaw(log_amplitude, slope, covariance[::-1, ::-1], lmax)


class Extrapolation(NamedTuple):
    """The EE and BB spectra of a template and of its continuation, without any beam.

    `measured` are the template's spectra divided by its squared beam, up to its own lmax, `laws`
    the power laws fitted to them, `target` those with the slope and tilt asked for, and `injected`
    the spectra of the small scales. `transfer` are factors on the template's coefficients that
    take out its beam up to the joins and scale it down to the law beyond.
    """

    measured: Float[Array, "2 ell_in"]
    laws: tuple[PowerLaw, ...]
    target: Float[Array, "2 ell"]
    transfer: Float[Array, "2 ell_in"]
    injected: Float[Array, "2 ell"]


def extrapolate(
    alm: Float[Array, "2 alm"], own: ArrayLike, small: SmallScales, lmax: int
) -> Extrapolation:
    """Continue the spectra of a template, E and B as far as they are known, of beam `own`."""
    known = lmax_of(alm)
    beam = gaussian_beam(own, known)
    # Beyond the joins the beam is not divided out: it may leave no signal there.
    seen, power = beam > NEGLIGIBLE, power_spectrum(alm)
    measured = jnp.where(seen, power / jnp.where(seen, beam, 1.0) ** 2, 0.0)
    ell = jnp.arange(known + 1)
    laws, target, transfer, there = [], [], [], []
    for i, (lmin, join) in enumerate((small.EE, small.BB)):
        law = fit_power_law(measured[i], lmin, join)
        slope = law.slope if small.slope is None else small.slope[i]
        laws.append(law)
        target.append(law._replace(slope=slope + small.tilt)(lmax))
        allowed = jnp.pad(target[i], (0, max(0, known - lmax)))[: known + 1]
        kept = power[i] / beam[join] ** 2
        excess = kept / jnp.where(allowed > 0, allowed, 1.0)
        beyond = 1 / beam[join] / jnp.sqrt(jnp.maximum(excess, 1.0))
        transfer.append(jnp.where(ell <= join, 1 / jnp.where(ell <= join, beam, 1.0), beyond))
        # Where the template is scaled down to the law, exactly nothing is missing.
        there.append(jnp.where(excess >= 1, allowed, kept))
    both = min(known, lmax) + 1
    missing = jnp.stack(target).at[:, :both].add(-jnp.stack(there)[:, :both])
    joins = jnp.array([[small.EE[1]], [small.BB[1]]])
    injected = jnp.where(jnp.arange(lmax + 1) > joins, jnp.maximum(missing, 0.0), 0.0)
    return Extrapolation(measured, tuple(laws), jnp.stack(target), jnp.stack(transfer), injected)


def modulation(maps: Float[Array, "2 pix"], fwhm: ArrayLike, nside: int) -> Map:
    """Return the polarized intensity of Q, U over its mean, smoothed by a beam [arcmin]."""
    # Unlike the paper's "normalised version of the template", Q over its mean, it has one sign.
    intensity = positive_root(jnp.sum(maps**2, axis=0))
    window = shortened(gaussian_beam(fwhm, 2 * healpy.npix2nside(maps.shape[-1])))
    return resample(intensity[None], window, nside)[0] / intensity.mean()


def _correlated_parts(
    alms: Float[Array, "field alm"], parts: Sequence[Extrapolation], small: Sequence[SmallScales]
) -> tuple[Float[Array, "field alm"], Spectra]:
    """Continue several templates so that they stay as correlated as they are.

    Each cross-spectrum is extrapolated with its correlation coefficient over the range of the fits.
    Where field i is still known and j is not, j gets a part proportional to i: T_ij / T_ii times
    the coefficients of i, where T are the target spectra, multiplied by the fraction known of i (in
    power) and missing of j (in amplitude). Returns these parts, and the spectra of what is still
    missing, to be drawn, given the coefficients that are kept, without beams.
    """
    ranges = [ends for how in small for ends in (how.EE, how.BB)]
    lmin, lmax = max(first for first, _ in ranges), min(join for _, join in ranges)
    if lmin > lmax:
        raise ValueError(
            f"Correlated small scales need ranges that overlap, but they are {ranges}."
        )
    law = jnp.concatenate([part.target for part in parts])
    n, ell = len(alms), jnp.arange(law.shape[-1])
    beyond = ell > jnp.array([[join] for _, join in ranges])
    products = (alms * expand(jnp.where((ell >= lmin) & (ell <= lmax), 1.0, 0.0))) @ alms.T
    scale = jnp.sqrt(jnp.diagonal(products))
    rho = (products / (scale[:, None] * scale))[..., None]
    kept = jax.vmap(lambda one: jax.vmap(lambda other: power_spectrum(one, other))(alms))(alms)
    power = jnp.einsum("iil->il", kept)
    auto = jnp.where(beyond, law, power)
    root, other = positive_root(auto), ~jnp.eye(n, dtype=bool)[..., None]
    continued = other & (beyond[:, None] | beyond)
    wanted = jnp.where(continued, rho * root[:, None] * root, kept)
    wanted = jnp.where(other, wanted, auto[:, None])
    known = power / jnp.where(auto > 0, auto, 1.0)
    share = jnp.where(beyond, 1 - positive_root(jnp.minimum(known, 1.0)), 0.0)[:, None] * known
    borrowed = jnp.where(other, share * wanted / jnp.where(auto > 0, auto, 1.0), 0.0)
    added = jnp.stack([sum(expand(borrowed[j, i]) * alms[i] for i in range(n)) for j in range(n)])
    mixing = borrowed + jnp.eye(n)[..., None]
    missing = wanted - jnp.einsum("ijl,jkl,mkl->iml", mixing, kept, mixing)
    # Rounding residuals where nothing is missing would have arbitrary correlations.
    there = beyond & (jnp.einsum("iil->il", missing) > NEGLIGIBLE * auto)
    return added, jnp.where(there[:, None] & there, missing, 0.0)


class Continued(NamedTuple):
    """Templates with small scales (E, B without any beam), and the spectra that they follow."""

    alms: list[Float[Array, "2 alm"]]
    parts: list[Extrapolation]
    repaired: Int[Array, ""]  # multipoles at which the matrix of spectra had to be repaired


def continue_templates(
    key: Array,
    maps: Sequence[Float[Array, "2 pix"]],
    own: Sequence[ArrayLike],
    small: Sequence[SmallScales],
    nside: int,
    lmax: int | None = None,
) -> Continued:
    """Continue templates (Q, U) to small scales, correlated with each other if there are several.

    With a fixed key the result is differentiable in slopes, tilts, amplitudes, beams and maps. The
    small scales of E and B of a single template are independent. Several templates keep their
    correlation coefficients, E with B and template with template (the paper's dust and AME, after
    Brown & Battye 2011), and share the mean of their modulations; where one is known to higher
    multipoles than another, the other is correlated with it there. The spectra are divided by the
    mean square of the modulation, so that the modulated maps have the extrapolated spectra.

    `own` are the beams of the templates [arcmin], `nside` the resolution at which small scales are
    modulated, `lmax` the largest multipole of the result, by default 2 nside. With another nside
    or lmax a key gives different small scales.
    """
    lmax = 2 * nside if lmax is None else lmax
    parts, stay, gains = [], [], []
    for each, beam, how in zip(maps, own, small, strict=True):
        if jnp.ndim(each) != 2 or len(each) != 2:
            raise ValueError(
                "Small scales are added to maps of shape (2, pix), Q and U, not of shape "
                f"{jnp.shape(each)}."
            )
        # Up to the multipole that its pixels and beam resolve.
        window = shortened(gaussian_beam(beam, 2 * healpy.npix2nside(each.shape[-1])))
        alm = analysis(each, window.size - 1)
        parts.append(extrapolate(alm, beam, how, lmax))
        stay.append(resize(alm * expand(parts[-1].transfer), lmax))
        gains.append(modulation(each, how.modulation_fwhm, nside))
    if len(maps) == 1:
        borrowed, matrix = jnp.zeros_like(stay[0]), jnp.eye(2)[..., None] * parts[0].injected
    else:
        borrowed, matrix = _correlated_parts(jnp.concatenate(stay), parts, small)
    # The same for all: different modulations would make the maps less correlated than the fields.
    gain = sum(gains) / len(gains)
    matrix, repaired = repair(matrix / jnp.mean(gain**2))
    drawn = gaussian_fields(key, matrix)
    result = []
    for i, (template, how) in enumerate(zip(stay, small, strict=True)):
        added = analysis(gain * synthesis(drawn[2 * i : 2 * i + 2], nside), lmax)
        # Rises from 0 at half the join to 1 at the join; below that the template is unchanged.
        at = jnp.arange(lmax + 1) / jnp.asarray((how.EE[1], how.BB[1]))[:, None]
        added = expand(jnp.sin(jnp.pi / 2 * jnp.clip(2 * at - 1, 0, 1)) ** 2) * added
        result.append(template + how.amplitude * (added + borrowed[2 * i : 2 * i + 2]))
    return Continued(result, parts, repaired)
