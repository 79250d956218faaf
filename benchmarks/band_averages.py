"""Band averages of dust with maps of its spectral parameters, next to PySM 3."""

import jax
import jax.numpy as jnp
import numba
import numpy as np
from pysm3 import ModifiedBlackBody
from pysm3 import units as u

from benchmarks.table import Row, time_text
from benchmarks.timing import interleave, page_faults, seconds
from jaxsky import Bandpass, Dust, Sky, observe
from jaxsky.sky import interpolation_nodes

NU_REF, T_DUST = 353.0, 20.0
#: Ranges of the maps of PySM's model d1; how values are spread in between does not matter.
BETA_RANGE, T_RANGE = (1.25, 1.80), (14.0, 31.0)
TOLERANCE = 1e-10


def _maps(nside: int) -> np.ndarray:
    """I, Q, U, shape (stokes, pix)."""
    return np.random.default_rng(1).normal(size=(3, 12 * nside**2))


def _spectral(nside: int) -> tuple[np.ndarray, np.ndarray]:
    """Maps of index and temperature that reach both ends of their ranges."""
    unit = np.random.default_rng(2).uniform(size=(2, 12 * nside**2))
    unit[:, :4] = [[0, 0, 1, 1], [0, 1, 0, 1]]
    low, high = np.array([BETA_RANGE, T_RANGE]).T[:, :, None]
    beta_dust, T_dust = low + (high - low) * unit
    return beta_dust, T_dust


def _sky(nside: int, temperature: bool = False) -> Sky:
    beta_dust, T_dust = _spectral(nside)
    dust = Dust(_maps(nside)[1:], beta_dust, T_dust if temperature else T_DUST, nu_ref=NU_REF)
    return Sky({"dust": dust})


