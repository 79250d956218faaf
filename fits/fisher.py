"""Forecast errors on spectral parameters and r from many bands, by a Fisher matrix.

Also the spectra of foregrounds, on which it is based, and the r that equals them.

E and B of the bands are Gaussian fields with the covariance

    C_l^ij = sum_cc' s_c^i s_c'^j C_l^cc' + delta_ij N_l^i / (b_l^i)^2,

with s_c^i the law of component c in band i (1 for the CMB, in uK_CMB), and C_l^cc' the spectra of
components: power laws in l with one correlation coefficient per pair, and for the CMB lensed
scalars plus r times tensors. Then F_ab = f_sky sum_l (2 l + 1) / 2 Tr(C^-1 dC_a C^-1 dC_b)
(Tegmark, Taylor & Heavens 1997, eq. 15), summed over E and B.

r is hardly correlated with the laws: the power of foregrounds left by a small error in a law is of
second order in that error. Variation of the laws over the sky is not in this model.

F is built from separate derivatives of the laws s and of the spectra C^cc', in an orthonormal basis
of the laws. Products of whole matrices would lose precision: foregrounds have up to 1e8 times the
variance of the noise, and small differences tell the parameters apart.
"""

import itertools
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fits.mixing import Mixing
from fits.pseudo_cl import FIELDS, PIVOT, MaskedSpectra, band_powers
from jaxsky import Sky, get_parameters, parameter_names
from jaxsky.checks import check_double
from jaxsky.harmonics import beam_ratio
from jaxsky.observation import ObservedBand
from jaxsky.sky import unknown_parameter

#: Combinations of parameters that change the data by less than this, relative to each parameter
#: alone, count as degenerate.
LEAST_CHANGE = 1e-9
#: Parameters with less than this share of such a combination are not part of it.
LEAST_SHARE = 0.01
#: Rounding error of the eigenvalues of correlations.
ROUNDING = 1e-12
#: Bins whose middle is up to this multipole count as the reionisation bump.
REIONISATION = 10


class ForecastModel(eqx.Module):
    """All that the covariance of bands depends on besides its parameters.

    `mixing` is that of foregrounds of amplitude 1 in one pixel (`unit_sky`), in uK_CMB; `weights`
    are b_l over the noise [1 / (uK_CMB rad)]; `tensors` (for r = 1) and lensed `scalars` are C_l
    [uK_CMB^2] of the fields, "EE", "BB" or both; and `sky_fraction` scales the number of modes.
    """

    mixing: Mixing
    weights: Float[Array, "ell band"]
    tensors: Float[Array, "field ell"]
    scalars: Float[Array, "field ell"]
    ell: Float[Array, " ell"]
    sky_fraction: Float[Array, ""]
    fields: tuple[str, ...] = eqx.field(static=True)

    @property
    def sky(self) -> Sky:
        """The foregrounds."""
        return self.mixing.sky


class Errors(NamedTuple):
    """Forecast errors on the free parameters about their fiducial values.

    The covariance, in the order of `free`, includes the priors, and so does `sigma`, the standard
    deviation of each parameter with all others free; `known` is that with all others known.
    """

    free: tuple[str, ...]
    fiducial: dict[str, float]
    sigma: dict[str, float]
    covariance: Float[np.ndarray, "par par"]
    known: dict[str, float]
    priors: dict[str, float]

    def correlation(self, first: str, second: str) -> float:
        """Return the correlation coefficient of two parameters."""
        i, j = self.free.index(first), self.free.index(second)
        return float(self.covariance[i, j] / (self.sigma[first] * self.sigma[second]))


def _correlations(params: Mapping[str, Any], field: str, components: Sequence[str]) -> list[list]:
    """Return the matrix of correlation coefficients of components, as rows."""
    rows: list[list[Any]] = [[1.0] * len(components) for _ in components]
    for (i, first), (j, second) in itertools.combinations(enumerate(components), 2):
        rows[i][j] = rows[j][i] = params[f"{field}.{first}.{second}.correlation"]
    return rows


