"""The embedded sky: a model of the Galaxy's polarized emission that needs no download.

Synchrotron and thermal dust are integrated along the line of sight through a spiral magnetic
field (Page et al. 2007, ApJS 170, 335) with a turbulent part drawn from a seed (Planck
intermediate results XLIV, 2016; Vansyngel et al. 2017), and scaled to the polarized brightness
of the real sky. The maps look like the sky on large scales and have structure on all scales, but
they are a model and not data.

Coordinates are Galactic Cartesian [kpc] with the Galactic centre at the origin: x from the Sun
to the centre (l = 0), y towards l = 90 degrees, z to the north, so the Sun is at x = -r_sun. The
cylindrical r, phi, z are right-handed on them; at the Sun phi_hat points to l = 270 degrees. The
sign of the field itself is not observable here.
"""

import dataclasses
from functools import partial

import equinox as eqx
import healpy
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsky.arrays import STOKES, stokes_rows
from jaxsky.checks import (
    Parameter,
    as_number,
    check_choice,
    check_not_negative,
    check_nside,
    check_seed,
)
from jaxsky.components import Dust, Synchrotron
from jaxsky.harmonics import degrees, resample, synthesis
from jaxsky.sky import Sky

#: Standard deviations of Q and U over the observed sky at nside 64 [uK_RJ], added in quadrature.
DUST_RMS, SYNCHROTRON_RMS = np.hypot(14.7, 6.8), np.hypot(17.2, 9.1)
#: Resolution at which the maps are scaled and up to which the turbulence is normalised.
NSIDE_SCALE = 64
#: Intrinsic polarization fraction of synchrotron, (p + 1)/(p + 7/3) for electrons E^-p, p = 3.
SYNCHROTRON_FRACTION = 0.75
#: Steps along the line of sight; with these the maps have converged to about 1e-3 of their rms.
STEPS = 96
#: Pixels integrated at once.
BLOCK = 12 * 32**2
#: The steps are equal in ln(1 + s / STEP_SCALE), from the Sun to s = FARTHEST [kpc].
STEP_SCALE, FARTHEST = 0.1, 30.0
#: Distances of the shells of independent turbulence [kpc].
SHELLS = 0.05 * 3.0 ** np.arange(6)
#: Within this distance of its axis the Galaxy's field turns vertical [kpc].
CORE = 0.5


class GalaxyModel(eqx.Module):
    """Parameters of the Galaxy's magnetic field, emitting matter and turbulence.

    Parameters
    ----------
    psi0, psi1 : angle of the field to the azimuthal direction [deg], psi0 + psi1 ln(r / r_sun)
    chi0, chi_height : [deg] and [kpc]; the angle to the Galactic plane is chi0 tanh(z / chi_height)
    r_sun : distance of the Sun from the Galactic centre [kpc]
    electron_radius, electron_height : scale lengths of the cosmic-ray electrons [kpc]
    dust_radius, dust_height : scale lengths of the dust [kpc]; with the defaults the polarized
        rms falls with latitude as on the observed sky, 16-fold from |b| < 10 to above 45 deg
    p0 : intrinsic polarization fraction of the dust, about 0.2 (Planck int. results XX, 2015)
    turbulence : rms of the turbulent field relative to the regular one; 0.9 in Planck XLIV
    coherence : length of the turbulence along the line of sight [kpc]. A shell at distance s,
        as deep as it is far away, averages about s / coherence cells, so the rms there is
        turbulence / sqrt(1 + s / coherence).
    slope : exponent of the turbulence's power spectrum, C_l ~ l^slope for l >= 2
    """

    psi0: Parameter = 27.0
    psi1: Parameter = 0.9
    chi0: Parameter = 25.0
    chi_height: Parameter = 1.0
    r_sun: Parameter = 8.0
    electron_radius: Parameter = 5.0
    electron_height: Parameter = 1.0
    dust_radius: Parameter = 6.0
    dust_height: Parameter = 0.2
    p0: Parameter = 0.2
    turbulence: Parameter = 0.9
    coherence: Parameter = 0.3
    slope: Parameter = -2.4

    def __post_init__(self) -> None:
        any_sign = ("psi0", "psi1", "chi0", "turbulence", "slope")
        for name in (field.name for field in dataclasses.fields(self)):
            setattr(self, name, as_number(name, getattr(self, name), name not in any_sign))
        check_not_negative("turbulence", self.turbulence)


