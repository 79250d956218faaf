"""Titles and names are drawn as they are, whatever they look like to TeX."""

import matplotlib as mpl
import numpy as np
import pytest

mpl.use("Agg")

import matplotlib.pyplot as plt

import fits
import jaxsky
from fits.commands.fit import _drawable, plot_marginals, plot_posterior
from fits.commands.run import with_vectors
from fits.plots import (
    band_title,
    color_limit,
    draw_title,
    in_formula,
    label,
    pages,
    plain,
    plot_chains,
    save,
)
from fits.results import FitResult, with_errors
from fits.spectral_index import RegionFit
from refusals import cases


@pytest.mark.parametrize("name", cases("plots/names"))
def test_any_name_is_drawn(tmp_path, name):
    figure, axes = plt.subplots(layout="constrained")
    draw_title(figure, f"{name}\n{name}")
    axes.set_title(plain(f"{name}: Q") + r", $\chi^2$")
    axes.set_xlabel(f"${in_formula(name)}$")
    axes.set_ylabel(f"${label(f'gain.{name}')}$, ${label(f'{name}.beta_dust')}$")
    axes.plot([0, 1], label=plain(name))
    axes.legend(handles=axes.lines)
    save(figure, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 5000


def test_titles_keep_their_characters():
    figure = plt.figure()
    draw_title(figure, r"$x_$ and \$ 100 %")
    assert figure._suptitle.get_text().replace(r"\$", "$") == r"$x_$ and \$ 100 %"
    plt.close(figure)


def test_fits_without_a_chain_or_an_error_are_left_out(tmp_path):
    """One parameter at the edge of its prior, and a chain that had nothing to draw from."""
    free, nan = ("dust.beta_dust", "dust.T_dust"), float("nan")
    best = {"dust.beta_dust": 1.5, "dust.T_dust": 40.0}
    sigma = {"dust.beta_dust": 0.1, "dust.T_dust": nan}
    ends = {name: (best[name] - sigma[name], best[name] + sigma[name]) for name in free}
    covariance = np.diag([0.01, nan])
    edge = FitResult(
        "gradient", best, sigma, ends, free, covariance, 1.0, 10, False, "It is at an edge.", {}
    )
    nothing = dict.fromkeys(free, nan)
    open_ = edge._replace(
        method="mcmc", best_fit=nothing, sigma=nothing, message="Nothing.", chi2=nan
    )
    fit = RegionFit("full", "QU", {"gradient": edge, "mcmc": open_}, {}, 10, None)
    assert not plot_posterior(tmp_path / "posterior.png", [fit], None, "")
    plot_marginals(tmp_path / "marginals.png", [fit], None, "")
    assert (tmp_path / "marginals.png").exists()
    chain = np.random.default_rng(0).normal([1.5, 39.0], [0.1, 1.0], (200, 8, 2))
    drawn = edge._replace(details={"chain": chain, "discard": 0, "thin": 1}).with_chain(chain)
    fit = fit._replace(results={"gradient": edge, "mcmc": drawn})
    assert [one for one, _ in _drawable([fit], "dust.T_dust")] == [fit]
    assert plot_posterior(tmp_path / "posterior.png", [fit], None, "")
    assert open_.judged(nan, 10, best) == open_
    assert str(open_).splitlines()[2].split() == ["dust.T_dust", "unknown"]
    assert with_errors(nan, nan, nan) == ""
    assert with_errors(40.0, nan, nan) == "40.0000"


def test_maps_without_a_pixel_have_a_scale_of_colours():
    assert color_limit(np.full(12, np.nan)) == 1.0


@pytest.mark.parametrize("width", [3.5, 5.0, 7.0])
def test_titles_are_as_wide_as_the_figure(width):
    figure = plt.figure(figsize=(width, 2))
    draw_title(figure, "Embedded model of the Galaxy (not data), Planck and WMAP")
    box = figure._suptitle.get_window_extent()
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    plt.close(figure)


def test_chains_of_any_name_are_drawn(tmp_path):
    free = ("dust.$x_$", "gain.44_%")
    chain = np.random.default_rng(0).normal(size=(200, 8, 2))
    result = FitResult(
        "mcmc",
        dict.fromkeys(free, 0.0),
        dict.fromkeys(free, 1.0),
        dict.fromkeys(free, (-1.0, 1.0)),
        free,
        np.eye(2),
        1.0,
        10,
        True,
        "",
        {"chain": chain, "discard": 0, "thin": 1},
    )
    plot_chains(tmp_path / "chains.png", {"$x_$ [/]": result, "b": result}, None, "$x_$")
    assert (tmp_path / "chains.png").exists()


def test_many_bands_are_spread_over_pictures():
    bands = [f"{nu}" for nu in range(7)]
    assert pages("maps", bands, 3) == {
        "maps.png": bands[:3],
        "maps_2.png": bands[3:6],
        "maps_3.png": bands[6:],
    }
    assert pages("maps", [], 3) == {}


@pytest.mark.parametrize(("name", "drawn"), [("44", "44 GHz"), ("44.5", "44.5 GHz"), ("W", "W")])
def test_bands_are_named_with_their_unit(name, drawn):
    assert band_title(name) == drawn


@pytest.mark.parametrize(("form", "head"), [("pdf", b"%PDF"), ("svg", b"<?xml")])
def test_matplotlib_settings_ask_for_vector_pictures(tmp_path, form, head):
    with mpl.rc_context({"savefig.format": form}):
        save(plt.figure(), tmp_path / "maps_1.png")
    assert (tmp_path / f"maps_1.{form}").read_bytes().startswith(head)
    assert (tmp_path / "maps_1.png").read_bytes().startswith(b"\x89PNG")
    save(plt.figure(), tmp_path / "other.png")
    assert [path.name for path in tmp_path.glob("other.*")] == ["other.png"]


def test_vector_pictures_are_results_too():
    found = with_vectors(("result.json", "maps_*.png"))
    assert found == ("result.json", "maps_*.png", "maps_*.pdf", "maps_*.svg")


def test_the_picture_of_seds_has_the_rms_of_each_component():
    """P of a template with Q = 3 and U = 4 has an rms of 5 at the reference frequency."""
    maps = np.ones((2, 12)) * np.array([[3.0], [4.0]])
    sky = jaxsky.Sky({"synchrotron": jaxsky.Synchrotron(maps, beta_syn=3.0, nu_ref=40.0)})
    bands = {"40": jaxsky.Bandpass.top_hat(40.0, 8.0), "90": jaxsky.Bandpass.delta(90.0)}
    axes = plt.figure().subplots()
    assert fits.plot_sed(sky, bands, cmb_rms=2.0, axes=axes, samples=5) is axes
    synchrotron, cmb = axes.lines
    nu = synchrotron.get_xdata()
    np.testing.assert_allclose(nu[[0, -1]], [40 / 1.5, 90 * 1.5])
    np.testing.assert_allclose(synchrotron.get_ydata(), 5 * (nu / 40) ** -3, rtol=1e-6)
    x = 6.62607015e-34 * nu * 1e9 / (1.380649e-23 * 2.72548)
    expected = 2 * x**2 * np.exp(x) / np.expm1(x) ** 2
    np.testing.assert_allclose(cmb.get_ydata(), expected, rtol=1e-6)
    assert len(axes.patches) == 2
    shaded = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    np.testing.assert_allclose([shaded.x0, shaded.x1], [36, 44], rtol=1e-6)
    plt.close(axes.figure)


def test_the_picture_of_seds_needs_bands():
    sky = jaxsky.Sky({"synchrotron": jaxsky.Synchrotron(np.ones((2, 12)))})
    with pytest.raises(ValueError, match="`bands` must be at least one Bandpass by name"):
        fits.plot_sed(sky, {})