def fiducial(
    sky: Sky, foregrounds: Mapping[str, float], r: float, A_lens: float
) -> dict[str, float]:
    """Return all parameters of the covariance by name, with their values.

    `foregrounds` are the parameters of spectra: "BB.dust.amplitude" (D_l at l = 80, uK_RJ^2 at the
    reference frequency), "BB.dust.slope" (of C_l), and for each pair of components
    "BB.dust.synchrotron.correlation". `A_lens` is the fraction of the lensing BB that is left.
    """
    components = list(sky)
    for field in sorted({name.split(".")[0] for name in foregrounds}):
        matrix = np.array(_correlations(foregrounds, field, components))
        if (least := np.linalg.eigvalsh(matrix).min()) < -ROUNDING:
            pairs = [
                f"{a} x {b} {foregrounds[f'{field}.{a}.{b}.correlation']:.3g}"
                for a, b in itertools.combinations(components, 2)
            ]
            raise ValueError(
                f"The correlations of {field}, {', '.join(pairs)}, are those of no sky (their "
                f"matrix has the eigenvalue {least:.2g}); use more of the sky, or a wider range of "
                "multipoles."
            )
    values = get_parameters(sky, parameter_names(sky))  # amplitudes and tables have several axes
    laws = {name: float(value) for name, value in values.items() if value.ndim < 2}
    return {"r": r, "A_lens": A_lens, **laws, **foregrounds}


def _laws(params: Mapping[str, Array], model: ForecastModel) -> Float[Array, "band component"]:
    """Return each component of unit amplitude in each band [uK_CMB], the CMB last."""
    sky = model.mixing.laws(params)
    polarized = jnp.stack([one.template[-1, 0] for one in sky.components.values()])
    return jnp.pad(model.mixing.one(params) * polarized, ((0, 0), (0, 1)), constant_values=1.0)


def _spectra(
    params: Mapping[str, Array], model: ForecastModel
) -> Float[Array, "field ell component component"]:
    """Return the spectra C_l of the components [uK_RJ^2], the CMB last [uK_CMB^2]."""
    names, found = list(model.sky), []

    def root(name: str) -> Float[Array, " ell"]:
        C = 2 * jnp.pi / (PIVOT * (PIVOT + 1)) * params[f"{name}.amplitude"]
        return jnp.sqrt(C) * (model.ell / PIVOT) ** (params[f"{name}.slope"] / 2)

    for field, tensors, scalars in zip(model.fields, model.tensors, model.scalars, strict=True):
        roots = jnp.stack([root(f"{field}.{name}") for name in names])
        rho = jnp.array(_correlations(params, field, names))
        foregrounds = jnp.einsum("ij,il,jl->lij", rho, roots, roots)
        lensing = params["A_lens"] if field == "BB" else 1.0
        cmb = params["r"] * tensors + lensing * scalars
        found.append(jnp.pad(foregrounds, ((0, 0), (0, 1), (0, 1))).at[:, -1, -1].set(cmb))
    return jnp.stack(found)


def _columns(weights, modes, spectra, d_spectra, laws, d_laws):
    """Return a vector per parameter; their inner products are F at one l of one field.

    With G = Q R the laws over the noise and B the spectra, the covariance over the noise is
    1 + G B G^T, which is M = 1 + R B R^T in the basis Q and 1 outside it. Derivatives have a part
    inside, and one that connects inside and outside, twice. The CMB is the last column of G, so
    that R keeps it apart from foregrounds of far more power.
    """
    Q, R = jnp.linalg.qr(weights[:, None] * laws)
    d_laws = weights[:, None] * d_laws
    M = jnp.eye(len(R)) + R @ spectra @ R.T
    root = jnp.linalg.cholesky(M)
    along = jnp.einsum("ik,pic->pkc", Q, d_laws)
    half = along @ spectra @ R.T
    inside = half + half.mT + R @ d_spectra @ R.T
    across = (d_laws - Q @ along) @ spectra @ R.T

    def whiten(rows):
        return jax.vmap(lambda x: jax.scipy.linalg.solve_triangular(root, x.T, lower=True).T)(rows)

    inside, across = whiten(whiten(inside).mT), whiten(across)
    parts = [part.reshape(len(part), -1) for part in (inside, jnp.sqrt(2.0) * across)]
    return jnp.sqrt(modes) * jnp.concatenate(parts, axis=-1)


