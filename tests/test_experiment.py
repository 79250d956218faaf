"""Simulations from settings: realisations as files, what each key does, and refusals."""

import itertools
import json
import re
import shutil
from types import SimpleNamespace

import healpy
import jax.numpy as jnp
import numpy as np
import pytest
from astropy.io import fits as pyfits

import systems
from commands import experiment as experiment_text
from commands import jaxsky
from fits.commands.run import DEFAULTS
from jaxsky import experiment, inputs, montecarlo
from jaxsky.experiment import simulation_inputs
from jaxsky.galaxy import GalaxyModel
from jaxsky.harmonics import alm_ell, expand, gaussian_beam, synthesis
from jaxsky.io import read_maps, write_maps
from jaxsky.io.files import occupied
from jaxsky.noise import realisation_key
from jaxsky.settings import load
from jaxsky.simulation import simulate
from refusals import cases

TEMPLATE = DEFAULTS / "experiment.toml"
NSIDE = 8
NPIX = 12 * NSIDE**2
COVARIANCE = ["QQ_COV", "QU_COV", "UU_COV"]
SMALL = "\n[sky.dust.small_scales]\nEE = [4, 10]\nBB = [3, 8]\nmodulation_fwhm = 1500.0\n"
#: Changes with a name: small scales of dust, of both components, and templates with intensity.
NAMED = {
    "small": [("[cmb]", SMALL + "[cmb]")],
    "both": [("[cmb]", SMALL + SMALL.replace("dust", "synchrotron") + "[cmb]")],
    "iqu": [("nside = 8", 'nside = 8\nstokes = "IQU"')]
    + [(f'"{name}.fits"', f'"{name}_iqu.fits"') for name in ("dust", "synchrotron")],
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the settings name."""
    folder = tmp_path_factory.mktemp("sky")
    rng = np.random.default_rng(6)
    ell = alm_ell(2 * NSIDE)
    beam = np.asarray(expand(gaussian_beam(900.0, 2 * NSIDE)))
    mask = np.arange(NPIX) > 4

    def save(name, maps, names, unit="uK_RJ", **options):
        write_maps(folder / f"{name}.fits", maps, names=names, unit=unit, **options)

    for name in ("dust", "synchrotron"):
        alm = np.where(ell > 1, 100 * rng.normal(size=(3, ell.size)) / (1 + ell), 0) * beam
        maps = np.asarray(synthesis(jnp.asarray(alm), NSIDE))
        save(name, maps[1:], ["Q", "U"])
        save(f"{name}_iqu", maps, list("IQU"))
        save(f"{name}_cut", maps[1:], ["Q", "U"], mask=mask)
    save("beta", 1.5 + 0.1 * np.cos(healpy.pix2ang(NSIDE, np.arange(NPIX))[0]), "BETA_D", "")
    covariance = np.stack([1 + rng.random(NPIX), rng.random(NPIX) - 0.5, 1 + rng.random(NPIX)])
    save("covariance", covariance, COVARIANCE, "uK_RJ^2")
    save("hits", np.where(mask, 9.0, 0.0), "HITS", "")
    save("coarse", np.ones(NPIX // 4), "RMS")
    table = np.array([[multipole, 1e3, 20.0, 5.0, 50.0] for multipole in range(2, 40)])
    np.savetxt(folder / "cmb.dat", table)
    np.savetxt(folder / "short.dat", table[:8])
    window = np.asarray(gaussian_beam(800.0, 20))
    np.savetxt(folder / "beam.txt", np.column_stack([np.arange(21), window]))
    return folder


def write(folder, *changes, of="simulate", name="experiment"):
    """The settings with some text replaced, as a file."""
    named = [NAMED[change] if isinstance(change, str) else [change] for change in changes]
    path = folder / f"{name}.toml"
    path.write_text(experiment_text(of, *itertools.chain(*named)))
    return path


@pytest.fixture
def run(monkeypatch):
    """Makes a simulation; its exit code."""
    return lambda path, out, *options: jaxsky(monkeypatch, "simulate", path, "--out", out, *options)


@pytest.fixture
def refused(mistake):
    """Asks for a simulation that is refused; its one sentence."""
    return lambda path, out, *options: mistake("simulate", path, "--out", out, *options)


def content(out) -> dict[str, bytes]:
    return {str(p.relative_to(out)): p.read_bytes() for p in sorted(out.rglob("sim_*/*"))}


def columns(path) -> dict[str, np.ndarray]:
    names = pyfits.getdata(path, 1).names
    return dict(zip(names, read_maps(path, fields=names).maps, strict=True))


def simulated(path, number=0):
    """The maps of a realisation in the bands."""
    settings = load(path)
    setup, key = simulation_inputs(settings), realisation_key(settings.seed, number)
    cmb = None if setup.cmb is None else jnp.asarray(setup.cmb)
    return np.asarray(simulate(key, setup.sources, setup.observation, cmb))


COMPONENTS = ("sheet = false", "sheet = false\ncomponents = true")


# What is written.


def test_files_are_the_simulation(folder, tmp_path, capsys, run):
    path, out = write(folder), tmp_path / "out"
    assert run(path, out) == 0
    assert " 2 maps in " in " ".join(capsys.readouterr().err.split())
    assert sorted(content(out)) == ["sim_00000/143.fits", "sim_00000/30.fits"]
    observation = simulation_inputs(load(path)).observation
    for name, maps in zip(observation.names, simulated(path), strict=True):
        file = out / "sim_00000" / f"{name}.fits"
        found = read_maps(file)
        assert (found.names, found.unit, found.nside) == (("Q", "U"), "uK_RJ", NSIDE)
        assert found.mask.all()
        # Single precision.
        np.testing.assert_allclose(found.maps, maps, atol=1e-6 * np.abs(maps).max())
        again, header = healpy.read_map(file, field=None, h=True, dtype=np.float64)
        np.testing.assert_array_equal(again, found.maps)
        header = dict(header)
        wanted = cases("experiment/header") | {"BAND": name}
        assert {k: header[k] for k in wanted} == wanted
        assert header["CREATOR"].startswith("jaxsky ")
        band = observation.channels[name].band
        assert header["FREQ"] == pytest.approx(float(band.center))
        assert (header["FREQMIN"], header["FREQMAX"]) == (band.nu.min(), band.nu.max())
        assert header["RJ2CMB"] == pytest.approx(float(band.conversion("uK_RJ", "uK_CMB")))
        level = healpy.nside2resol(NSIDE, arcmin=True)
        if name == "30":
            level = 300.0 * float(band.conversion("uK_CMB", "uK_RJ"))
        assert header["NOISE"] == pytest.approx(level)
    log = json.loads((out / montecarlo.LOG).read_text())
    assert {"jaxsky", "jax", "healpy", "ducc0"} <= set(log["versions"])
    assert log["settings"]["seed"] == 3
    assert log["settings"]["bands"][0]["noise"]["level"] == 300.0


def test_units_and_components(folder, tmp_path, run):
    plain, thermodynamic = tmp_path / "RJ", tmp_path / "CMB"
    assert run(write(folder, COMPONENTS), plain) == 0
    change = (COMPONENTS[0], COMPONENTS[1] + '\nunit = "uK_CMB"')
    assert run(write(folder, change), thermodynamic) == 0
    parts = ("dust", "synchrotron", "cmb", "noise")
    for name in ("30", "143"):
        one, other = (p / "sim_00000" / f"{name}.fits" for p in (plain, thermodynamic))
        maps = columns(one)
        assert sorted(maps) == sorted([*"QU", *(f"{s}_{p}" for s in "QU" for p in parts)])
        assert list(maps)[:2] == ["Q", "U"]
        assert read_maps(other).unit == "uK_CMB"
        factor = pyfits.getheader(one, 1)["RJ2CMB"]
        for s in "QU":
            total = sum(maps[f"{s}_{p}"] for p in parts)
            np.testing.assert_allclose(maps[s], total, atol=1e-6 * np.abs(maps[s]).max())
        for column, values in columns(other).items():
            np.testing.assert_allclose(values, factor * maps[column], rtol=1e-6)


def test_one_thing_only(folder, tmp_path, run):
    path = write(folder, COMPONENTS)
    assert run(path, tmp_path / "all") == 0
    whole = columns(tmp_path / "all" / "sim_00000" / "143.fits")
    expected = {
        "noise": ["noise"],
        "cmb": ["cmb"],
        "foregrounds": ["dust", "synchrotron"],
        "signal": ["dust", "synchrotron", "cmb"],
    }
    for only, parts in expected.items():
        out = tmp_path / only
        assert run(path, out, "--only", only) == 0
        file = out / "sim_00000" / "143.fits"
        maps = columns(file)
        assert pyfits.getheader(file, 1)["CONTENT"] == ", ".join(parts)
        assert set(maps) == {"Q", "U", *(f"{s}_{p}" for s in "QU" for p in parts)}
        for s in "QU":
            total = sum(whole[f"{s}_{p}"] for p in parts)
            np.testing.assert_allclose(maps[s], total, atol=1e-5 * np.abs(total).max())


def test_only_needs_no_files_that_it_does_not_show(folder, tmp_path, run):
    path = write(folder, ("dust.fits", "absent.fits"), ("cmb.dat", "absent.dat"))
    assert run(path, tmp_path / "out", "--only", "noise") == 0
    header = pyfits.getheader(tmp_path / "out" / "sim_00000" / "30.fits", 1)
    assert str(header["COMMENT"]) == "No foregrounds."


def test_beams_and_noise_of_all_kinds(folder):
    path = write(
        folder,
        ("fwhm = 1200.0", "fwhm = 0"),
        *2 * [("fwhm = 900.0", "fwhm = 700.0")],
        ("level = 300.0", f'covariance = {{ file = "covariance.fits", fields = {COVARIANCE} }}'),
        ("sheet = false", "diagonal_noise = true"),
    )
    channels = simulation_inputs(load(path)).observation.channels
    columns = read_maps(folder / "covariance.fits", fields=COVARIANCE).maps
    np.testing.assert_allclose(channels["30"].noise[[0, 0, 1], [0, 1, 1]], columns)
    assert channels["30"].diagonal
    assert channels["143"].noise == pytest.approx(healpy.nside2resol(NSIDE, arcmin=True))
    assert channels["30"].target is None
    np.testing.assert_allclose(channels["143"].beam, gaussian_beam(800.0, 16), rtol=1e-6)
    assert channels["30"].beam == 800.0
    none = write(folder, ('noise = { rms = 1.0, unit = "uK_RJ" }', ""))
    assert simulation_inputs(load(none)).observation.channels["143"].noise is None


def test_multipoles_that_no_map_shows_are_left_out(folder):
    rough = write(
        folder,
        ("nside = 8", 'nside = 64\ninclude = ["noise"]'),
        ('beam = "beam.txt"', "fwhm = 500.0"),
        ('{ rms = 1.0, unit = "uK_RJ" }', "{ level = 1.0 }"),
    )
    lmax = simulation_inputs(load(rough)).observation.lmax
    window = np.asarray(gaussian_beam(1200.0, 2 * lmax))
    assert lmax < 128
    assert window[lmax - 1] > 1e-8 > window[lmax + 1]
    assert simulation_inputs(load(write(folder))).observation.lmax == 16


# Realisations.


@pytest.fixture(scope="module")
def three(folder, tmp_path_factory):
    """Three realisations with small scales, in one run."""
    path, out = write(folder, "small", name="three"), tmp_path_factory.mktemp("three") / "out"
    with pytest.MonkeyPatch.context() as patch:
        assert jaxsky(patch, "simulate", path, "--out", out, "--nsims", 3) == 0
    return path, content(out)


def test_a_realisation_does_not_depend_on_the_order(three, tmp_path, capsys, run):
    (path, expected), out = three, tmp_path / "out"
    assert len(expected) == 6
    assert len(set(expected.values())) == 6
    assert run(path, out, "--first", 2) == 0
    assert sorted(content(out)) == ["sim_00002/143.fits", "sim_00002/30.fits"]
    assert run(path, out, "--nsims", 2, "--resume") == 0
    assert content(out) == expected
    # One is lost, one is made again; the others are left alone.
    lost = out / "sim_00001" / "30.fits"
    times = {p: p.stat().st_mtime_ns for p in out.rglob("*.fits")}
    lost.unlink()
    capsys.readouterr()
    assert run(path, out, "--nsims", 3, "--resume") == 0
    assert " 1 maps in " in (said := " ".join(capsys.readouterr().err.split()))
    assert "5 maps were there already" in said
    assert content(out) == expected
    assert [p for p, t in times.items() if p.stat().st_mtime_ns != t] == [lost]


def test_a_monte_carlo_is_split_over_processes(three, tmp_path, run, refused):
    """In one folder, at once or one after the other; each makes its own part."""
    (path, expected), out = three, tmp_path / "out"
    other = "--first", 1, "--set", "seed=4"
    with occupied(out, range(1)):  # another process makes the first realisation
        for options in (["--nsims", 3], ["--overwrite", "--first", 1]):
            assert "is being written to by another command (process" in refused(path, out, *options)
        assert run(path, out, "--first", 2) == 0
        assert "holds a simulation of other settings" in refused(path, out, *other)
        assert run(path, out, "--first", 1) == 0
    assert "holds a simulation already" in refused(path, out, "--first", 2)
    assert run(path, out) == 0
    assert content(out) == expected
    assert not list(out.glob(".*"))


def test_processes_with_other_settings_do_not_meet(three, tmp_path, monkeypatch, refused):
    """Both began in an empty folder, and one left its log before the other had a map."""
    (path, _), out, observe = three, tmp_path / "out", montecarlo.observe_bands

    def meanwhile(*arguments, **options):
        monkeypatch.setattr(montecarlo, "observe_bands", observe)
        montecarlo._claim(out, load(path, ["seed=4"]), False)
        return observe(*arguments, **options)

    monkeypatch.setattr(montecarlo, "observe_bands", meanwhile)
    assert "holds a simulation of other settings" in refused(path, out)
    assert list(content(out)) == []


def test_a_removed_folder_or_log_stops_the_run(three, tmp_path, monkeypatch, refused):
    (path, _), out, write_file = three, tmp_path / "out", montecarlo.write_maps

    def remove(what):
        def removing(*arguments, **options):
            write_file(*arguments, **options)
            monkeypatch.setattr(montecarlo, "write_maps", write_file)
            shutil.rmtree(what) if what.is_dir() else what.unlink()

        monkeypatch.setattr(montecarlo, "write_maps", removing)

    remove(out)
    assert f"{out}: was removed while the command worked in it" in refused(path, out, "--nsims", 3)
    assert not out.exists()
    remove(out / montecarlo.LOG)
    words = "simulation.json: was removed while the simulation ran"
    assert words in refused(path, out, "--nsims", 3)


def test_a_stopped_run_goes_on(three, tmp_path, monkeypatch, capsys, run):
    (path, expected), out = three, tmp_path / "out"
    write_file, count = montecarlo.write_maps, iter(range(100))

    def stopped(*arguments, **options):
        if next(count) == 3:
            raise KeyboardInterrupt
        write_file(*arguments, **options)

    monkeypatch.setattr(montecarlo, "write_maps", stopped)
    assert run(path, out, "--nsims", 3) == 130
    assert "Stopped; resume with --resume." in capsys.readouterr().err
    assert len(content(out)) == 3
    assert not list(out.rglob(".partial*"))
    monkeypatch.setattr(montecarlo, "write_maps", write_file)
    assert run(path, out, "--nsims", 3, "--resume") == 0
    assert content(out) == expected


CORRELATED = (
    "[sky.synchrotron.small_scales]",
    '[sky.synchrotron.small_scales]\ncorrelated_with = "dust"',
)


@pytest.mark.parametrize("changes", [("iqu",), ("both", CORRELATED, COMPONENTS)])
def test_workers_write_the_same_files(changes, folder, tmp_path, two):
    """From templates that are prepared once, and with small scales that are always others."""
    settings, found = load(write(folder, *changes)), {}
    for out, executor in ((tmp_path / "own", None), (tmp_path / "out", two)):
        notes, begun = [], []
        how = {"note": notes.append, "begun": lambda b=begun: b.append(1), "executor": executor}
        files = montecarlo.run(settings, simulation_inputs(settings), out, range(2, 7), **how)
        assert list(files) == [True] * 10
        found[out.name] = content(out), set(notes), begun
    assert found["out"] == found["own"]
    assert (len(found["out"][0]), begun) == (10, [1])
    assert bool(notes) == ("both" in changes)
    (out / "sim_00003" / "30.fits").unlink()
    again = simulation_inputs(settings), out, range(2, 8), False
    assert sorted(montecarlo.run(settings, *again, executor=two)) == [False] * 9 + [True] * 3
    whole = content(out)
    assert {name: whole[name] for name in found["own"][0]} == found["own"][0]


def test_what_cannot_be_written_stops_the_run(three, tmp_path, monkeypatch, refused):
    """Bands are written while the next one is made; an error there is one, and leaves no file."""
    path, _ = three
    written, write_maps = [], montecarlo.write_maps

    def full(where, *arguments, **options):
        if len(written) == 3:
            raise OSError(28, "No space left on device", str(where))
        write_maps(where, *arguments, **options)
        written.append(where)

    monkeypatch.setattr(montecarlo, "write_maps", full)
    assert "No space left on device" in refused(path, tmp_path / "out", "--nsims", 3)
    assert sorted((tmp_path / "out").glob("sim_*/*.fits")) == sorted(written)


def test_small_scales_can_be_the_same_for_all(folder, tmp_path, run):
    found = {}
    for seed in ("", "small_scales_seed = 0", "small_scales_seed = 1"):
        change = (COMPONENTS[0], f"{COMPONENTS[1]}\n{seed}")
        path, out = write(folder, change, "small"), tmp_path / f"_{seed[-1:]}"
        assert run(path, out, "--nsims", 2) == 0
        found[seed[-1:]] = [columns(out / f"sim_0000{i}" / "30.fits") for i in (0, 1)]
    for name in ("Q_cmb", "Q_noise"):
        assert not np.array_equal(found["0"][0][name], found["0"][1][name])
        for one, other in zip(found[""], found["0"], strict=True):
            np.testing.assert_array_equal(one[name], other[name])
    for fixed in "01":
        np.testing.assert_array_equal(found[fixed][0]["Q_dust"], found[fixed][1]["Q_dust"])
    different = [found[""][0], found[""][1], found["0"][0], found["1"][0]]
    assert len({maps["Q_dust"].tobytes() for maps in different}) == 4
    assert len({maps["Q_synchrotron"].tobytes() for maps in different}) == 1


# Every key does something.


@pytest.fixture(scope="module")
def reference(folder):
    return simulated(write(folder, "both", name="reference"))


@pytest.mark.parametrize(
    "change", cases("experiment/keys"), ids=lambda change: change[1].strip().splitlines()[-1]
)
def test_a_key_changes_the_maps(folder, reference, change):
    path = write(folder, "both", change, name="changed")
    maps = simulated(path)
    assert maps.shape == reference.shape
    assert np.abs(maps / reference - 1).max() > 1e-3


def test_keys_of_instruments_and_of_the_embedded_sky(folder, monkeypatch):
    sky = systems.dust_and_synchrotron(12 * 4**2)
    galaxy = SimpleNamespace(sky=lambda stokes: sky, description="A model.")
    asked = []

    def recorded(*arguments):
        asked.append(arguments)
        return galaxy

    monkeypatch.setattr(inputs, "embedded_sky", recorded)
    monkeypatch.setattr(inputs, "default_galaxy", lambda nside: recorded(nside, 0, GalaxyModel()))
    monkeypatch.setattr(experiment, "camb_spectra", lambda lmax, r: np.zeros((4, lmax + 1)))

    def made(*changes):
        wide = ("fwhm = 1200.0", "fwhm = 1400.0")
        path = write(folder, wide, *changes, of="instrument", name="core")
        return simulation_inputs(load(path)).observation

    plain = made()
    assert plain.names == ("45", "105")
    assert plain.bands[0].nu.size == 51
    assert made(('"core"', '"core"\nsamples = 7')).bands[0].nu.size == 7
    assert made(("nside = 8", "nside = 8\nstokes = 'IQU'")).stokes == "IQU"
    assert len(made(('channels = ["45", "105"]', "")).names) == 15
    made(("{ nside = 8 }", "{ nside = 16, seed = 2, p0 = 0.1 }"))
    numbers = [(nside, seed, float(model.p0)) for nside, seed, model in asked]
    assert numbers == [(8, 0, 0.2)] * 4 + [(16, 2, 0.1)]


def test_keys_of_the_cmb_reach_camb(folder, monkeypatch):
    asked = []
    monkeypatch.setattr(
        experiment, "camb_spectra", lambda *a, **k: asked.append((a, k)) or np.zeros((4, 17))
    )
    spectra = 'file = "cmb.dat"\nfields = ["L", "TT", "EE", "BB", "TE"]\n'
    for line in ("", "r = 0.05\n", "cosmology = { H0 = 70.0 }\n"):
        simulation_inputs(load(write(folder, (spectra, line))))
    assert asked == [((16, 0.0), {}), ((16, 0.05), {}), ((16, 0.0), {"H0": 70.0})]


# Refusals.


@pytest.mark.parametrize(
    ("changes", "words"),
    cases("experiment/refusals"),
    ids=lambda value: value[:40] if isinstance(value, str) else "",
)
def test_refusals(folder, tmp_path, changes, words, refused):
    path, out = write(folder, *changes, name="mistake"), tmp_path / "a" / "out"
    assert words in refused(path, out)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(("change", "words"), cases("experiment/refusals_of_instruments"))
def test_refusals_of_instruments(folder, tmp_path, change, words, refused):
    path = write(folder, change, of="instrument", name="core")
    assert words in refused(path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_refusals_of_options(folder, tmp_path, capsys, run, refused):
    path, out = write(folder), tmp_path / "out"
    for options, words in cases("experiment/options"):
        assert words in refused(path, out, *options)
    for options in (("--nsims", "0"), ("--first", "-1")):
        assert run(path, out, *options) == 2
        assert "Traceback" not in capsys.readouterr().err
    words = "none.toml: cannot be read (No such file or directory)"
    assert words in refused(tmp_path / "none.toml", out)
    assert not out.exists()


def test_a_folder_with_results_is_left_alone(folder, tmp_path, run, refused):
    path, out = write(folder, name="mine"), tmp_path / "out"
    assert run(path, out) == 0
    before, log = content(out), out / montecarlo.LOG
    whole = log.read_bytes()

    def kept(words, path, *options):
        assert words in refused(path, out, *options)
        assert content(out) == before

    kept("holds a simulation already; go on with --resume, replace it", path)
    for options, key in ((("--set", "seed=4"), "seed"), (("--only", "noise"), "simulate.include")):
        words = f"holds a simulation of other settings ({key}); choose another --out"
        kept(words, path, "--resume", *options)
    # A mistake that only the small scales notice does not cost the old results.
    wrong = write(folder, "small", ("[4, 10]", "[4, 30]"), name="wrong")
    kept("from l = 4 to 30", wrong, "--overwrite")
    for damage in (b"{}", b"[1]", b"\xff\xfe", whole[:50]):
        log.write_bytes(damage)
        kept("simulation.json: is damaged; start again with --overwrite", path, "--resume")
    log.unlink()
    for options in ((), ("--resume",)):
        kept("holds maps of unknown settings", path, *options)
    log.write_bytes(whole)
    # Neither a title, where the files are nor a picture make it another simulation.
    moved = write(folder, ('title = "A small sky"', 'data_dir = "."'), name="moved")
    assert run(moved, out, "--resume") == 0
    assert content(out) == before
    pictured = load(write(folder, ("sheet = false", "sheet = true"), name="sheet"))
    montecarlo.check_folder(out, pictured, True, False, range(1))
    assert run(path, out, "--overwrite", "--set", "seed=4") == 0
    assert content(out).keys() == before.keys()
    assert all(content(out)[name] != before[name] for name in before)


# Examples, titles and pictures.


TABLES = re.split(r"^(?=(?:# )?\[)", TEMPLATE.read_text(), flags=re.MULTILINE)


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.partition("\n")[0][:30])
def test_what_is_commented_out_in_the_template_is_valid(tmp_path, table):
    """Each line by itself, with the first ones of all keys if the table is commented out."""
    path, plain = tmp_path / "mine.toml", load(TEMPLATE).model_dump(exclude={"data_dir"})
    title = "" if table == TABLES[0] else table.partition("\n")[0]
    found = re.findall(r'^(# )?(([\w."-]+) = .*)$', table, re.MULTILINE)
    own, changed = title.startswith("# "), set()
    used = {key: line for mark, line, key in reversed(found) if own or not mark}
    # No parameter is both free and fixed.
    others = [t for t in TABLES if t != table and (title, t[:6]) != ("[fixed]", "[free]")]
    for mark, line, key in found:
        if title == "[free]" and key == "regions":
            line, key = f'"dust.beta_dust".{line}', '"dust.beta_dust"'
        mine = "\n".join([title.removeprefix("# "), *(used | {key: line}).values(), ""])
        path.write_text("".join([*others, mine] if title else [mine, *others]))
        if mark and load(path).model_dump(exclude={"data_dir"}) != plain:
            changed.add(key.strip('"'))
    alternatives = cases("experiment/alternatives")
    assert own or changed == set(alternatives.get(title, "").split())


def test_the_default_is_valid():
    settings = load(DEFAULTS / "simulate.toml")
    assert settings.sky.embedded.nside == 256
    channels = {b.name: experiment.read_channel(settings, b, 256) for b in settings.bands}
    assert len(channels) == 15
    assert all(c.noise > 0 and c.target == 60.0 for c in channels.values())
    experiment._check_pixels(256, "30", 60.0)


def test_titles_of_all_kinds(folder, tmp_path, capsys, run):
    title = "Herv\u00edas-Caimap\u00f3 [red] \u00b5K " + 30 * "long "
    path, out = write(folder, ("A small sky", title)), tmp_path / "out"
    nothing_leaks = "--only", "noise", "--set", "bands.0.leakage=0.02"
    assert run(path, out, *nothing_leaks) == 0
    header = pyfits.getheader(out / "sim_00000" / "30.fits", 1)
    assert header["INSTRUME"].startswith("Herv?as-Caimap? [red] ?K long")
    assert run(path, tmp_path / "fg", "--only", "foregrounds") == 0
    assert "[red]" in capsys.readouterr().err


def test_intensity_and_the_sheet(folder, tmp_path, run):
    path, out = write(folder, ("sheet = false", "sheet = true"), "iqu"), tmp_path / "out"
    assert run(path, out, "--first", 7) == 0
    (picture,) = out.glob("*.png")
    assert picture.name == "sim_00007.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    expected = simulated(path, 7)
    found = read_maps(out / "sim_00007" / "30.fits", fields=["I", "Q", "U"])
    np.testing.assert_allclose(found.maps, expected[0], atol=1e-6 * np.abs(expected).max())
