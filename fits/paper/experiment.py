"""A simulated observation with COrE: figure 13 and table 1."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fits.commands.page import Table
from fits.paper.item import Item, Number, picture_of
from fits.paper.patches import disc, draw_patches
from fits.paper.sources import PAPER_FWHM, Sources
from jaxsky.experiment import cmb_spectra
from jaxsky.instrument import load_instrument
from jaxsky.interpolation import term_weights
from jaxsky.observation import Observation, ObservedBand, Prepared, Source, plan, prepare
from jaxsky.settings import Experiment
from jaxsky.simulation import observe_bands

BANDS = ("45", "105", "315")
#: The paper's resolution of the CMB [arcmin], and what dominates each band there.
CMB_FWHM, DOMINANT = 4.0, {"45": "synchrotron", "105": "CMB", "315": "dust"}
#: Size of the patch [deg].
SIZE = 30.0


def _observation(settings: Experiment, sources: Sources) -> Observation:
    """Three of COrE's bands; beams are COrE's, or that of the small scales if it is wider."""
    fwhm = settings.paper.fwhm
    channels = {
        channel.name: ObservedBand(
            channel.band(),
            max(float(channel.fwhm), fwhm),
            noise=channel.noise * channel.band().conversion(channel.noise_unit, "uK_RJ"),
        )
        for channel in load_instrument("core").select(list(BANDS))
    }
    return Observation(channels, sources.nside_fine, finest=fwhm, precision="single")


def _prepared(sources: Sources, observation: Observation) -> dict[str, Prepared]:
    """Both foregrounds; where their laws are constant, with the small scales that there are."""
    layers = {name: sources.template(name) for name in PAPER_FWHM}
    given = {
        name: Source(layer.component, layer.fwhm, layer.small) for name, layer in layers.items()
    }
    terms = plan(given, observation)
    constant = {name: one for name, one in terms.items() if one is not None and not one.counts}
    if len(constant) < len(terms):
        return prepare(sources.key, given, observation, terms)
    return {
        name: Prepared(
            tuple(alm.astype(observation.dtype) for alm in sources.continued(name).alms),
            term_weights(layers[name].component, observation.bands, one),
            None,
            None,
            0.0,
        )
        for name, one in constant.items()
    }


def figure_patch(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 13: Q of the CMB and of three bands in a patch."""
    center, fwhm = settings.paper.center, settings.paper.fwhm
    observation = _observation(settings, sources)
    prepared = _prepared(sources, observation)
    cmb = cmb_spectra(settings, observation.lmax)
    panels, rms = {}, {}
    finest = observation.names[-1]
    for name, maps in observe_bands(
        sources.key, prepared, observation, jnp.asarray(cmb), components=True
    ):
        channel = observation.channels[name]
        seen = {which: np.asarray(values[0]) for which, values in maps.items()}
        rms[name] = {
            which: float(np.sqrt(np.mean(disc(values, center, SIZE) ** 2)))
            for which, values in seen.items()
        }
        total = seen["total"]
        panels[f"{name} GHz, {float(channel.beam):g}'"] = total, _limit(total, center), "uK_RJ"
        if name == finest:
            to_cmb = float(channel.band.conversion("uK_RJ", "uK_CMB"))
            Q = seen["cmb"] * to_cmb
            panels = {f"CMB, {float(channel.beam):g}'": (Q, _limit(Q, center), "uK_CMB"), **panels}
    spectra = settings.cmb.spectra
    origin = f"r = {settings.cmb.r:g}" if spectra is None else f"spectra of {spectra}"
    picture = picture_of("Figure 13")
    draw_patches(out / picture, panels, center, SIZE)
    numbers = tuple(_brightest(name, values) for name, values in rms.items())
    return Item(
        "Figure 13",
        "COrE",
        f"Stokes Q in a patch of {SIZE:g}° about (l, b) = ({center[0]:g}°, {center[1]:g}°): a CMB "
        f"realisation ({origin}, thermodynamic units), and simulated observations "
        "with COrE, noise included, in antenna temperature. Foregrounds have small scales.",
        f"{sources.sky_differs} The finest beam is {fwhm:g} arcmin, that of the small scales, "
        f"which the pixels resolve (nside {observation.nside}); the paper has {CMB_FWHM:g} arcmin "
        "for the CMB and COrE's 3.3 arcmin at 315 GHz. Bands are top-hats, 25 % wide; the paper "
        "does not say how wide it takes them.",
        picture,
        numbers=numbers,
    )


def _limit(values: np.ndarray, center: tuple[float, float]) -> float:
    return float(np.quantile(np.abs(disc(values, center, SIZE)), 0.99)) or 1.0


def _brightest(band: str, rms: dict[str, float]) -> Number:
    """What dominates a band in the patch, by its rms, mean included."""
    parts = {name: value for name, value in rms.items() if name not in ("total", "noise")}
    order = sorted(parts, key=parts.__getitem__, reverse=True)
    words = ", ".join(f"{_word(name)} {parts[name]:.2g}" for name in order)
    return Number(
        f"brightest in the patch at {band} GHz",
        DOMINANT[band],
        _word(order[0]),
        f"rms of Q [µK_RJ]: {words}, noise {rms['noise']:.2g} a pixel",
    )


def _word(name: str) -> str:
    return "CMB" if name == "cmb" else name


def table_core(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Table 1: COrE."""
    channels = list(load_instrument("core"))
    header = ("Band [GHz]", *(f"{float(channel.center):g}" for channel in channels))
    rows = (
        ("Beam FWHM [arcmin]", *(f"{float(channel.fwhm):.1f}" for channel in channels)),
        ("Noise [µK_RJ arcmin]", *(f"{float(channel.noise):.2f}" for channel in channels)),
        ("Width [GHz]", *(f"{float(channel.width):.3g}" for channel in channels)),
    )
    return Item(
        "Table 1",
        "COrE",
        "Bands, beams and noise of COrE as they are simulated (jaxsky/instruments.toml).",
        "The beams and the noise are the paper's. It does not say in which temperature the noise "
        "is: antenna temperature, as in COrE's white paper. Nor does it give widths, which are "
        "25 % of the centre here.",
        table=Table(header, rows),
    )