@partial(jax.jit, static_argnames="free")
def _root(
    params: Mapping[str, Array], model: ForecastModel, free: tuple[str, ...]
) -> Float[Array, "par par"]:
    """Return a triangular root of the Fisher matrix, F = root^T root."""

    def parts(theta):
        values = {**params, **dict(zip(free, theta, strict=True))}
        return _laws(values, model), _spectra(values, model)

    theta = jnp.stack([params[name] for name in free])
    laws, spectra = parts(theta)
    d_laws, d_spectra = jax.tree.map(lambda x: jnp.moveaxis(x, -1, -3), jax.jacfwd(parts)(theta))
    modes = model.sky_fraction * (2 * model.ell + 1) / 2
    over_ell = jax.vmap(partial(_columns, laws=laws, d_laws=d_laws))
    columns = jax.vmap(partial(over_ell, model.weights, modes))(spectra, d_spectra)
    return jnp.linalg.qr(jnp.moveaxis(columns, -2, -1).reshape(-1, len(free)), mode="r")


def fisher_errors(
    model: ForecastModel,
    params: Mapping[str, float],
    free: Sequence[str],
    priors: Mapping[str, float] | None = None,
) -> Errors:
    """Return errors on free parameters, with all others in `params` fixed.

    Parameters
    ----------
    model : what is observed
    params : all parameters, from `fiducial`
    free : names of those that are free
    priors : standard deviations of Gaussian priors, by name

    Raises
    ------
    RuntimeError, KeyError
        Without double precision; for names that do not exist.
    ValueError
        For a prior of a parameter that is not free, spectra that no sky can have, and degenerate
        parameters, which it names.
    """
    check_double("A Fisher matrix")
    free, priors = tuple(free), dict(priors or {})
    for name in (*free, *priors):
        if name not in params:
            raise unknown_parameter(name, params)
    for name in priors:
        if name not in free:
            raise ValueError(f"The prior of {name!r} has no effect, as that is not free.")
    values = {name: jnp.asarray(value, float) for name, value in params.items()}
    root = np.asarray(_root(values, model, free))
    if not np.isfinite(root).all():
        raise ValueError(
            "The covariance of the bands is not positive definite; an amplitude is negative, or a "
            "correlation is not within -1 to 1."
        )
    rows = [np.eye(len(free))[free.index(name)] / sigma for name, sigma in priors.items()]
    root = np.concatenate([root, *np.reshape(rows, (1, -1, len(free)))])
    size = np.linalg.norm(root, axis=0)
    if blind := [name for name, s in zip(free, size, strict=True) if s == 0]:
        raise ValueError(f"Nothing that is observed depends on {', '.join(blind)}.")
    # Of F = V s^2 V^T, relative to the size of each parameter.
    _, singular, vectors = np.linalg.svd(root / size)
    singular = np.pad(singular, (0, len(free) - len(singular)))
    if len(null := vectors[singular < LEAST_CHANGE]):
        part = np.abs(null).max(axis=0) > LEAST_SHARE
        names = [name for name, within in zip(free, part, strict=True) if within]
        raise ValueError(
            f"The bands do not tell these parameters apart: {', '.join(names)}; hold "
            f"{'one' if len(null) == 1 else len(null)} of them, or give priors."
        )
    scaled = vectors.T / singular
    covariance = scaled @ scaled.T / np.outer(size, size)
    sigma, known = (
        dict(zip(free, each.tolist(), strict=True))
        for each in (np.sqrt(np.diag(covariance)), 1 / size)
    )
    at = {name: float(params[name]) for name in free}
    return Errors(free, at, sigma, covariance, known, priors)


class BandLaw(NamedTuple):
    """A power law of band powers: D_l = amplitude (l / 80)^(slope + 2), and C_l ~ l^slope."""

    amplitude: float
    slope: float


def noise_weights(band: ObservedBand, lmax: int) -> Float[np.ndarray, " ell"]:
    """Return the beam over the noise of Q and U in a band, b_l / sqrt(N_l) [1 / (uK_CMB rad)].

    Its inverse square is the noise; where that varies, its inverse variance is averaged.
    """
    noise = np.asarray(band.noise)
    level = noise * np.radians(1 / 60)
    if noise.ndim:
        pixel = healpy.nside2resol(healpy.npix2nside(noise.shape[-1]))
        level = pixel / np.sqrt(np.mean([1 / noise[-2, -2], 1 / noise[-1, -1]]))
    level = level * float(band.band.conversion("uK_RJ", "uK_CMB"))
    return np.asarray(beam_ratio(band.beam, 0.0, lmax)) / level


