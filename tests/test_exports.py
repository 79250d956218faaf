"""Every compiled function is made for CUDA, on a machine without a GPU.

A module with a function under `jit` has calls here, in which each of its functions has to appear.
What has transforms has to have JAX's callback to the host, and nothing of jaxbind's own for GPUs,
which its packages do not have; all else has to pass `jax.export`.
"""

import importlib
import inspect
import pkgutil
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import healpy
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from blackjax.adaptation.step_size import dual_averaging_adaptation
from jax.extend.core import jaxprs_in_params
from jax.interpreters import mlir

import fits
import jaxsky
from fits.compress import Blocks, Layout, Noise
from fits.mixing import Mixing
from fits.posterior import Posterior
from fits.unbounded import unbounded_posterior
from jaxsky.bandpass import stack_bands
from jaxsky.harmonics import Preparation
from systems import bands, components, dust_and_synchrotron, random_maps, spread

NSIDE, LMAX = 4, 8
NPIX = healpy.nside2npix(NSIDE)
KEY = jax.random.key(1)
ELL = np.arange(LMAX + 1.0)
FALLING = 1 / (1 + ELL) ** 2
MAPS, ALM = random_maps(1, npix=NPIX), random_maps(2, npix=(LMAX + 1) ** 2)
MASK = np.linspace(0, 1, NPIX)
NU = np.array([30.0, 100.0])
BANDS = bands()
SAMPLES = stack_bands(BANDS)
SKY = dust_and_synchrotron(NPIX)
DUST = jaxsky.Dust(MAPS, spread(1.53, 0.1, NPIX), spread(20.0, 1.0, NPIX))
COUNTS = (5, 5)
START = {"dust.beta_dust": 1.55, "synchrotron.beta_syn": 3.05}
FOUR = {f"{c:g}": jaxsky.Bandpass.top_hat(c, c / 4, samples=5) for c in (30.0, 95.0, 220.0, 353.0)}
Calls = Iterator[tuple[Any, ...]]
#: The calls of each module with compiled functions.
CALLS: dict[str, Callable[[], Calls]] = {}


def of(module: str) -> Callable:
    """Add a function that takes a module, and yields calls of its functions."""

    def added(function: Callable) -> Callable:
        CALLS[module] = partial(function, importlib.import_module(module))
        return function

    return added


@of("jaxsky.sed")
def spectral_laws(sed) -> Calls:
    yield sed.power_law, NU, 3.1, 30.0
    yield sed.curved_power_law, NU, 3.1, -0.1, 23.0, 30.0
    yield sed.modified_blackbody, NU, 1.5, 20.0, 353.0
    yield sed.modified_blackbodies, NU, (1.7, 2.7), (9.4, 16.2), (0.5, 1.0), 353.0
    yield sed.ame_log_parabola, NU, 4.0, 20.0, 22.8
    yield sed.cmb_derivative, NU
    yield sed.thermal_sz, NU


@of("jaxsky.components.laws")
def emission(laws) -> Calls:
    yield laws.amplitude_from_emission_measure, MAPS[0], 8000.0, 30.0
    yield laws.amplitude_from_compton, MAPS[0], 100.0
    yield laws.amplitude_from_line_intensity, MAPS[0], 115.3


@of("jaxsky.pysm.emission")
def pysm_models(emission) -> Calls:
    own = emission.Part(jaxsky.Dust(random_maps(1, 3, NPIX), 1.53, 20.0, nu_ref_I=545.0))
    yield partial(emission._summed, plan=(None,)), (own.ready,), BANDS[0], 1.0


@of("jaxsky.pysm.detectors")
def many_bands(detectors) -> Calls:
    yield detectors._map, DUST, np.ones(COUNTS)
    yield detectors._combined, np.ones((4, 2)), np.ones((2, 3, NPIX))


@of("jaxsky.references")
def references_of_I(references) -> Calls:
    dust = jaxsky.Dust(random_maps(1, 3, NPIX), 1.53, 20.0, nu_ref_I=545.0)
    yield references._intensity, dust
    yield references._joined, dust.amplitude[:1], dust.amplitude


