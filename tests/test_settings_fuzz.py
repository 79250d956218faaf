"""Settings with any value at any key load, or are refused with the file and the key."""

import pytest

from jaxsky.io import InputError
from jaxsky.settings import SettingsError, at_key, load, of_file
from refusals import refused
from settings_fuzz import KINDS, changed, fault, faults, small, written


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("every", "build"), [(2, False), pytest.param(11, True, marks=pytest.mark.slow)]
)
def test_settings_work_or_are_refused(tmp_path, kind, every, build):
    assert faults(kind, tmp_path / "settings.toml", every, build) == []


@pytest.mark.parametrize(
    ("kind", "at", "value"),
    [
        ("simulate", ("bands", 0, "instrument"), "spt"),
        ("simulate", ("bands", 0, "channels"), ["44"]),
        ("simulate", ("fixed",), {"dust.beta": 1.5}),
        ("simulate", ("cmb",), {"r": 0.1, "cosmology": {"H0": -1e300}}),
        ("simulate", ("cmb",), {"r": 1e300}),
        ("forecast", ("bands", 0, "channels"), ["44"]),
        ("forecast", ("forecast", "bands"), ["44"]),
        ("separate", ("bands", 0, "instrument"), "spt"),
        ("separate", ("bands", 0, "channels"), ["44"]),
    ],
)
def test_settings_that_cannot_work_are_refused(tmp_path, kind, at, value):
    path = tmp_path / "settings.toml"
    raw = changed(small(kind), at, value)
    assert fault(kind, raw, at, path) is None
    key = ".".join(map(str, at[:2]))
    with pytest.raises(SettingsError, match=rf"^{path}: {key}"), of_file(path):
        KINDS[kind].build(load(path))


def test_what_a_command_leaves_out_of_free_parameters_is_said(tmp_path):
    free = {
        "dust.beta_dust": {"uniform": [0.5, 2.5], "regions": {"nside": 2}},
        "offset.44.Q": {"gaussian": [1.0, 0.1]},
        "dust.T_dust": {},
    }
    settings = load(written(tmp_path / "settings.toml", {"free": free}))
    said = {name: settings.left_out(name) for name in ("fit", "separate", "forecast")}
    assert [len(sentences) for sentences in said.values()] == [1, 1, 3]
    assert "jaxsky fit does not have regions of parameters: dust.beta_dust." in said["fit"][0]
    assert "jaxsky separate does not have them: offset.44.Q." in said["separate"][0]
    assert "jaxsky forecast does not have uniform ones: dust.beta_dust." in said["forecast"][2]
    with pytest.raises(SettingsError, match=r"^free\.dust\.T_dust: start is missing\.$"):
        settings.start("fit")


def test_a_key_is_named_once():
    for error in (SettingsError("a.b: x"), InputError("file: x")):
        with pytest.raises(type(error), match=f"^{error}$"), at_key("a"):
            raise error
    for error in (ValueError("x"), KeyError("x"), TypeError("x"), ZeroDivisionError("x")):
        with pytest.raises(SettingsError, match=r"^a\.b: x\.$"), at_key("a.b"):
            raise error


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a = " + 10000 * b"[" + 10000 * b"]", "nested"),
        (b"a = " + 3000 * b"{a=" + b"1" + 3000 * b"}", ""),
    ],
    ids=["lists", "tables"],
)
def test_what_is_no_toml_is_refused(tmp_path, content, words):
    path = tmp_path / "settings.toml"
    path.write_bytes(content)
    with refused(rf"^{path}: .*{words}", SettingsError):
        load(path)
