"""B modes of foregrounds against primordial ones: figure 12."""

from pathlib import Path

from fits.forecast.b_modes import PIVOT
from fits.forecast.forecast import Forecast, forecast
from fits.forecast.plots import plot_b_modes
from fits.forecast.settings import Embedded, ForecastSettings, Mask, Spectra
from fits.paper.item import Impossible, Item, Number, picture_of
from fits.paper.settings import PaperSettings
from fits.paper.sources import Sources
from fits.pseudo_cl import sky_fraction
from jaxsky.io import InputError

__all__ = ["figure_b_modes"]

#: The paper's bands of COrE [GHz].
BANDS = ("45", "105", "315")
#: Resolution of the embedded model here, and the largest multipole.
NSIDE, LMAX = 128, 250
#: |b| above this is 63 % of the sky, as the paper's mask leaves [deg].
LATITUDE = 21.7


def _settings(settings: PaperSettings, sources: Sources) -> ForecastSettings:
    """Those of a forecast with the sky of the figures."""
    mask = Mask(latitude=LATITUDE)
    if settings.paper.mask is not None:
        mask = Mask(**settings.paper.mask.model_dump())
    lmax = LMAX
    sky: dict[str, object] = {"embedded": Embedded(nside=NSIDE)}
    if not sources.embedded:
        sky = {"templates": settings.templates, "fixed": settings.fixed}
        lmax = min(LMAX, 2 * min(sources.template(n).nside for n in ("dust", "synchrotron")) - 8)
    return ForecastSettings.model_validate(
        {
            "title": settings.title,
            "data_dir": settings.data_dir,
            "experiment": {"instrument": "core"},
            "mask": mask,
            "spectra": Spectra(bands=list(BANDS), lmax=lmax, fit=(20, min(200, lmax - 10))),
            **sky,
        }
    )


def figure_b_modes(settings: PaperSettings, sources: Sources, out: Path) -> Item:
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
    fraction = 100 * sky_fraction(found.setup.mask)
    where = "the mask" if chosen.mask.file else f"|b| = {LATITUDE:g} deg"
    sky = sources.sky_differs
    if sources.embedded:
        sky = f"The sky is the embedded model of the Galaxy at nside {NSIDE}."
    return Item(
        "Figure 12",
        "primordial B modes and foregrounds",
        "BB of the foregrounds in three bands of COrE (thick) and their noise (thin), outside "
        f"{where}, {fraction:.0f} % of the sky, with the mixing of the mask undone, against "
        "primordial BB for several r, and lensing.",
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