class EmbeddedSky(eqx.Module):
    """I, Q, U of dust and synchrotron at their reference frequencies [uK_RJ], by `embedded_sky`."""

    dust: Float[Array, "3 pix"]
    synchrotron: Float[Array, "3 pix"]
    seed: int = eqx.field(static=True)

    nu_dust, nu_synchrotron = 353.0, 30.0  #: reference frequencies [GHz]

    @property
    def description(self) -> str:
        """A sentence that describes the maps, for headers and captions."""
        return (
            "Model of the Galaxy (not data): line-of-sight integral through the spiral magnetic "
            "field of Page et al. (2007) with Gaussian turbulence, "
            f"seed {self.seed}, scaled to the polarized rms of the real sky."
        )

    @property
    def nside(self) -> int:
        """Resolution of the maps."""
        return healpy.npix2nside(self.dust.shape[-1])

    def sky(self, stokes: str = "QU") -> Sky:
        """Return a sky ("QU", "I" or "IQU") with the paper's baseline spectral parameters."""
        check_choice("stokes", stokes, STOKES.values())
        rows = stokes_rows(stokes)
        dust = Dust(self.dust[rows], nu_ref=self.nu_dust)
        synchrotron = Synchrotron(self.synchrotron[rows], nu_ref=self.nu_synchrotron)
        return Sky({"dust": dust, "synchrotron": synchrotron})


