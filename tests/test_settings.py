"""Settings of all commands: values of their types, within bounds, names that results can bear."""

import pytest
from fits.forecast.settings import ForecastSettings
from fits.paper.settings import PaperSettings
from fits.separate.settings import SeparateSettings
from fits.settings import Settings
from jaxsky.experiment.settings import Experiment

from jaxsky.settings import SettingsError
from jaxsky.settings.load import load

TEMPLATE = '[templates."{component}"]\nfile = "a.fits"\nlaw = "dust"\nnu_ref = 353\n'
BAND = '[[bands]]\nname = "{band}"\n'
MAP = BAND + 'file = "a.fits"\nbandpass = {{ center = 30 }}\nnoise = {{ rms = 1 }}\n'
ANALYSIS = "[analysis]\n{main}\n" + MAP + TEMPLATE
#: Command -> its settings, the least that a file has to say, and its table of components.
FORMATS = {
    "simulate": (
        Experiment,
        f"[experiment]\n{{main}}\n{BAND}bandpass = {{{{ center = 30 }}}}\nfwhm = 60\n{TEMPLATE}",
        "templates",
    ),
    "fit": (Settings, ANALYSIS, "templates"),
    "paper": (PaperSettings, ANALYSIS, "templates"),
    "separate": (
        SeparateSettings,
        '[separation]\n{main}\n[free."x.beta_dust"]\nstart = 1.5\n[components.cmb]\nlaw = "cmb"\n'
        '[components."{component}"]\nlaw = "dust"\n' + MAP,
        "components",
    ),
    "forecast": (
        ForecastSettings,
        f"[fisher]\n{{main}}\n[mask]\nlatitude = 20\n{BAND}center = 30\nwidth = 3\n"
        f"fwhm = 60\nnoise = 1\n{TEMPLATE}",
        "templates",
    ),
}
RESOLVED = [name for name in FORMATS if name != "forecast"]


def read(folder, command, main="", band="30", component="dust"):
    model, text, _ = FORMATS[command]
    path = folder / "settings.toml"
    path.write_text(text.format(main=main, band=band, component=component))
    return load(path, model)


def refused(folder, command, words, **arguments):
    with pytest.raises(SettingsError) as mistake:
        read(folder, command, **arguments)
    sentence = str(mistake.value)
    assert sentence.startswith(f"{folder / 'settings.toml'}: ")
    assert words in sentence
    assert "\n" not in sentence


@pytest.mark.parametrize("command", FORMATS)
def test_files_that_are_right(tmp_path, command):
    for band in ("30", "Ka", "100-1a", "44.1", "L1+040_x", "b" * 40):
        assert read(tmp_path, command, band=band).bands[0].name == band
    for component in ("dust", "Dust_1", "2nd-dust", "d" * 40):
        settings = read(tmp_path, command, component=component)
        assert component in getattr(settings, FORMATS[command][2])


@pytest.mark.parametrize("command", RESOLVED)
@pytest.mark.parametrize(
    ("main", "words"),
    [
        ("nside = true", "nside: input should be a valid integer, not True."),
        ('nside = "16"', "nside: input should be a valid integer, not '16'."),
        ("nside = 16.0", "nside: input should be a valid integer, not 16.0."),
        ("nside = 12", "nside: nside must be a power of two, not 12."),
        ("nside = 0", "nside: input should be greater than 0, not 0."),
        ("nside = -8", "nside: input should be greater than 0, not -8."),
        ("nside = 16384", "nside: input should be less than or equal to 8192, not 16384."),
        (f"nside = {2**40}", "nside: input should be less than or equal to 8192, not 10995116"),
        ("nside = [16]", "nside: input should be a valid integer, not [16]."),
        ('fwhm = "60"', "fwhm: input should be a valid number"),
        ("fwhm = true", "fwhm: input should be a valid number"),
        ("fwhm = nan", "fwhm: input should be a finite number"),
        ("seed = true", "seed: input should be a valid integer, not True."),
        ('seed = "1"', "seed: input should be a valid integer, not '1'."),
        ("seed = 1.0", "seed: input should be a valid integer, not 1.0."),
        ("seed = -1", "seed: input should be greater than or equal to 0, not -1."),
        (f"seed = {2**32}", "seed: input should be less than 4294967296, not 4294967296."),
        (f"seed = {2**53}", "seed: input should be less than 4294967296, not 9007199254740992."),
        ("nonsense = 1", "nonsense: unknown key."),
    ],
)
def test_numbers_of_other_types_or_out_of_bounds(tmp_path, command, main, words):
    refused(tmp_path, command, words, main=main)


