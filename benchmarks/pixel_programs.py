"""What the devices exchange in passes over pixels, read from the compiled programs.

`XLA_FLAGS=--xla_force_host_platform_device_count=8 python -m benchmarks.pixel_programs NSIDE ...`
writes the bytes of each pass at each nside as JSON.
"""

import json
import re
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from fits import distributed, regions
from fits.compress import as_noise
from fits.posterior import _cell_derivatives, value_and_gradient
from fits.products import gram
from fits.profile_likelihood import spectral_likelihood
from fits.separated_maps import _over_devices
from jaxsky import Bandpass, Dust, Sky, Synchrotron
from jaxsky.mesh import distribute
from jaxsky.sky import _kept, _observe, interpolation_nodes

BANDS = {f"{nu:g}": Bandpass.top_hat(nu, nu / 5, samples=9) for nu in (30, 44, 70, 143, 217)}
START = {"dust.beta_dust": 1.6, "synchrotron.beta_syn": 3.0}
COLLECTIVES = ("all-reduce", "all-gather", "all-to-all", "collective-permute", "reduce-scatter")
BYTES = {"f64": 8, "f32": 4, "s64": 8, "s32": 4, "u32": 4, "u8": 1, "pred": 1}
#: Passes in which nothing is exchanged.
ALONE = ("maps of components", "pixels in blocks")


def moved(program: jax.stages.Lowered) -> int:
    """Bytes of the results of all collectives of a compiled program, on one device."""
    text = program.compile().as_text()
    found = re.findall(rf"= (\(?[^=]*?) (?:{'|'.join(COLLECTIVES)})(?:-start)?\(", text)
    every = re.findall(rf" (?:{'|'.join(COLLECTIVES)})(?:-start)?\(", text)
    if len(found) != len(every):
        raise ValueError(f"{len(every)} collectives, of which {len(found)} were understood.")
    shapes = [shape for result in found for shape in re.findall(r"(\w+)\[([\d,]*)\]", result)]
    sizes = [[int(n) for n in axes.split(",") if n] for _, axes in shapes]
    return sum(
        BYTES[kind] * int(np.prod(size)) for (kind, _), size in zip(shapes, sizes, strict=True)
    )


def programs(nside: int) -> dict[str, jax.stages.Lowered]:
    """The passes over pixels as they are compiled for maps over all devices."""
    npix = 12 * nside**2
    rng = np.random.default_rng(1)
    data = distribute(rng.normal(size=(len(BANDS), 2, npix)))
    templates = distribute(rng.normal(size=(2, 2, npix)))
    beta = distribute(rng.uniform(1.5, 1.6, npix))
    sky = Sky({"dust": Dust(templates[0], beta, 21.0), "synchrotron": Synchrotron(templates[1])})
    bands = tuple(BANDS.values())
    noise = as_noise(np.ones(len(BANDS)), data.shape, distribute(rng.uniform(1, 2, npix)))
    used = distributed.look(data, noise, 2).used
    name = "dust.beta_dust"
    labels = regions.check_labels(name, np.arange(npix) // 5 % 3, used)
    blocks = distributed.blocks(distributed.intersections({name: labels}, used), used)
    one = np.ones((2, 1))
    laws = Sky({"dust": Dust(one, 1.55, 21.0), "synchrotron": Synchrotron(one)})
    options = {"labels": {name: labels}, "compress": False}
    like = spectral_likelihood(laws, BANDS, data, noise, START, **options)
    plan = interpolation_nodes(sky, bands, 1e-10)
    (layout,), theta, matrix = like.layout, like.flat({}), np.ones((1, len(BANDS), 2))
    return {
        "observe": _observe.lower(sky, bands, _kept(sky), plan=plan, apart=False),
        "inner products": jax.jit(gram).lower(data, templates, jnp.abs(data)),
        "used pixels": distributed._look.lower(data, noise, components=2),
        "band covariances": jax.jit(
            partial(distributed._band_covariance, layout=layout, number=3)
        ).lower(data, noise, blocks),
        "pixels in blocks": jax.jit(partial(distributed.gathered, layout=layout)).lower(
            data, noise, blocks
        ),
        "likelihood with gradient": jax.jit(value_and_gradient).lower(like, theta),
        "second derivatives": _cell_derivatives.lower(like, theta),
        "maps of components": _over_devices.lower(
            None, (matrix,), data, noise, layouts=(layout,), errors=True
        ),
    }


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    every = [programs(int(nside)) for nside in sys.argv[1:]]
    print(json.dumps({name: [moved(one[name]) for one in every] for name in every[0]}))


if __name__ == "__main__":
    main()
