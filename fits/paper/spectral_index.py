"""The spectral-index test: figure 11."""

from pathlib import Path

from fits.common import common_maps
from fits.paper.comparisons import shared_inputs
from fits.paper.item import Impossible, Item, Number, picture_of
from fits.paper.sources import Sources, listed
from fits.posterior_plots import plot_grids
from fits.regions import region_masks, region_words
from fits.report import known_truth, with_errors
from fits.spectral_index import run
from jaxsky.settings import Experiment, SettingsError

#: The bands that the paper fits.
BANDS = ("44", "70")
#: What it finds, by region and parameter.
PAPER = {
    ("strip", "dust.beta_dust"): "1.6 +0.5 -0.2",
    ("strip", "synchrotron.beta_syn"): "3.4 +0.7 -0.5",
    ("full", "dust.beta_dust"): "1.6 +0.6 -0.3",
    ("full", "synchrotron.beta_syn"): "3.4 +0.9 -0.6",
}


def figure_probability(settings: Experiment, sources: Sources, out: Path) -> Item:
    """Figure 11: the probability of beta_dust and beta_syn on a grid, from Q and from U."""
    inputs, picture = shared_inputs(settings, sources), picture_of("Figure 11")
    bands = {name: inputs.bands[name] for name in BANDS if name in inputs.bands} or inputs.bands
    if len(settings.free_in("fit")) != 2:
        raise Impossible("A grid takes two free parameters, in the table `free`.")
    spec = settings.fit.model_copy(
        update={"methods": ["grid"], "stokes": ["Q", "U", "QU"], "regions": ["strip", "full"]}
    )
    chosen, common = settings.model_copy(update={"fit": spec}), settings.common
    prepared = common_maps(inputs._replace(bands=bands), common.nside, common.fwhm)
    try:
        fits = run(chosen, prepared, region_masks(chosen, spec.regions))
    except SettingsError as error:
        raise Impossible(str(error)) from None
    plot_grids(out / picture, fits, known_truth(inputs, fits), settings.title)
    numbers, truth = [], inputs.truth or {}
    for fit in fits:
        result = fit.results["grid"]
        numbers += [
            Number(
                f"{name}, {fit.region}, Q and U",
                PAPER.get((fit.region, name), "not given"),
                with_errors(result.best_fit[name], *result.interval_68[name]),
                f"truth {truth[name]:g}" if name in truth else "",
            )
            for name in result.free
            if fit.stokes == "QU"
        ]
    names = listed(bands)
    return Item(
        "Figure 11",
        "probability of the spectral indices",
        f"Probability of the free parameters from the bands {names}: Q, U and both together, "
        f"in {region_words(settings, 'strip')} (above) and the full sky (below); contours "
        "hold 68 and 95 per cent.",
        "Noise after smoothing is correlated between pixels and the CMB between bands: the "
        "likelihood has both, where the paper's sum over pixels has neither. "
        + ("The maps are simulated." if sources.simulated else sources.sky_differs),
        picture,
        numbers=tuple(numbers),
    )