def _modes(spectra: MaskedSpectra) -> Float[np.ndarray, " bin"]:
    """Return the number of modes in each bin, 2 l + 1 per multipole."""
    return np.diff(np.square(spectra.edges)).astype(float)


def _inside(spectra: MaskedSpectra, fit: tuple[int, int], what: str) -> np.ndarray:
    """Return True for the bins within the multipoles of a fit, or raise if they are too few."""
    edges = np.array(spectra.edges)
    inside = (edges[:-1] >= fit[0]) & (edges[1:] - 1 <= fit[1])
    if inside.sum() < 3:
        raise ValueError(
            f"The law of {what} takes three bins, but {inside.sum()} of those from l = {edges[0]} "
            f"to {edges[-1] - 1} are within the `fit` from {fit[0]} to {fit[1]}."
        )
    return inside


def fit_law(
    spectra: MaskedSpectra, powers: Float[np.ndarray, " bin"], fit: tuple[int, int], what: str
) -> BandLaw:
    """Fit a straight line to log D_b against log l, with bins weighted by their number of modes.

    `fit` is the first and last multipole of the bins that are fitted; `what` is named in messages.
    """
    inside = _inside(spectra, fit, what)
    D, ell = powers[inside], spectra.centers[inside]
    if D.min() <= 0:
        raise ValueError(
            f"The law of {what} takes positive band powers, but at l = {ell[D.argmin()]:g} that is "
            f"{D.min():.3g}; give another range or wider bins."
        )
    weights = np.sqrt(_modes(spectra)[inside])
    slope, logarithm = np.polyfit(np.log(ell / PIVOT), np.log(D), 1, w=weights)
    return BandLaw(float(np.exp(logarithm)), float(slope) - 2)


def foreground_laws(
    sky: Sky, spectra: MaskedSpectra, fields: Sequence[str], fit: tuple[int, int]
) -> dict[str, float]:
    """Return the power laws of the components' spectra and the correlation of each pair, by name.

    The names are those of `fiducial`. A correlation is the mean coefficient of the bins that are
    fitted, weighted by their number of modes.
    """
    maps = {name: sky[name].amplitude for name in sky}
    auto = {name: band_powers(spectra, values) for name, values in maps.items()}
    pairs = itertools.combinations(maps, 2)
    cross = {(a, b): band_powers(spectra, maps[a], maps[b]) for a, b in pairs}
    inside = _inside(spectra, fit, "foregrounds")
    found: dict[str, float] = {}
    for field in fields:
        row = FIELDS.index(field)
        for name, D in auto.items():
            law = fit_law(spectra, D[row], fit, f"{field} of {name!r}")
            found |= {f"{field}.{name}.{kind}": value for kind, value in law._asdict().items()}
        for (a, b), D in cross.items():
            first, second = auto[a][row, inside], auto[b][row, inside]
            coefficients = D[row, inside] / np.sqrt(first * second)
            rho = np.average(coefficients, weights=_modes(spectra)[inside])
            found[f"{field}.{a}.{b}.correlation"] = float(rho)
    return found


def equal_r(
    spectra: MaskedSpectra,
    powers: Float[np.ndarray, "2 bin"],
    law: BandLaw,
    tensors: Float[np.ndarray, "4 ell"],
) -> dict[str, float]:
    """Return the r whose primordial BB equals a band's foregrounds, at l = 80 and at reionisation.

    At l = 80 the foregrounds are those of the power law; at reionisation, the band powers of the
    lowest bins are compared with those of tensors. `tensors` are C_l of TT, EE, BB, TE for
    r = 1 [uK_CMB^2], up to `spectra.lmax` and 80; `law` was fitted to BB.
    """
    primordial = PIVOT * (PIVOT + 1) / (2 * np.pi) * tensors[2, PIVOT]
    found = {f"l = {PIVOT}": float(law.amplitude / primordial)}
    low = spectra.centers <= REIONISATION
    if low.any():
        binned = np.einsum("bjl,jl->b", spectra.windows[1], tensors[1:3, : spectra.lmax + 1])
        weights = _modes(spectra)[low]
        found["reionisation"] = float(weights @ powers[1, low] / (weights @ binned[low]))
    return found
