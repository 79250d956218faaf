"""Where files that settings name are found, and what is said of those that are not."""

import os
import stat

import numpy as np
import pytest

from fits.commands.forecast import forecast_inputs
from fits.inputs import inputs_of
from fits.paper.sky import PaperSky
from fits.regions import region_masks
from fits.results import write_log
from fits.separated_data import separation_data
from jaxsky.experiment import simulation_inputs
from jaxsky.io import InputError, write_maps
from jaxsky.io.files import cache_folder
from jaxsky.settings import Experiment, SettingsError, circumstances, find_file, load
from refusals import cases, raises
from settings_fuzz import changed_at, written


@pytest.fixture
def places(tmp_path, monkeypatch):
    """The folder of the settings, the cache, and a home."""
    for name in ("data", "cache", "home"):
        (tmp_path / name).mkdir()
    monkeypatch.setenv("JAXSKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("JAXSKY_DATA", str(tmp_path / "elsewhere"))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    return tmp_path / "data", tmp_path / "cache", tmp_path / "home"


def test_the_cache_is_the_platforms_or_that_of_the_environment(places, monkeypatch):
    assert cache_folder() == places[1]
    monkeypatch.setenv("JAXSKY_CACHE", "~/maps")
    assert cache_folder() == places[2] / "maps"
    monkeypatch.delenv("JAXSKY_CACHE")
    assert cache_folder().name == "jaxsky"
    assert cache_folder().is_absolute()
    assert "elsewhere" not in str(cache_folder())  # $JAXSKY_DATA is for settings only


def test_a_bare_name_is_next_to_the_settings_or_in_the_cache(places):
    data, cache, _ = places
    (cache / "a.fits").touch()
    assert find_file(data, "a.fits") == cache / "a.fits"
    (data / "a.fits").touch()
    assert find_file(data, "a.fits") == data / "a.fits"
    # With a folder it is meant where it says.
    for name in ("./b.fits", "sub/b.fits", f"{data}/b.fits"):
        (cache / "b.fits").touch()
        raises(InputError, r"b.fits: no such file", find_file, data, name)
    assert find_file(data, "../cache/b.fits").samefile(cache / "b.fits")
    assert find_file(data / "nowhere", "b.fits") == cache / "b.fits"


def test_home_and_environment_are_expanded(places, monkeypatch):
    data, _, home = places
    (home / "a.fits").touch()
    monkeypatch.setenv("MAPS", str(home))
    for name in ("~/a.fits", "$MAPS/a.fits", "${MAPS}/a.fits", "${NO_MAPS:-~}/a.fits"):
        assert find_file(data, name) == home / "a.fits"
    # A file that is called so.
    for name in ("~a.fits", "map$1.fits"):
        (data / name).touch()
        assert find_file(data, name) == data / name
    with pytest.raises(InputError, match="the environment variable NO_MAPS is not set"):
        find_file(data, "$NO_MAPS/a.fits")


def test_missing_files_are_answered_with_the_command_that_brings_them(places):
    data, cache, _ = places
    for name, sentence in cases("lookup/missing"):
        with pytest.raises(InputError) as caught:
            find_file(data, name)
        assert str(caught.value) == sentence.format(data=data, cache=cache)


def test_what_is_there_and_no_file_is_called_what_it_is(places, monkeypatch):
    data, cache, _ = places
    (data / "folder").mkdir()
    (data / "file").touch()
    (data / "link").symlink_to("gone.fits")
    (cache / "cached").symlink_to(data / "gone.fits")
    (data / "circle").symlink_to("circle")
    os.mkfifo(data / "pipe")
    long = (300 * "a", r"cannot be read \(File name too long\)")
    for name, words in [*cases("lookup/no_files"), long]:
        raises(InputError, words, find_file, data, name)
    (data / "file").chmod(0)
    monkeypatch.setattr(os, "access", lambda path, mode: os.stat(path).st_mode & stat.S_IRUSR)
    raises(InputError, r"file: cannot be read \(no permission\)", find_file, data, "file")


def test_settings_expand_their_folder_and_refuse_what_is_none(places, monkeypatch):
    data, _, home = places
    path = data / "a.toml"
    monkeypatch.setenv("MAPS", str(home))
    for given, folder in (("~", home), ("$MAPS", home), ("${NO_MAPS:-/nowhere}", "/nowhere")):
        path.write_text(f"data_dir = '{given}'")
        assert load(path).data_dir == str(folder)
    (data / "circle").symlink_to("circle")
    for given, words in (
        ("a.toml", "a.toml: data_dir: .*a.toml is not a folder"),
        ("circle", "a.toml: data_dir: "),
        ("$NO_MAPS", "data_dir: the environment variable NO_MAPS is not set"),
    ):
        path.write_text(f"data_dir = '{given}'")
        raises(SettingsError, words, load, path)


def test_the_log_names_the_paths_that_were_taken(places, tmp_path):
    data, cache, _ = places
    for name in ("dust.fits", "mask.fits", "beta.fits"):
        (data / name).touch()
    (cache / "map.fits").touch()
    beta = {"file": "beta.fits", "fields": ["BETA"]}
    settings = Experiment(
        data_dir=str(data),
        sky={
            "dust": {
                "law": "dust",
                "file": "dust.fits",
                "nu_ref": 353.0,
                "parameters": {"beta_dust": beta},
            }
        },
        bands=[
            {
                "name": "dust.fits",
                "file": "map.fits",
                "bandpass": {"file": "none.txt"},
                "noise": {"covariance": ["QQ_COV", "QU_COV", "UU_COV"]},
            }
        ],
        regions={"mask": {"file": "mask.fits"}},
        fit={"regions": ["strip", "mask"]},
    )
    paths = {"map.fits": str(cache / "map.fits")}
    paths |= {name: str(data / name) for name in ("dust.fits", "mask.fits", "beta.fits")}
    assert circumstances(settings)["files"] == paths
    write_log(tmp_path / "log.json", settings, 1.0)
    assert '"map.fits": "' + str(cache / "map.fits") in (tmp_path / "log.json").read_text()


def fit(settings):
    region_masks(settings, settings.fit.regions)
    inputs_of(settings)


def paper(settings):
    sources = PaperSky(settings)
    sources.template("dust")
    sources.index("beta_syn")
    sources.ame()


#: What reads the settings of a command.
COMMANDS = {
    "fit": fit,
    "separate": separation_data,
    "forecast": forecast_inputs,
    "simulate": simulation_inputs,
    "paper": paper,
}


@pytest.mark.parametrize(("command", "changes"), cases("lookup/missing_files"))
def test_all_settings_find_files_in_the_same_places(places, command, changes):
    raw = cases("lookup/bases")[command]
    data, cache, _ = places
    maps = 1 + np.arange(2 * 12 * 4**2).reshape(2, -1)
    write_maps(data / "dust.fits", maps, names=["Q", "U"], unit="uK_RJ")
    write_maps(data / "beta.fits", 3.0 + 0.01 * maps[:1] / maps.max(), names=["BETA"], unit="")
    for key, value in changes.items():
        raw = changed_at(raw, key, value)
    path = written(data / "settings.toml", raw)
    words = f"none.fits: no such file, and none in the cache {cache}"
    with pytest.raises(ValueError, match=words):
        COMMANDS[command](load(path))
