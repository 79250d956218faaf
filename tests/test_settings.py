"""Experiment files: values of their types, within bounds, and names that results can bear.

Whatever is wrong is refused with one sentence that names the file and the key.
"""

import pytest

from jaxsky.io import InputError
from jaxsky.settings import SettingsError, at_key, load, of_file
from refusals import cases, raises, refused
from settings_fuzz import KINDS, changed, changed_at, fault, faults, small, written

#: The least that a file has to say of a band and of a component.
BAND = '[[bands]]\nname = "{band}"\n'
MAP = BAND + 'file = "a.fits"\nbandpass = {{ center = 30 }}\nnoise = {{ rms = 1 }}\n'
SKY = '[sky."{component}"]\nlaw = "dust"\n'
TEMPLATE = SKY + 'file = "a.fits"\nnu_ref = 353\n'
#: What commands are given: something to simulate, maps, and maps with laws alone.
FILES = {
    "simulated": BAND + "bandpass = {{ center = 30 }}\nfwhm = 60\n" + TEMPLATE,
    "observed": MAP + TEMPLATE,
    "separated": MAP + SKY + '[free."x.beta_dust"]\nstart = 1.5\n',
}
TABLES = ["simulate", "fit", "compare", "separate", "forecast", "paper", "common", "cmb"]
KEYS = {
    "nside": ["common.nside", "simulate.nside", "sky.embedded.nside"],
    "fwhm": ["common.fwhm", "simulate.fwhm", "paper.fwhm"],
    "seed": ["seed", "sky.embedded.seed", "simulate.small_scales_seed"],
    "unknown": ["nonsense", *(f"{table}.nonsense" for table in TABLES)],
}
BASES = cases("settings/bases")
#: A band of an instrument's file.
OWN = {"name": "a", "bandpass": {"center": 44.0}, "fwhm": 27.0, "noise": {"level": 240.0}}


def check_refused(path, *words):
    """Settings are refused with a sentence that begins with the file and has these words."""
    with refused(".", SettingsError, path) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ")
    for word in words:
        assert word in str(caught.value)


def settings_in(folder, text, band="30", component="dust"):
    path = folder / "settings.toml"
    path.write_text(text.format(band=band, component=component))
    return path


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_files_that_are_right(tmp_path, text):
    for band in ("30", "Ka", "100-1a", "44.1", "L1+040_x", "b" * 40):
        assert load(settings_in(tmp_path, text, band)).bands[0].name == band
    for component in ("dust", "Dust_1", "2nd-dust", "d" * 40):
        assert component in load(settings_in(tmp_path, text, component=component)).sky.components


@pytest.mark.parametrize("command", BASES)
def test_settings_that_are_right(tmp_path, command):
    load(written(tmp_path / "settings.toml", BASES[command]))
    for key, value in (("seed", 2**32 - 1), ("common/fwhm", 60)):
        load(written(tmp_path / "settings.toml", changed_at(BASES[command], key, value)))


@pytest.mark.parametrize(
    ("command", "row"), [(name, row) for name in BASES for row in cases(f"settings/{name}")]
)
def test_values_that_are_refused(tmp_path, command, row):
    key, value, *words = row
    path = written(tmp_path / "settings.toml", changed_at(BASES[command], key, value))
    check_refused(path, *words)


@pytest.mark.parametrize(("kind", "value", "words"), cases("settings/numbers"))
def test_numbers_of_other_types_or_out_of_bounds(tmp_path, kind, value, words):
    for key in KEYS[kind]:
        raw = changed_at(BASES["fit"], key.replace(".", "/"), value)
        check_refused(written(tmp_path / "settings.toml", raw), f"{key}: {words}")


@pytest.mark.parametrize("row", cases("settings/instruments"))
def test_instruments_of_ones_own(tmp_path, row):
    changes, *words = row
    path = written(tmp_path / "settings.toml", {"bands": [{"instrument": "own.toml"}]})
    written(tmp_path / "own.toml", {"bands": [OWN]})
    load(path)
    bands = [{k: v for k, v in (OWN | change).items() if v is not None} for change in changes]
    written(tmp_path / "own.toml", {"bands": bands})
    check_refused(path, "bands.0.instrument", "own.toml", *words)


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
@pytest.mark.parametrize("name", [" ", "a b", "a/b", "..", ".a", "-a", "\u03b2", "a:b", "a$b$"])
def test_names_that_files_or_columns_cannot_bear(tmp_path, text, name):
    letters = "a name consists of letters, digits and _ + -"
    check_refused(settings_in(tmp_path, text, name), f"bands.0.name: {letters} ., and")
    check_refused(settings_in(tmp_path, text, component=name), f"sky.{name}: {letters}, and")
    path = settings_in(tmp_path, f'regions."{name}" = "full"')
    check_refused(path, f"regions.{name}: {letters}, and")


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_names_that_are_long_dotted_or_taken(tmp_path, text):
    long = "a" * 80
    words = "bands.0.name: a name has at most 40 characters, not 80"
    check_refused(settings_in(tmp_path, text, long), words)
    words = f"sky.{long}: a name has at most 40"
    check_refused(settings_in(tmp_path, text, component=long), words)
    check_refused(settings_in(tmp_path, text, component="a.b"), "sky.a.b: a name consists of")
    taken = ["noise", "Total", "residual", "r", "A_lens", "offset", "center"]
    for name in (*taken, "gain", "shift", "width", "angle", "cmb", "CMB"):
        words = f"sky.{name}: the name {name!r} has a meaning of its own in results"
        check_refused(settings_in(tmp_path, text, component=name), words)


