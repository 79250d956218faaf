"""Settings with any value at any key load, or are refused with the file and the key."""

import pytest

from jaxsky.io import InputError
from jaxsky.settings import SettingsError
from jaxsky.settings.keys import at_key, of_file
from settings_fuzz import KINDS, fault, faults, small


@pytest.mark.parametrize("kind", KINDS)
def test_settings_load_or_are_refused(tmp_path, kind):
    assert faults(kind, tmp_path / "settings.toml", every=2, build=False) == []


@pytest.mark.parametrize(
    ("kind", "at", "value"),
    [
        ("experiment", ("experiment", "instrument"), "spt"),
        ("experiment", ("experiment", "channels"), ["44"]),
        ("experiment", ("fixed",), {"dust.beta": 1.5}),
        ("experiment", ("cmb",), {"r": 0.1, "cosmology": {"H0": -1e300}}),
        ("experiment", ("cmb",), {"r": 1e300}),
        ("forecast", ("experiment", "channels"), ["44"]),
        ("forecast", ("spectra", "bands"), ["44"]),
        ("separate", ("embedded", "instrument"), "spt"),
        ("separate", ("embedded", "channels"), ["44"]),
    ],
)
def test_settings_that_cannot_work_are_refused(tmp_path, kind, at, value):
    raw, path = small(kind), tmp_path / "settings.toml"
    raw.setdefault(at[0], {})
    table = raw if len(at) == 1 else raw[at[0]]
    table[at[-1]] = value
    assert fault(kind, raw, at, path) is None
    with pytest.raises(SettingsError, match=rf"^{path}: {at[0]}"), of_file(path):
        KINDS[kind].build(KINDS[kind].load(path))


def test_a_key_is_named_once():
    for error in (SettingsError("a.b: x"), InputError("file: x")):
        with pytest.raises(type(error), match=f"^{error}$"), at_key("a"):
            raise error
    for error in (ValueError("x"), KeyError("x"), TypeError("x"), ZeroDivisionError("x")):
        with pytest.raises(SettingsError, match=r"^a\.b: x\.$"), at_key("a.b"):
            raise error


def test_deep_settings_are_refused(tmp_path):
    path = tmp_path / "settings.toml"
    for text in ("a = " + 10000 * "[" + 10000 * "]", "a = " + toml_of_depth(3000)):
        path.write_text(text)
        with pytest.raises(SettingsError, match=rf"^{path}: "):
            KINDS["fit"].load(path)


def toml_of_depth(depth: int) -> str:
    return depth * "{a=" + "1" + depth * "}"