@pytest.mark.parametrize(
    ("command", "main", "words"),
    [
        ("simulate", "outputs = []", "experiment.outputs: list should have at least 1 item"),
        ("simulate", 'outputs = ["total", "total"]', "experiment.outputs: has 'total' twice."),
        ("simulate", 'outputs = "total"', "experiment.outputs: input should be a valid list, not"),
        ("simulate", "include = []", "experiment.include: list should have at least 1 item"),
        ("simulate", 'include = [""]', "experiment.include.0: string should have at least 1"),
        ("simulate", 'include = ["cmb", "cmb"]', "experiment.include: has 'cmb' twice."),
        ("simulate", "sheet = 1", "experiment.sheet: input should be a valid boolean, not 1."),
        (
            "simulate",
            'sheet = "no"',
            "experiment.sheet: input should be a valid boolean, not 'no'.",
        ),
        ("simulate", 'instrument = ""', "experiment.instrument: must not be empty."),
        ("fit", "regions = []", "analysis.regions: list should have at least 1 item"),
        ("fit", 'regions = ["full", "full"]', "analysis.regions: has 'full' twice."),
        ("fit", 'stokes = ["Q", "Q"]', "analysis.stokes: has 'Q' twice."),
        ("fit", 'methods = ["grid", "grid"]', "analysis.methods: has 'grid' twice."),
        ("fit", "methods = []", "analysis.methods: list should have at least 1 item"),
        ("fit", 'latitude = "20"', "analysis.latitude: input should be a valid number, not '20'."),
        ("fit", "mask = 1", "analysis.mask: input should be a valid table, not 1."),
        ("fit", 'mask = { file = "" }', "analysis.mask.file: "),
        (
            "fit",
            "[grid]\npoints = 200.0",
            "grid.points: input should be a valid integer, not 200.0",
        ),
        ("fit", "[cmb]\ninclude = 1", "cmb.include: input should be a valid boolean, not 1."),
        (
            "fit",
            '[free."dust.beta_dust"]\nstart = "1.5"',
            "free.dust.beta_dust.start: input should be a valid number, not '1.5'.",
        ),
        (
            "fit",
            '[free."dust.beta_dust"]\nstart = 1.5\nuniform = [1, true]',
            "free.dust.beta_dust.uniform.1: input should be a valid number, not True.",
        ),
        (
            "fit",
            '[free."dust.beta_dust"]\nstart = 1.5\nuniform = [1, 2, 3]',
            "free.dust.beta_dust.uniform: tuple should have at most 2 items",
        ),
        (
            "fit",
            '[fixed]\n"dust.beta_dust" = "1.5"',
            "fixed.dust.beta_dust: input should be a valid number, not '1.5'.",
        ),
        (
            "separate",
            "nsims = true",
            "separation.nsims: input should be a valid integer, not True.",
        ),
        ("separate", "nsteps = 200.0", "separation.nsteps: input should be a valid integer"),
        ("separate", "[tensors]\npurify = 0", "tensors.purify: input should be a valid boolean"),
        ("forecast", 'spectra = ["BB", "BB"]', "fisher.spectra: has 'BB' twice."),
        ("forecast", "spectra = []", "fisher.spectra: list should have at least 1 item"),
        ("forecast", 'free = ["r", "r"]', "fisher.free: has 'r' twice."),
        ("forecast", "lmax = 300.0", "fisher.lmax: input should be a valid integer, not 300.0."),
        ("forecast", "r = false", "fisher.r: input should be a valid number, not False."),
        ("forecast", "[spectra]\nr = [0.1, 0.1]", "spectra.r: has 0.1 twice."),
        (
            "forecast",
            "[spectra]\nfit = [20, true]",
            "spectra.fit.1: input should be a valid integer",
        ),
        (
            "paper",
            "[paper]\ncenter = [180, true]",
            "paper.center.1: input should be a valid number",
        ),
        ("paper", '[paper]\nfwhm = "5"', "paper.fwhm: input should be a valid number, not '5'."),
        ("paper", "[paper]\nmask = 'm.fits'", "paper.mask: input should be a valid table, not"),
    ],
)
def test_lists_and_switches(tmp_path, command, main, words):
    refused(tmp_path, command, words, main=main)


@pytest.mark.parametrize("command", FORMATS)
@pytest.mark.parametrize("name", ["", " ", "a b", "a/b", "..", ".a", "-a", "\u03b2", "a:b", "a$b$"])
def test_names_that_files_or_columns_cannot_bear(tmp_path, command, name):
    letters = "a name consists of letters, digits and _ + -"
    refused(tmp_path, command, f"bands.0.name: {letters} ., and", band=name)
    refused(tmp_path, command, f"{FORMATS[command][2]}.{name}: {letters}, and", component=name)


@pytest.mark.parametrize("command", FORMATS)
def test_names_that_are_long_dotted_or_taken(tmp_path, command):
    table = FORMATS[command][2]
    long = "a" * 80
    refused(tmp_path, command, "bands.0.name: a name has at most 40 characters, not 80", band=long)
    refused(tmp_path, command, f"{table}.{long}: a name has at most 40", component=long)
    refused(tmp_path, command, f"{table}.a.b: a name consists of", component="a.b")
    taken = ["noise", "Total", "residual", "r", "A_lens", "calibration", "offset", "center"]
    for name in (*taken, *([] if command == "separate" else ["cmb", "CMB"])):
        words = f"{table}.{name}: the name {name!r} has a meaning of its own in results"
        refused(tmp_path, command, words, component=name)


def test_names_that_are_alike(tmp_path):
    second = MAP.replace("{band}", "{}")
    for name, words in [("30a", "must differ, but"), ("30A", "must differ by more than capitals")]:
        refused(
            tmp_path, "fit", f"names of the bands {words}", main=second.format(name), band="30a"
        )
    second = '[templates.Dust]\nfile = "b.fits"\nlaw = "dust"\nnu_ref = 353'
    refused(tmp_path, "fit", "names of the templates must differ by more than", main=second)


def test_the_name_of_the_cmb_is_that_of_the_cmb(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text(
        '[components]\ncmb.law = "dust"\nother.law = "cmb"\n[free."cmb.beta_dust"]\nstart = 1.5\n'
        "[embedded]\n"
    )
    with pytest.raises(SettingsError, match=r"components.cmb: must have the law 'cmb'; choose"):
        load(path, SeparateSettings)
