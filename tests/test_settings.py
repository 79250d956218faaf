"""Experiment files: values of their types, within bounds, and names that results can bear."""

import pytest

from jaxsky.settings import SettingsError, load

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
NSIDES = ["common.nside", "simulate.nside", "sky.embedded.nside", "compare.panel_nside"]
BEAMS = ["common.fwhm", "simulate.fwhm", "paper.fwhm"]
SEEDS = ["seed", "sky.embedded.seed", "simulate.small_scales_seed"]
TABLES = ["simulate", "fit", "compare", "separate", "forecast", "paper", "common", "cmb"]


def read(folder, text, main="", band="30", component="dust"):
    path = folder / "settings.toml"
    path.write_text(f"{main}\n" + text.format(band=band, component=component))
    return load(path)


def refused(folder, words, text="", **arguments):
    with pytest.raises(SettingsError) as mistake:
        read(folder, text, **arguments)
    sentence = str(mistake.value)
    assert sentence.startswith(f"{folder / 'settings.toml'}: ")
    assert words in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_files_that_are_right(tmp_path, text):
    for band in ("30", "Ka", "100-1a", "44.1", "L1+040_x", "b" * 40):
        assert read(tmp_path, text, band=band).bands[0].name == band
    for component in ("dust", "Dust_1", "2nd-dust", "d" * 40):
        assert component in read(tmp_path, text, component=component).sky.components


@pytest.mark.parametrize(
    ("keys", "value", "words"),
    [
        (NSIDES, "true", "input should be a valid integer, not True."),
        (NSIDES, '"16"', "input should be a valid integer, not '16'."),
        (NSIDES, "16.0", "input should be a valid integer, not 16.0."),
        (NSIDES, "12", "nside must be a power of two, not 12."),
        (NSIDES, "0", "input should be greater than 0, not 0."),
        (NSIDES, "-8", "input should be greater than 0, not -8."),
        (NSIDES, "16384", "input should be less than or equal to 8192, not 16384."),
        (NSIDES, f"{2**40}", "input should be less than or equal to 8192, not 10995116"),
        (NSIDES, "[16]", "input should be a valid integer, not [16]."),
        (BEAMS, '"60"', "input should be a valid number"),
        (BEAMS, "true", "input should be a valid number"),
        (BEAMS, "nan", "input should be a finite number"),
        (SEEDS, "true", "input should be a valid integer, not True."),
        (SEEDS, '"1"', "input should be a valid integer, not '1'."),
        (SEEDS, "1.0", "input should be a valid integer, not 1.0."),
        (SEEDS, "-1", "input should be greater than or equal to 0, not -1."),
        (SEEDS, f"{2**32}", "input should be less than 4294967296, not 4294967296."),
        (SEEDS, f"{2**53}", "input should be less than 4294967296, not 9007199254740992."),
        (["nonsense", *(f"{table}.nonsense" for table in TABLES)], "1", "unknown key."),
    ],
)
def test_numbers_of_other_types_or_out_of_bounds(tmp_path, keys, value, words):
    for key in keys:
        refused(tmp_path, f"{key}: {words}", FILES["observed"], main=f"{key} = {value}")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("simulate.include = []", "simulate.include: list should have at least 1 item"),
        ('simulate.include = [""]', "simulate.include.0: string should have at least 1"),
        ('simulate.include = ["cmb", "cmb"]', "simulate.include: has 'cmb' twice."),
        ('simulate.sheet = "no"', "simulate.sheet: input should be a valid boolean, not 'no'."),
        ('bands = [{ instrument = "" }]', "bands.0.instrument: must not be empty."),
        ('fit.regions = ["full", "full"]', "fit.regions: has 'full' twice."),
        ('fit.stokes = ["Q", "Q"]', "fit.stokes: has 'Q' twice."),
        ('fit.methods = ["grid", "grid"]', "fit.methods: has 'grid' twice."),
        ("fit.methods = []", "fit.methods: list should have at least 1 item"),
        ("regions.strip = 20", "regions.strip: input should be a valid string or a valid table, "),
        ("common.mask = 1", "common.mask: input should be a valid table, not 1."),
        ('common.mask = { file = "" }', "common.mask.file: "),
        ('free."dust.beta_dust" = { start = 1.5, uniform = [1, true] }',
         "free.dust.beta_dust.uniform.1: input should be a valid number, not True."),
        ('free."dust.beta_dust" = { start = 1.5, uniform = [1, 2, 3] }',
         "free.dust.beta_dust.uniform: tuple should have at most 2 items"),
        ('fixed."dust.beta_dust" = "1.5"',
         "fixed.dust.beta_dust: input should be a valid number, not '1.5'."),
        ("separate.nsims = true", "separate.nsims: input should be a valid integer, not True."),
        ("separate.nsteps = 200.0", "separate.nsteps: input should be a valid integer"),
        ("separate.purify = 0", "separate.purify: input should be a valid boolean"),
        ('forecast.spectra = ["BB", "BB"]', "forecast.spectra: has 'BB' twice."),
        ("forecast.spectra = []", "forecast.spectra: list should have at least 1 item"),
        ("forecast.fisher_lmax = 300.0",
         "forecast.fisher_lmax: input should be a valid integer, not 300.0."),
        ("cmb.r = false", "cmb.r: input should be a valid number, not False."),
        ("forecast.show_r = [0.1, 0.1]", "forecast.show_r: has 0.1 twice."),
        ("forecast.fit = [20, true]", "forecast.fit.1: input should be a valid integer"),
        ("paper.center = [180, true]", "paper.center.1: input should be a valid number"),
        ("compare.regions = 'm.fits'", "compare.regions: input should be a valid list, not"),
    ],
)  # fmt: skip
def test_lists_and_switches(tmp_path, text, words):
    refused(tmp_path, words, main=text)


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
@pytest.mark.parametrize("name", ["", " ", "a b", "a/b", "..", ".a", "-a", "\u03b2", "a:b", "a$b$"])
def test_names_that_files_or_columns_cannot_bear(tmp_path, text, name):
    letters = "a name consists of letters, digits and _ + -"
    refused(tmp_path, f"bands.0.name: {letters} ., and", text, band=name)
    refused(tmp_path, f"sky.{name}: {letters}, and", text, component=name)
    refused(tmp_path, f"regions.{name}: {letters}, and", main=f'regions."{name}" = "full"')


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_names_that_are_long_dotted_or_taken(tmp_path, text):
    long = "a" * 80
    words = "bands.0.name: a name has at most 40 characters, not 80"
    refused(tmp_path, words, text, band=long)
    refused(tmp_path, f"sky.{long}: a name has at most 40", text, component=long)
    refused(tmp_path, "sky.a.b: a name consists of", text, component="a.b")
    taken = ["noise", "Total", "residual", "r", "A_lens", "offset", "center"]
    for name in (*taken, "gain", "shift", "width", "angle", "cmb", "CMB"):
        words = f"sky.{name}: the name {name!r} has a meaning of its own in results"
        refused(tmp_path, words, text, component=name)


