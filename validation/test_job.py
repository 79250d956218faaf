"""Commands that several processes of a job share find what one process does."""

import json
import signal
import time

import astropy.io.fits as pyfits
import numpy as np
import pytest

from benchmarks.launched import ended, launch
from settings_fuzz import written
from test_stacks import files

#: A busy machine has to end a command in this time [s].
PATIENCE = 300.0
#: What rounding changes: the way to a result, and when the steps of a chain are accepted.
LEFT_OUT = ("solver", "message", "steps", "mcmc")
#: Ten devices of two processes do not divide the pixels.
FLAGS = "--xla_force_host_platform_device_count=5"
COMMAND = "from jaxsky.io import stacks; stacks.LIMIT = {limit}; from fits.app import main; main()"
SEPARATE = {"nsims": 20, "width": 4, "apodization": 20.0, "sampler": "emcee", "nsteps": 100}
#: Settings of `separate`, and whether the noise differs between pixels and the maps lie on disk.
KINDS = {
    "regions": ({"region": "outside", "sampler": "none"}, True, True),
    "uniform": ({"region": "outside"}, False, True),
    "harmonic": ({"domain": "harmonic"}, False, False),
}


def experiment(folder, kind="regions"):
    """An experiment with maps in files, and whether they are large."""
    separate, uneven, large = KINDS[kind]
    bands = files(folder, uneven, whole=kind == "harmonic")
    free = {"dust.beta_dust": {"start": 1.6}, "synchrotron.beta_syn": {"start": 3.0}}
    if kind == "regions":
        free["dust.beta_dust"]["regions"] = {"nside": 1}
    settings = {
        "seed": 2,
        "sky": {"embedded": {"nside": 16}},
        "bands": bands,
        "common": {"nside": 16, "fwhm": 480.0},
        "free": free,
        "separate": SEPARATE | separate,
        "fit": {"nsteps": 100},
    }
    return written(folder / "experiment.toml", settings), large


def begun(number, folder, name, settings, out, *options, large=True, flags=""):
    """A command as so many processes."""
    code = COMMAND.format(limit=0 if large else 1 << 29)
    arguments = ["-c", code, name, str(settings), "--out", str(out), *options]
    return launch(number, folder, arguments, flags)


def said(folder, index=0):
    return (folder / f"{index}.log").read_text()


def numbers(value, name=""):
    """All numbers of a result by name, but for those of the way to it."""
    if isinstance(value, dict):
        kept = (pair for pair in value.items() if pair[0] not in LEFT_OUT)
        return {k: v for key, one in kept for k, v in numbers(one, f"{name}.{key}").items()}
    if isinstance(value, list):
        pairs = enumerate(value)
        return {k: v for i, one in pairs for k, v in numbers(one, f"{name}.{i}").items()}
    return {name: value}


def same(out, expected):
    """Results are the same but for rounding: 1e-6 of their size, and of the largest of a map."""
    found, wanted = (numbers(json.loads((o / "result.json").read_text())) for o in (out, expected))
    assert found.keys() == wanted.keys()
    for name, value in wanted.items():
        if isinstance(value, float):
            assert found[name] == pytest.approx(value, rel=1e-6, abs=1e-9), name
        else:
            assert found[name] == value, name
    names = {path.name for path in expected.iterdir()}
    assert {path.name for path in out.iterdir()} == names
    for path in expected.glob("*.fits"):
        theirs, own = (pyfits.getdata(folder / path.name) for folder in (expected, out))
        for name in theirs.names:
            size = 1e-6 * np.nanmax(np.abs(theirs[name]))
            np.testing.assert_allclose(own[name], theirs[name], 1e-5, size, err_msg=name)


@pytest.mark.parametrize(("kind", "number"), [("regions", 2), ("harmonic", 3)])
def test_separate_is_that_of_one_process(kind, number, tmp_path):
    settings, large = experiment(tmp_path, kind)
    for count in (1, number):
        out, options = tmp_path / f"out{count}", {"large": large, "flags": FLAGS * (count > 1)}
        run = begun(count, tmp_path, "separate", settings, out, **options)
        assert ended(run, PATIENCE) == [0] * count, said(tmp_path)
    same(tmp_path / f"out{number}", tmp_path / "out1")
    assert "jaxsky" not in said(tmp_path, 1)  # the first alone has something to say


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Folder for results of runs that nothing has stopped."""
    return tmp_path_factory.mktemp("undisturbed")


@pytest.mark.parametrize(("name", "killed"), [("separate", True), ("fit", True), ("fit", False)])
def test_a_job_that_was_stopped_goes_on_as_one_process_does(name, killed, tmp_path, undisturbed):
    settings, _ = experiment(tmp_path, "uniform")
    # Of a chain for Q and one for U; the first is not yet whole when the job is stopped.
    keys = ("separate.nsims=40", "fit.nsteps=4000", 'fit.regions=["full"]', 'fit.stokes=["Q", "U"]')
    out, options = tmp_path / "out", [word for key in keys for word in ("--set", key)]
    run = begun(2, tmp_path, name, settings, out, *options)
    until = time.monotonic() + PATIENCE
    while not any(out.glob("*.npz")):
        assert time.monotonic() < until, said(tmp_path)
        time.sleep(0.05)
    if killed:
        run[1].kill()
        assert all(ended(run, 30.0))
    else:  # Ctrl-C reaches all
        for process in run:
            process.send_signal(signal.SIGINT)
        assert ended(run, 30.0) == [130, 130]
        assert "Stopped; resume with --resume." in said(tmp_path)
    run = begun(3, tmp_path, name, settings, out, *options, "--resume")
    assert ended(run, PATIENCE) == [0, 0, 0], said(tmp_path)
    if not (whole := undisturbed / name).exists():
        assert ended(begun(1, tmp_path, name, settings, whole, *options), PATIENCE) == [0]
    same(out, whole)
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


def test_what_one_process_cannot_read_is_said_once(tmp_path):
    settings, _ = experiment(tmp_path)
    (tmp_path / "78.fits").unlink()  # the second band, which the second process reads
    out = tmp_path / "out"
    assert ended(begun(2, tmp_path, "separate", settings, out), PATIENCE) == [2, 2]
    assert "78.fits: no such file." in said(tmp_path)
    assert "jaxsky:" not in said(tmp_path, 1)
    assert not out.exists()