def test_names_that_are_alike(tmp_path):
    for name, words in [("30a", "must differ, but"), ("30A", "must differ by more than capitals")]:
        path = settings_in(tmp_path, MAP.replace("{band}", name) + MAP, "30a")
        check_refused(path, f"names of the bands {words}")
    path = settings_in(tmp_path, '[sky.Dust]\nlaw = "dust"\n' + TEMPLATE)
    check_refused(path, "names of the components must differ by more than")


def test_set_replaces_a_key_and_nothing_else(tmp_path):
    path = tmp_path / "x.toml"
    path.write_text(
        "[truth]\n'dust.T_dust' = 20.0\n[sky]\nembedded = { nside = 16 }\n"
        "[[bands]]\nname = 'a'\nfwhm = 30.0\nnoise = { level = 2.0 }\n"
        "[free]\n'dust.beta_dust' = { start = 1.5, uniform = [1.0, 2.0] }\n"
    )
    changed = load(path, cases("settings/several_assignments"))
    assert changed.truth == {}
    (band,) = changed.bands
    assert (band.fwhm, band.noise.rms, band.noise.level) == (30.0, 1.0, None)
    assert changed.free["dust.beta_dust"].start == 1.6
    assert changed.free["dust.beta_dust"].uniform == (1.0, 2.0)
    assert changed.free["dust.T_dust"].gaussian == (20.0, 1.0)
    assert (changed.common.nside, changed.seed, changed.fit.regions) == (32, 3, ["full"])
    assert changed.cmb.include is False
    assert changed.title == "\N{GREEK SMALL LETTER BETA} \N{COMET} = 2"
    for entry in ("1", "44"):
        with pytest.raises(SettingsError, match=f"=3: {entry}: is not among the 1 entries"):
            load(path, [f"bands.{entry}.fwhm=3"])
    with pytest.raises(SettingsError, match=r"bands.0.fwhm=3: 0: is not among the entries of \[\]"):
        load(path, ["bands=[]", "bands.0.fwhm=3"])


@pytest.mark.parametrize(("assignment", "words"), cases("settings/assignments"))
def test_keys_without_a_meaning_are_refused(tmp_path, assignment, words):
    path = written(tmp_path / "x.toml", {"sky": {"embedded": {"nside": 16}}})
    with pytest.raises(SettingsError) as mistake:
        load(path, [assignment])
    assert words in str(mistake.value)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("every", "build"), [(2, False), pytest.param(11, True, marks=pytest.mark.slow)]
)
def test_any_value_at_any_key_works_or_is_refused(tmp_path, kind, every, build):
    assert faults(kind, tmp_path / "settings.toml", every, build) == []


@pytest.mark.parametrize(("kind", "at", "value"), cases("settings/built"))
def test_settings_that_cannot_work_are_refused(tmp_path, kind, at, value):
    path = tmp_path / "settings.toml"
    raw = changed(small(kind), tuple(at), value)
    assert fault(kind, raw, tuple(at), path) is None
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
    raises(SettingsError, r"^free\.dust\.T_dust: start is missing\.$", settings.start, "fit")


def test_a_key_is_named_once():
    for error in (SettingsError("a.b: x"), InputError("file: x")):
        with pytest.raises(type(error), match=f"^{error}$"), at_key("a"):
            raise error
    for error in (ValueError("x"), KeyError("x"), TypeError("x"), ZeroDivisionError("x")):
        with pytest.raises(SettingsError, match=r"^a\.b: x\.$"), at_key("a.b"):
            raise error


def test_what_is_no_toml_is_refused(tmp_path):
    path = tmp_path / "settings.toml"
    for content, words in (
        (b"this is not TOML", "TOML"),
        (b"title = 'a'\ntitle = 'b'\n", "TOML"),
        (b"\xff\xfe\x00", "TOML"),
        (b"a = " + 10000 * b"[" + 10000 * b"]", "nested"),
        (b"a = " + 3000 * b"{a=" + b"1" + 3000 * b"}", ""),
    ):
        path.write_bytes(content)
        check_refused(path, words)