def test_names_that_are_alike(tmp_path):
    second = MAP.replace("{band}", "{{}}") + MAP
    for name, words in [("30a", "must differ, but"), ("30A", "must differ by more than capitals")]:
        text = second.replace("{{}}", name)
        refused(tmp_path, f"names of the bands {words}", text, band="30a")
    second = '[sky.Dust]\nlaw = "dust"\n'
    words = "names of the components must differ by more than"
    refused(tmp_path, words, second + TEMPLATE)


def test_the_cmb_is_described_in_its_table(tmp_path):
    refused(tmp_path, "sky.other.law: the CMB is described in", main='sky.other.law = "cmb"')
    words = "sky.cmb: the name 'cmb' has a meaning of its own"
    refused(tmp_path, words, main='sky.cmb.law = "dust"')


def test_set_replaces_a_key_and_nothing_else(tmp_path):
    path = tmp_path / "x.toml"
    path.write_text(
        "[truth]\n'dust.T_dust' = 20.0\n[sky]\nembedded = { nside = 16 }\n"
        "[[bands]]\nname = 'a'\nfwhm = 30.0\nnoise = { level = 2.0 }\n"
        "[free]\n'dust.beta_dust' = { start = 1.5, uniform = [1.0, 2.0] }\n"
    )
    changed = load(
        path,
        [
            "truth = {}",
            "bands.0.noise = { rms = 1.0 }",
            "free.'dust.beta_dust'.start = 1.6",
            'free."dust.T_dust"={start = 20.0, gaussian = [20.0, 1.0]}',
            "seed=3",
            "common.nside=32",
            "fit.regions = ['full']",
            "cmb.include=false",
            "title = \N{GREEK SMALL LETTER BETA} \N{COMET} = 2",
        ],
    )
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


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        (
            "fixed = { 'dust.nu_ref' = 545.0 }",
            "fixed.dust.nu_ref: belongs next to law",
        ),
        ("sky.dust.parameters = { nu_ref = 545.0 }", "sky.dust: nu_ref belongs next to law"),
        ("sky.dust.noise = { level = 3.0 }", "sky.dust: fwhm, angles and noise are of a map"),
        (
            "sky.dust.small_scales = { EE = [9, 3], BB = [3, 9] }",
            "sky.dust.small_scales.EE: must increase, but is 9, 3",
        ),
        ("common.nside", "--set common.nside: must be KEY=VALUE"),
        ("=3", "--set =3: must be KEY=VALUE"),
        ("common.nside=33", "common.nside: nside must be a power of two, not 33 (given with --set"),
        (
            "fit.regions=[3]",
            "fit.regions.0: input should be a valid string, not 3 (given with --set",
        ),
        ("common=3", "common: input should be a valid table"),
        ("cmb.cosmology = { r = 0.1 }", "cmb.cosmology: 'r' is no parameter of the cosmology"),
    ],
)
def test_keys_without_a_meaning_are_refused(tmp_path, assignment, words):
    path = tmp_path / "x.toml"
    path.write_text("[sky]\nembedded = { nside = 16 }\n")
    with pytest.raises(SettingsError) as mistake:
        load(path, [assignment])
    assert words in str(mistake.value)