def magnetic_field(
    model: GalaxyModel, x: Float[Array, "..."], y: Float[Array, "..."], z: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Return the Cartesian components of the regular field, of strength 1, at x, y, z [kpc].

    The field follows logarithmic spiral arms,
    sin psi(r) cos chi(z) r_hat + cos psi(r) cos chi(z) phi_hat + sin chi(z) z_hat, eq. 9 of Page
    et al. (2007) with the first two terms as in the hammurabi code (Waelkens et al. 2009,
    A&A 495, 697). It points to l = 63 degrees near the Sun, close to the 70 that Planck XLIV
    measured; with sine and cosine exchanged it would point to 27. Within `CORE` of its axis, where
    a spiral has no direction, the field turns vertical.
    """
    r2 = x**2 + y**2 + 1e-12
    psi = jnp.deg2rad(model.psi0 + model.psi1 * jnp.log(jnp.sqrt(r2) / model.r_sun))
    chi = jnp.deg2rad(model.chi0 * jnp.tanh(z / model.chi_height))
    (sin_psi, cos_psi), (sin_chi, cos_chi) = _sine_and_cosine(psi), _sine_and_cosine(chi)
    horizontal = cos_chi * jnp.sqrt(-jnp.expm1(-r2 / CORE**2) / r2)
    vertical = cos_chi * jnp.exp(-r2 / (2 * CORE**2))
    radial, azimuthal = horizontal * sin_psi, horizontal * cos_psi
    return radial * x - azimuthal * y, radial * y + azimuthal * x, sin_chi + vertical


def _sine_and_cosine(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Return sine and cosine to a few roundings, several times faster than XLA's scalar code."""
    # The series at an eighth of the angle, doubled three times, with 1 - cos for cos.
    z = (x - 2 * np.pi * jnp.round(x / (2 * np.pi))) / 8
    square = z**2
    sine = versine = jnp.ones_like(x)
    for n in (156, 110, 72, 42, 20, 6):
        sine = 1 - square / n * sine
    for n in (182, 132, 90, 56, 30, 12):
        versine = 1 - square / n * versine
    sine, versine = z * sine, square / 2 * versine
    for _ in range(3):
        sine, versine = 2 * sine * (1 - versine), 2 * sine**2
    return sine, 1 - versine


def _density(r, z, r_sun, radius, height):
    """Return exp(-(r - r_sun)/radius) sech^2(z/height), which is 1 at the Sun."""
    falling = jnp.exp(-2 * jnp.abs(z) / height)
    return jnp.exp((r_sun - r) / radius) * 4 * falling / (1 + falling) ** 2


def _turbulence(key, slope, basis):
    """Draw Gaussian vector fields of rms 1 on each shell, in the local basis; (shell, 3, pix)."""
    nside = healpy.npix2nside(basis.shape[-1])
    ell, m, part = degrees(3 * nside - 1)
    # Drawn in the order of l, so a coefficient keeps its place when higher multipoles are added.
    place = ell**2 + jnp.maximum(2 * m - 1, 0) + part
    # The normalisation sums to the same multipole at every nside, so that all see one field.
    reference = jnp.arange(2, 3 * NSIDE_SCALE, dtype=basis.dtype)
    variance = jnp.sum((2 * reference + 1) / (4 * np.pi) * reference**slope)
    power = jnp.maximum(ell, 1).astype(basis.dtype) ** slope
    scale = jnp.where(ell >= 2, jnp.sqrt(power / (3 * variance)), 0.0)

    def component(index):
        # Always in single precision, so that a seed means one sky in either precision.
        white = jax.random.normal(jax.random.fold_in(key, index), ell.shape, jnp.float32)
        return synthesis((white[place] * scale)[None], nside)[0]

    def shell(index):
        cartesian = jax.lax.map(component, 3 * index + jnp.arange(3))
        return jnp.einsum("icp,cp->ip", basis, cartesian)

    return jax.lax.map(shell, jnp.arange(len(SHELLS)))


def _path(steps: int) -> dict[str, np.ndarray]:
    """Return distances and lengths of the steps [kpc], and the two shells around each."""
    step = np.log1p(FARTHEST / STEP_SCALE) / steps
    t = (np.arange(steps) + 0.5) * step
    s = STEP_SCALE * np.expm1(t)
    last = len(SHELLS) - 1
    u = np.clip(np.interp(np.log(s), np.log(SHELLS), np.arange(last + 1)), 0, last)
    near = np.minimum(u.astype(int), last - 1)
    # Cosine and sine, so that the variance of the sum is the same everywhere.
    angle = np.pi / 2 * (u - near)
    ds = STEP_SCALE * np.exp(t) * step
    return {"s": s, "ds": ds, "near": near, "cos": np.cos(angle), "sin": np.sin(angle)}


@partial(jax.jit, static_argnames="steps")
def _integrate(
    model: GalaxyModel, key: Array, angles: tuple[np.ndarray, np.ndarray], steps: int
) -> Float[Array, "2 3 pix"]:
    theta, phi = angles
    st, ct, sp, cp = jnp.sin(theta), jnp.cos(theta), jnp.sin(phi), jnp.cos(phi)
    rows = [ct * cp, ct * sp, -st], [-sp, cp, jnp.zeros_like(sp)], [st * cp, st * sp, ct]
    basis = jnp.array(rows)
    turbulence = _turbulence(key, model.slope, basis)

    def integral(pixels):
        """Integrate a few pixels, which stay in the processor's cache from step to step."""

        def add(total, step):
            return tuple(map(jnp.add, total, _emission(model, *pixels, step))), None

        # Six maps rather than one array, which XLA would fill in one pass per row.
        start = (jnp.zeros(pixels[0].shape[-1], basis.dtype),) * 6
        return jnp.stack(jax.lax.scan(add, start, _path(steps))[0])

    blocks = theta.size // min(theta.size, BLOCK)
    apart = [jnp.moveaxis(x.reshape(*x.shape[:2], blocks, -1), 2, 0) for x in (basis, turbulence)]
    return jnp.moveaxis(jax.lax.map(integral, tuple(apart)), 0, 1).reshape(2, 3, -1)


@jax.checkpoint
def _emission(model, basis, turbulence, step):
    """Return I, Q, U of dust and of synchrotron from one step along the line of sight."""
    x, y, z = basis[2] * step["s"]
    x = x - model.r_sun
    Bx, By, Bz = magnetic_field(model, x, y, z)
    near, far = turbulence[step["near"]], turbulence[step["near"] + 1]
    rms = model.turbulence / jnp.sqrt(1 + step["s"] / model.coherence)
    random = rms * (step["cos"] * near + step["sin"] * far)
    Bt, Bp, Bs = (
        e[0] * Bx + e[1] * By + e[2] * Bz + part for e, part in zip(basis, random, strict=True)
    )
    across = Bt**2 + Bp**2
    fraction = model.p0 / (across + Bs**2)
    # Polarized perpendicular to the field: along theta_hat (Q > 0) for a field along phi_hat.
    Q, U = Bp**2 - Bt**2, -2 * Bt * Bp
    # Kept away from zero, where its derivative is not defined.
    r = jnp.sqrt(x**2 + y**2 + 1e-12)
    dust = _density(r, z, model.r_sun, model.dust_radius, model.dust_height)
    electrons = _density(r, z, model.r_sun, model.electron_radius, model.electron_height)
    dust, electrons = dust * step["ds"], electrons * step["ds"]
    polarized = SYNCHROTRON_FRACTION * electrons
    return (
        dust * (1 + model.p0 * 2 / 3 - fraction * across),
        dust * fraction * Q,
        dust * fraction * U,
        electrons * across,
        polarized * Q,
        polarized * U,
    )


def _check(nside: int, seed: int, steps: int) -> None:
    check_seed("seed", seed)
    for name, value in {"nside": nside, "steps": steps}.items():
        if not isinstance(value, int | np.integer) or isinstance(value, bool):
            raise TypeError(f"Argument `{name}` must be an int, but is {value!r}.")
    check_nside("nside", nside)
    if steps < 1:
        raise ValueError(f"Argument `steps` must be positive, but is {steps}.")


def line_of_sight(
    model: GalaxyModel, nside: int, seed: int = 0, *, steps: int = STEPS
) -> Float[Array, "2 3 pix"]:
    """Integrate I, Q, U of dust and of synchrotron along the line of sight [kpc], not yet scaled.

    With B_t, B_p the components of the field along theta_hat and phi_hat (COSMO), alpha its
    angle to the line of sight, and the densities n in units of those at the Sun,

    dust         int n_d [1 - p0 (sin^2 alpha - 2/3), p0 (B_p^2 - B_t^2)/B^2, -2 p0 B_t B_p/B^2] ds
    synchrotron  int n_e [B_t^2 + B_p^2, 3/4 (B_p^2 - B_t^2), -3/4 2 B_t B_p] ds

    dust as in Planck int. results XX (2015), synchrotron for electrons with E^-3. Differentiable
    in the parameters of the model. The maps are samples at the pixel centres; a seed means the
    same sky at every nside.
    """
    _check(nside, seed, steps)
    angles = healpy.pix2ang(nside, np.arange(healpy.nside2npix(nside)))
    return _integrate(model, jax.random.key(seed), angles, steps)


@jax.jit
def _scaled(maps, calibrator):
    """Scale both components by the factors that give the calibrator the observed rms."""
    spread = jnp.sqrt(jnp.var(calibrator[:, 1:], axis=-1).sum(axis=-1))
    return (jnp.array([DUST_RMS, SYNCHROTRON_RMS]) / spread)[:, None, None] * maps


def embedded_sky(
    nside: int, seed: int = 0, model: GalaxyModel | None = None, *, steps: int = STEPS
) -> EmbeddedSky:
    """Make a model of the polarized Galaxy (not data): dust at 353 GHz and synchrotron at 30 GHz.

    Each component of `line_of_sight` is scaled by one factor, the same at all resolutions, so
    that at nside 64 the standard deviations of Q and U, added in quadrature, equal those of the
    observed sky [uK_RJ]: (14.7, 6.8) for dust, (17.2, 9.1) for synchrotron.

    Parameters
    ----------
    nside : resolution, a power of 2. Below 64, where pixels are too wide to sample the Galactic
        plane, the maps are those at 64 cut at l = 3 nside - 1; the dust intensity then rings
        around the plane and is negative in places.
    seed : seed of the turbulence; a different nside shows the same sky in more or less detail
    model : the parameters, by default `GalaxyModel()`
    steps : number of steps along the line of sight

    Examples
    --------
    >>> embedded_sky(16, seed=1).sky().shape
    (2, 3072)
    """
    _check(nside, seed, steps)
    model = GalaxyModel() if model is None else model
    maps = calibrator = line_of_sight(model, NSIDE_SCALE, seed, steps=steps)
    if nside > NSIDE_SCALE:
        maps = line_of_sight(model, nside, seed, steps=steps)
    elif nside < NSIDE_SCALE:
        cut = jnp.ones(3 * nside, calibrator.dtype)
        maps = jnp.stack([resample(component, cut, nside) for component in calibrator])
    dust, synchrotron = _scaled(maps, calibrator)
    return EmbeddedSky(dust, synchrotron, seed)