def _response(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [GHz] and weights per power of a band around 353 GHz, a third wide."""
    return np.linspace(300.0, 410.0, samples), np.hanning(samples + 2)[1:-1]


def _band(samples: int = 30) -> Bandpass:
    return Bandpass(*_response(samples), "power")


def _pysm(nside: int, temperature: bool) -> ModifiedBlackBody:
    """PySM's model with the same maps."""
    beta_dust, T_dust = _spectral(nside)
    stokes_i, stokes_q, stokes_u = _maps(nside) * u.uK_RJ
    return ModifiedBlackBody(
        map_I=stokes_i,
        map_Q=stokes_q,
        map_U=stokes_u,
        freq_ref_I=NU_REF * u.GHz,
        freq_ref_P=NU_REF * u.GHz,
        map_mbb_index=beta_dust,
        map_mbb_temperature=T_dust if temperature else T_DUST,
        unit_mbb_temperature="K",
        nside=nside,
    )


def _error(maps: jax.Array, reference: jax.Array | np.ndarray) -> float:
    """Largest relative difference."""
    return float(jnp.max(jnp.abs(maps / reference - 1)))


def _beside_pysm(nside: int, temperature: bool, target: float, rounds: int) -> Row:
    sky, band = _sky(nside, temperature), _band()
    model, (nu, weights) = _pysm(nside, temperature), _response(30)

    def ours():
        return observe(sky, [band])

    def theirs(threads=numba.config.NUMBA_NUM_THREADS):
        numba.set_num_threads(threads)
        return model.get_emission(nu * u.GHz, weights)

    first = seconds(theirs)
    error = _error(ours(), observe(sky, [band], tolerance=0))
    agreement = _error(ours()[0], theirs()[1:].value)
    # Where cores are busy, one thread is faster than several that wait for each other.
    calls = {"ours": ours, "all threads": theirs, "one thread": lambda: theirs(1)}
    times = interleave(calls, rounds)
    best = min("all threads", "one thread", key=lambda name: times[name])
    ratio = times.ratio(best, "ours")
    (nodes,) = interpolation_nodes(sky, [band], TOLERANCE)
    which = "beta and T maps" if temperature else "beta map"
    remarks = [
        f"{time_text(times[best])} ({best}) / {time_text(times['ours'])}",
        f"PySM computes I, Q, U: with 2/3 of its time {ratio * 2 / 3:.0f}x",
        f"its first call {time_text(first)}",
        f"{nodes.counts} nodes, error {error:.0e} against the direct sum (<= {TOLERANCE:.0e})",
        f"{agreement:.0e} against PySM",
    ]
    return Row(
        f"band average of dust Q, U, {which}, 30 samples, nside {nside}: PySM 3 / jaxsky",
        f"{ratio:.0f}x",
        f">= {target:.0f}x",
        ratio >= target and error <= TOLERANCE,
        "; ".join(remarks),
    )


def _beside_copy(nside: int, rounds: int) -> Row:
    sky, band = _sky(nside), _band()
    maps = _maps(nside)[1:]
    there = np.empty_like(maps)
    calls = {
        "ours": lambda: observe(sky, [band]),
        "copy": lambda: np.copy(maps),
        "in place": lambda: np.copyto(there, maps),
    }
    jax.block_until_ready(calls["ours"]())
    times = interleave(calls, rounds)
    ratio = times.ratio("ours", "copy")
    faults = ", ".join(f"{page_faults(calls[name])}" for name in ("ours", "copy"))
    return Row(
        f"the same, nside {nside}: jaxsky / copy of Q, U",
        f"{ratio:.1f}x",
        "<= 4x",
        ratio <= 4,
        f"{time_text(times['ours'])} / {time_text(times['copy'])}; a copy into memory already "
        f"there {time_text(times['in place'])}, {times.ratio('ours', 'in place'):.1f}x; page "
        f"faults of new memory {faults}",
    )


def beta_map(quick: bool) -> list[Row]:
    """A map of the index, next to PySM 3 and a plain copy."""
    nside = 32 if quick else 512
    return [
        _beside_pysm(nside, False, 200, 2 if quick else 5),
        _beside_copy(nside, 2 if quick else 15),
    ]


def beta_and_T_maps(quick: bool) -> list[Row]:
    """Maps of index and temperature, next to PySM 3."""
    return [_beside_pysm(32 if quick else 512, True, 40, 2 if quick else 3)]


def samples(quick: bool) -> list[Row]:
    """Cost against the number of samples in the band."""
    nside = 32 if quick else 512
    sky, counts = _sky(nside), (10, 30, 100, 300)
    bands = {n: _band(n) for n in counts}
    calls = {n: lambda band=band: observe(sky, [band]) for n, band in bands.items()}
    for call in calls.values():
        jax.block_until_ready(call())
    times = interleave(calls, 2 if quick else 15)
    ratios = [times.ratio(n, counts[0]) for n in counts]
    return [
        Row(
            f"the same, nside {nside}, 300 band samples / 10",
            f"{ratios[-1]:.2f}x",
            "within 20 %",
            all(0.8 <= r <= 1.2 for r in ratios),
            ", ".join(f"{n}: {time_text(times[n])}" for n in counts),
        )
    ]


def growth(quick: bool) -> list[Row]:
    """Time a pixel against nside."""
    nsides = (16, 32, 64) if quick else (64, 128, 256, 512, 1024)
    band, skies = _band(), {nside: _sky(nside) for nside in nsides}
    calls = {nside: lambda sky=sky: observe(sky, [band]) for nside, sky in skies.items()}
    for call in calls.values():
        jax.block_until_ready(call())
    times = interleave(calls, 2 if quick else 7)
    pixel = {nside: times[nside] / (12 * nside**2) * 1e9 for nside in nsides}
    return [
        Row(
            f"the same, nside {nsides[0]} to {nsides[-1]}: time a pixel",
            f"{pixel[nsides[0]]:.1f} to {pixel[nsides[-1]]:.1f} ns",
            remarks=", ".join(
                f"{nside}: {time_text(times[nside])} ({pixel[nside]:.1f} ns)" for nside in nsides
            ),
        )
    ]


def compilation(quick: bool) -> list[Row]:
    """The first call, which compiles, next to later ones."""
    nside = 32 if quick else 512
    sky, band = _sky(nside), _band()

    def first():
        jax.clear_caches()
        return seconds(lambda: observe(sky, [band]))

    def later():
        return seconds(lambda: observe(sky, [band]))

    rounds = [(first(), later()) for _ in range(2 if quick else 5)]
    compiled, run = np.median(rounds, axis=0)
    return [
        Row(
            f"the same, nside {nside}: first call, with compilation",
            time_text(compiled),
            remarks=f"later calls {time_text(run)}",
        )
    ]