@of("jaxsky.bandpass")
def bandpasses(bandpass) -> Calls:
    yield partial(bandpass._across, samples=9), 100.0, 20.0
    for convention in ("RJ", "power", "CMB"):
        yield partial(bandpass._integrand, convention=convention), NU, np.ones(2)
    yield bandpass.stack_bands, tuple(BANDS)
    yield lambda band: band.center, BANDS[0]
    yield partial(bandpass.average, lambda nu: nu**-3.1), BANDS[0]
    yield partial(bandpass.band_conversion, "uK_RJ", "MJy/sr"), NU, np.ones(2), 353.0
    yield jax.grad(lambda x: jaxsky.Bandpass.top_hat(x, 20.0).conversion("K_CMB", "uK_RJ")), 100.0


@of("jaxsky.interpolation")
def interpolated(interpolation) -> Calls:
    yield interpolation._tails, DUST, SAMPLES
    yield partial(interpolation._series, counts=COUNTS), DUST, BANDS[0]
    yield partial(interpolation._all_series, counts=COUNTS), DUST, SAMPLES
    yield partial(interpolation._weights, counts=COUNTS), DUST, SAMPLES, np.ones((2, 25))
    yield partial(interpolation._weight_matrix, counts=COUNTS), DUST, SAMPLES, np.ones((2, 25))
    yield interpolation.term, DUST, np.ones(COUNTS)
    yield (
        lambda dust: interpolation.band_seds(dust, SAMPLES, interpolation.NodeCounts(COUNTS)),
        DUST,
    )


@of("jaxsky.sky")
def observed(sky) -> Calls:
    def total(one, bands):
        return jnp.sum(jaxsky.observe(one, bands) ** 2)

    everything, varying = sky.Sky(components()), sky.Sky({"dust": DUST})
    for one in (everything, varying):
        yield jaxsky.observe, one, BANDS
    yield partial(jaxsky.observe, tolerance=0), varying, BANDS
    yield jax.grad(total), varying, BANDS
    yield sky.observe_components, everything, BANDS


