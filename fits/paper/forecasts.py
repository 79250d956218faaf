"""B modes of foregrounds against primordial ones: figure 12."""

from pathlib import Path

from fits.b_modes import PIVOT
from fits.commands.forecast import Forecast, forecast
from fits.commands.forecast_pictures import plot_b_modes
from fits.paper.item import Impossible, Item, Number, picture_of
from fits.paper.sources import Sources
from fits.pseudo_cl import sky_fraction
from fits.regions import region_words
from jaxsky.instrument import band_tables
from jaxsky.io import InputError
from jaxsky.settings import BandTable, Experiment

#: The paper's bands of COrE [GHz].
BANDS = ("45", "105", "315")
#: Resolution of the embedded model here, and the largest multipole.
NSIDE, LMAX = 128, 250


def _settings(settings: Experiment, sources: Sources) -> Experiment:
    """Those of a forecast with COrE and the sky of the figures."""
    sky, lmax = settings.sky, LMAX
    if sky.embedded is not None:
        sky = sky.model_copy(update={"embedded": sky.embedded.model_copy(update={"nside": NSIDE})})
    if not sources.embedded:
        lmax = min(LMAX, 2 * min(sources.template(n).nside for n in ("dust", "synchrotron")) - 8)
    fit = (20, min(200, lmax - 10))
    spec = settings.forecast.model_copy(update={"bands": list(BANDS), "lmax": lmax, "fit": fit})
    bands = [BandTable.model_validate(band) for band in band_tables("core")]
    cmb = settings.cmb.model_copy(update={"include": True, "spectra": None})
    changes = {"sky": sky, "bands": bands, "cmb": cmb, "free": {}, "forecast": spec}
    return settings.model_copy(update=changes)


def figure_b_modes(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 12: BB of the foregrounds in three bands of COrE, and of gravitational waves."""
    try:
        chosen = _settings(settings, sources)
        found = forecast(chosen)
    except InputError:
        raise
    except ValueError as reason:
        raise Impossible(str(reason)) from None
    picture = picture_of("Figure 12")
    plot_b_modes(out / picture, found, chosen)
    fraction = 100 * sky_fraction(found.inputs.mask)
    sky = sources.sky_differs
    if sources.embedded:
        sky = f"The sky is the embedded model of the Galaxy at nside {NSIDE}."
    return Item(
        "Figure 12",
        "primordial B modes and foregrounds",
        "BB of the foregrounds in three bands of COrE (thick) and their noise (thin) in "
        f"{region_words(settings, settings.forecast.region)}, {fraction:.0f} % of the sky, "
        "with the mixing of the mask undone, against primordial BB for several r, and lensing.",
        f"{sky} The edge of what is used is smooth, and the paper's is WMAP's polarization mask, "
        "which leaves 63 %. Noise and lensing are added.",
        picture,
        numbers=_numbers(found),
    )


def _numbers(found: Forecast) -> tuple[Number, ...]:
    where = f"l = {PIVOT}"
    return tuple(
        Number(f"r with as much BB at {where}, {name} GHz", "not given", f"{equal[where]:.3g}")
        for name, equal in found.equal_r.items()
    )