@of("jaxsky.harmonics")
def transforms(harmonics) -> Calls:
    prepared = Preparation.smoothing(NSIDE, 0.0, NSIDE // 2, 2000.0, LMAX)
    yield harmonics.expand, ELL
    yield partial(harmonics.resize, lmax=5), ALM
    yield harmonics.power_spectrum, ALM, ALM
    yield partial(harmonics.synthesis, nside=NSIDE), ALM
    yield partial(harmonics.adjoint_synthesis, lmax=LMAX), MAPS
    yield partial(harmonics.analysis, lmax=LMAX), MAPS
    yield jax.grad(lambda alm: jnp.sum(harmonics.synthesis(alm, NSIDE) ** 3)), ALM
    yield jax.vmap(partial(harmonics.analysis, lmax=LMAX)), MAPS[None]
    yield lambda fwhm, own: harmonics.beam_ratio(fwhm, own, LMAX), 2000.0, 1000.0
    yield partial(harmonics.resample, nside=2), MAPS, ELL
    yield partial(harmonics.average_pixels, nside=2), MAPS
    yield prepared.transpose, MAPS[:, : NPIX // 4]


@of("jaxsky.cmb")
def random_fields(cmb) -> Calls:
    yield cmb.speed_of_dipole, 3366.6
    yield partial(cmb.dipole, 2, quadrupole=True), 1e-3
    spectra = np.eye(2)[..., None] * FALLING
    yield cmb.realisation, KEY, np.stack([FALLING] * 4)
    yield cmb.repair, spectra
    yield jax.grad(lambda x: cmb.repair(x)[0].sum()), spectra
    yield cmb.gaussian_fields, KEY, spectra


@of("jaxsky.noise")
def noises(noise) -> Calls:
    covariance = np.eye(2)[..., None] * np.ones(NPIX)
    yield partial(noise.normal, shape=(2, 5), dtype=np.dtype(float)), KEY
    yield partial(noise.stokes_noise, stokes=2, size=5, dtype=np.dtype(float)), KEY
    yield partial(noise.uniform_covariance, nside=NSIDE), 10.0
    yield partial(noise.uniform_alm, lmax=LMAX), KEY, 10.0
    yield noise.cholesky, covariance
    yield noise.draw, KEY, covariance
    yield partial(noise.white_alm, lmax=LMAX), KEY, covariance
    yield noise._number_indefinite, covariance


@of("jaxsky.galaxy")
def galaxies(galaxy) -> Calls:
    angles = healpy.pix2ang(NSIDE, np.arange(NPIX))
    model = galaxy.GalaxyModel()
    yield partial(galaxy._integrate, steps=4), model, KEY, angles
    yield galaxy._scaled, np.ones((2, 3, NPIX)), random_maps(1, npix=6 * 48).reshape(2, 3, -1)


@of("jaxsky.simulation")
def simulations(simulation) -> Calls:
    part = simulation._Part((ALM, ALM), (1.0, 2.0), jnp.asarray(ELL))
    yield simulation._importance, dict(SKY.components), SAMPLES
    yield partial(simulation._term_alm, lmax=LMAX, steps=1), MAPS, DUST, np.ones(COUNTS)
    yield simulation._summed, (part, part)


@of("jaxsky.templates")
def correlations(templates) -> Calls:
    yield partial(templates._jackknife, number=4), MAPS[0], MAPS[1], np.arange(NPIX) % 4


@of("fits.fluctuations")
def fluctuations(own) -> Calls:
    prepared = Preparation.smoothing(NSIDE, 0.0, NSIDE, 2000.0, LMAX)
    found = own.Fluctuations(
        (own.MapNoise(prepared, jnp.eye(2)[..., None] * jnp.ones(NPIX), jnp.asarray(FALLING)),),
        jnp.stack([FALLING] * 2),
        jnp.asarray(FALLING[None]),
        jnp.ones(1),
        ("44",),
    )
    yield own._modes, MAPS, np.stack([FALLING] * 2)
    yield found.cmb_realisation, KEY
    yield found.noise_realisation, KEY


@cache
def template_fit(**options):
    data = jaxsky.observe(SKY, list(FOUR.values()))
    return fits.likelihood(SKY, FOUR, data, 1.0, START, **options)


@cache
def separation():
    data = jaxsky.observe(SKY, list(FOUR.values())) + random_maps(5, npix=NPIX)
    labels = {"dust.beta_dust": np.arange(NPIX) % 3}
    return fits.spectral_likelihood(SKY, FOUR, data, np.ones(4), START, labels=labels)


def all_likelihoods():
    per_pixel = np.linspace(0.5, 1.5, 4 * 2 * NPIX).reshape(4, 2, NPIX)
    data = jaxsky.observe(SKY, list(FOUR.values())) + random_maps(5, npix=NPIX)
    yield template_fit()
    yield template_fit(pixelwise=True)
    yield template_fit(covariance_of=lambda rows: np.eye(rows.shape[0] * rows.shape[1]))
    yield separation()
    yield fits.spectral_likelihood(SKY, FOUR, data, per_pixel, {**START, "angle.95": 0.1})


@of("fits.posterior")
def posteriors(posterior) -> Calls:
    priors = [(fits.Gaussian(1.5, 0.1), np.array([True, False]))]
    yield posterior.prior_terms, np.ones(2), priors
    for like in all_likelihoods():
        params = dict(like.start)
        theta = like.flat(params)
        yield type(like).residuals, like, params
        yield posterior.chi2, like, params
        yield jax.grad(posterior.chi2, argnums=1), like, params
        yield posterior.value_and_gradient, like, theta
        yield posterior._cell_derivatives, like, theta


@of("fits.products")
def template_passes(products) -> Calls:
    data = np.ones((4, 2, NPIX))
    yield products.gram, data, MAPS[None], data
    yield products._weights, data, 2 * data
    yield products._counts, data, 2 * data
    yield products.one_stokes_each, MAPS[None], data
    yield partial(products._of_band, band=1), MAPS[None], data
    yield products.weighted, data, MAPS[None]


@of("fits.comparison")
def comparisons(comparison) -> Calls:
    yield comparison._sums_of_squares, np.ones((4, 2, NPIX)), np.ones((3, NPIX), bool)


@of("fits.systems")
def decompositions(systems) -> Calls:
    yield systems.square_root, np.eye(4)[None]


@of("fits.distributed")
def shared_pixels(distributed) -> Calls:
    data, layout = np.ones((4, 2, NPIX)), Layout(False, (0, 1))
    noise, used = Noise(np.ones((4, 2, 1)), np.ones(NPIX)), np.ones(NPIX, bool)
    blocks = Blocks(np.arange(NPIX).reshape(2, -1), np.arange(2))
    yield partial(distributed._look, components=2), data, noise
    yield partial(distributed.counted, number=3), np.arange(NPIX)
    yield distributed.pieces, used
    yield distributed._numbered, np.arange(3), np.arange(NPIX), used
    yield partial(distributed._band_covariance, layout=layout, number=2), data, noise, blocks
    yield partial(distributed.gathered, layout=layout), data, noise, blocks


@of("fits.profile_likelihood")
def separations(profile_likelihood) -> Calls:
    like = separation()
    yield profile_likelihood._matrices, like, dict(like.start)


@of("fits.separated_maps")
def separated(separated_maps) -> Calls:
    data, layout = np.ones((4, 2, NPIX)), Layout(False, (0, 1))
    matrix = np.random.default_rng(1).normal(size=(1, 4, 2))
    for errors in (False, True):
        options = {"layouts": (layout,), "errors": errors}
        given = (matrix,), data, Noise(data)
        yield partial(separated_maps._over_devices, None, **options), *given
        own = partial(separated_maps._separated, used=np.ones(NPIX, bool), **options)
        yield own, np.zeros(NPIX, int), *given


@of("fits.separated_moments")
def separated_with_moments(separated_moments) -> Calls:
    like = separation()
    yield separated_moments._matrix, like.flat({}), like


@of("fits.grid")
def grids(grid) -> Calls:
    axes = {name: np.linspace(0.9, 1.1, 3) * value for name, value in START.items()}
    yield grid.chi2_on_grid, template_fit(), axes
    yield grid.chi2_on_grid, template_fit(pixelwise=True), axes


def densities(like):
    priors = {"dust.beta_dust": fits.Uniform(1.0, 2.0), "synchrotron.beta_syn": fits.Gaussian(3, 1)}
    own = Posterior(like, priors)
    return own, own.density(own.start)


@of("fits.optimize")
def optimisers(optimize) -> Calls:
    own, density = densities(template_fit())
    yield optimize._values, own.start, density, np.ones(2)
    yield jax.grad(optimize._objective), own.start, (density, np.ones(2))
    yield jax.jacfwd(optimize._residuals), own.start, (density, np.ones(2))


@of("fits.sampling")
def samplers(sampling) -> Calls:
    own, _ = densities(separation())
    z = np.ones((4, own.start.size))
    numbers, _ = unbounded_posterior(own, own.start)
    leaves, structure = jax.tree.flatten(numbers.density)
    yield partial(sampling._log_probs, structure=structure), z, leaves
    yield sampling._values, numbers, z
    yield sampling._begun, numbers, z
    tuning = jax.tree.map(lambda x: jnp.asarray(x, float), dual_averaging_adaptation(0.8)[0](0.5))
    begun = sampling._begun(numbers, z), tuning
    yield partial(sampling._advanced, steps=2), numbers, begun, KEY, 0, 10
    yield sampling.agreement, np.random.default_rng(1).normal(size=(100, 4, 2))


@of("fits.fisher")
def forecasts(fisher) -> Calls:
    law = {name: jax.tree.map(lambda x: x[:, :1] if x.ndim == 2 else x, one)
           for name, one in SKY.components.items()}  # fmt: skip
    foregrounds = {"BB.dust.synchrotron.correlation": 0.4}
    for name in SKY:
        foregrounds |= {f"BB.{name}.amplitude": 1.0, f"BB.{name}.slope": -2.5}
    model = fisher.ForecastModel(
        Mixing.of(jaxsky.Sky(law), FOUR, "uK_CMB"),
        jnp.ones((LMAX, 4)),
        jnp.ones((1, LMAX)),
        jnp.ones((1, LMAX)),
        jnp.asarray(ELL[1:]),
        jnp.asarray(0.6),
        ("BB",),
    )
    params = fisher.fiducial(model.sky, foregrounds, 0.01, 1.0)
    yield partial(fisher._root, free=("r", "dust.beta_dust")), params, model


@of("fits.pseudo_cl")
def masked(pseudo_cl) -> Calls:
    maps = random_maps(3, npix=NPIX)
    yield partial(pseudo_cl._compiled_alm, lmax=LMAX), MASK, np.ones((4, NPIX)), maps
    yield partial(pseudo_cl._compiled_alm, lmax=LMAX), MASK, None, maps


@of("fits.patches")
def patch_laws(patches) -> Calls:
    row = np.ones((3, 2))
    rows = patches.BandCombinations(row, row, row, row, np.ones((3, 2, 10)))
    yield partial(patches.minimise, ends=(2, 9)), rows, np.array([-2.4, 0.3])


@of("fits.tensor_ratio")
def tensors(tensor_ratio) -> Calls:
    shape = (2, 2, 3, LMAX + 1, 5)
    ordered = np.moveaxis(np.ones(shape), 2, 0)
    yield tensor_ratio._squares, ordered, ordered, np.ones(3), np.ones((1, 2, LMAX + 1))


@of("jaxsky.mesh")
def pieces(mesh) -> Calls:
    yield mesh._put, np.ones((2, NPIX)), np.ones((2, 5)), 3


#: Modules whose calls also take single precision.
SINGLE = ("jaxsky.bandpass", "jaxsky.interpolation", "jaxsky.sky", "fits.products")
#: Modules whose programs take long to make: most others share functions with them.
LARGE = {"jaxsky.sky", "fits.posterior", "fits.sampling"}


def in_single_precision(x):
    x = jnp.asarray(x)
    return x.astype(np.float32) if x.dtype == np.float64 else x


def jitted(function) -> bool:
    return hasattr(function, "lower")


def compiled(module: str) -> set[str]:
    """The functions under `jit` that a module defines, methods included, as JAX names them."""
    found = importlib.import_module(module)
    own = [x for x in vars(found).values() if getattr(x, "__module__", None) == module]
    own += [x for one in own if inspect.isclass(one) for x in vars(one).values()]
    names = set()
    for one in filter(callable, own):
        made = inspect.unwrap(one, stop=jitted)
        if jitted(made) and not inspect.isclass(one):
            code = inspect.unwrap(one).__code__
            place = f" at {code.co_filename}:{code.co_firstlineno}"
            # JAX sees equinox in place of what is under `filter_jit`, and its name.
            names.add(code.co_name + (place if hasattr(made, "trace") else ""))
    return names


def each_module(names):
    marks = {name: [pytest.mark.slow] if name in LARGE else [] for name in names}
    return pytest.mark.parametrize(
        "module", [pytest.param(name, marks=found) for name, found in marks.items()]
    )


def called(jaxpr) -> Iterator[str]:
    """Primitives of a traced program, and functions with their place."""
    for equation in jaxpr.eqns:
        yield equation.primitive.name
        for inner in jaxprs_in_params(equation.params):
            name, _, place = str(inner.debug_info.func_src_info).partition(" at ")
            yield name if "equinox" in place else f"{name} at {place}"
            yield from called(inner)


def lowered(function, arguments, monkeypatch) -> tuple[str, set[str]]:
    """The text of a program for CUDA, and what it calls."""
    whole = jax.jit(lambda *given: function(*given))
    traced = whole.trace(*arguments)
    inside = set(called(traced.jaxpr.jaxpr))
    if "jaxbind_prim" not in inside:
        return jax.export.export(whole, platforms=["cuda"])(*arguments).mlir_module(), inside
    with monkeypatch.context() as patch:
        # `jax.export` takes no callback, and to lower one JAX asks for the GPU, without using it.
        patch.setattr(mlir.ModuleContext, "get_backend", lambda *_, **__: None)
        text = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert "xla_ffi_python_gpu_callback" in text
    return text, inside


@each_module(CALLS)
def test_compiled_functions_are_made_for_a_gpu(module, monkeypatch):
    left = compiled(module)
    assert left
    for function, *arguments in CALLS[module]():
        text, inside = lowered(function, arguments, monkeypatch)
        assert "gpu_pycall" not in text
        left -= inside
    assert not left, "add a call of each to this file"


def test_no_module_is_forgotten():
    found = {
        module.name
        for package in (jaxsky, fits)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if module.name != "jaxsky.__main__" and compiled(module.name)
    }
    assert found == set(CALLS)


@each_module(SINGLE)
def test_matrix_products_in_single_precision_are_not_rounded_further(module, monkeypatch):
    """As GPUs do with what has no precision of its own."""
    products = 0
    for function, *arguments in CALLS[module]():
        single = jax.tree.map(in_single_precision, arguments)
        text, _ = lowered(function, single, monkeypatch)
        for line in text.splitlines():
            if "dot_general" in line and "f32>" in line:
                products += 1
                assert "precision = [HIGHEST, HIGHEST]" in line
    assert products
