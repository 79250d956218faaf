"""Transfers from a server that misbehaves: the right file, or a sentence and nothing else."""

import errno
import json
import multiprocessing
import os
import shutil
import signal
import time
from pathlib import Path

import pytest
import requests

from jaxsky import archive
from jaxsky.archive import fetch
from jaxsky.io import InputError
from jaxsky.products import DownloadError, Product
from misbehaving import (
    CONTENT,
    CUT,
    NAME,
    OLD,
    REISSUED,
    SHA,
    Handler,
    body,
    fetch_command,
    product,
)
from refusals import cases, raises

pytestmark = pytest.mark.usefixtures("log")


def refused(wanted, folder, **options):
    """The sentence with which a file is refused; nothing may be left in its place."""
    with pytest.raises(DownloadError) as caught:
        fetch(wanted, folder, **options)
    assert not (folder / NAME).exists()
    return str(caught.value)


@pytest.mark.parametrize(
    "kind", ["good", "longer", "announced odd", "no length", "chunked", "trickle", "elsewhere"]
)
def test_right_files(server, tmp_path, kind):
    assert fetch(product(f"{server}/{kind}/{NAME}"), tmp_path).read_bytes() == CONTENT
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {NAME, "checksums.json", ".checksums.json.lock"}


@pytest.mark.parametrize(("kind", "words", "changes"), cases("transfer/wrong_answers"))
def test_wrong_answers(server, tmp_path, kind, words, changes):
    words = words.replace("SHA", SHA)
    changes |= {"hash": SHA} if "hash" in changes else {}
    said = refused(product(f"{server}/{kind}/{NAME}", **changes), tmp_path)
    assert words in said
    assert said.startswith(f"{NAME}: {server}/{kind}/{NAME} ".replace(" /", "/"))
    assert {path.name for path in tmp_path.iterdir()} <= {f".{NAME}.lock"}
    # The next address is tried, and its file taken.
    wanted = product(f"{server}/{kind}/{NAME}", f"{server}/good/{NAME}", **changes)
    if "size" not in changes:
        assert fetch(wanted, tmp_path).read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("kind", "size"),
    [("cut", CUT), ("reset", CUT), ("chunked_cut", CUT), ("stalled", 100), ("whole", CUT)],
)
def test_transfers_that_end_early(server, tmp_path, monkeypatch, kind, size):
    monkeypatch.setattr(archive, "TIMEOUT", (0.5, 0.5))
    said = refused(product(f"{server}/{kind}/{NAME}"), tmp_path)
    assert f"ended early, after {size} bytes; fetch it again to resume." in said
    assert (tmp_path / f"{NAME}.part").read_bytes() == CONTENT[:size]


@pytest.mark.parametrize(("kind", "asked"), cases("transfer/resumed"))
def test_files_are_resumed_only_with_the_same_version(server, tmp_path, log, kind, asked):
    wanted = product(f"{server}/{kind}/{NAME}")
    assert "ended early" in refused(wanted, tmp_path)
    for _ in range(2 if kind != "capped" else 20):
        try:
            path = fetch(wanted, tmp_path)
            break
        except DownloadError:
            continue
    assert path.read_bytes() == (REISSUED if kind.startswith("new") else CONTENT)
    ranges = [None if first is None else f"bytes={first}-" for first in asked]
    assert log == [(kind, r) for r in ranges]
    assert not list(tmp_path.glob("*.part*"))


def test_a_rest_that_is_gone_is_kept(server, tmp_path):
    wanted = product(f"{server}/gone/{NAME}")
    refused(wanted, tmp_path)
    assert "answers 404" in refused(wanted, tmp_path)
    assert (tmp_path / f"{NAME}.part").read_bytes() == CONTENT[:CUT]


def test_the_address_that_began_goes_on(server, tmp_path, log):
    refused(product(f"{server}/cut/{NAME}"), tmp_path)
    wanted = product(f"{server}/good/{NAME}", f"{server}/cut/{NAME}")
    assert fetch(wanted, tmp_path).read_bytes() == CONTENT
    assert log == [("cut", None), ("cut", f"bytes={CUT}-")]
    # Another address may have another file.
    (tmp_path / NAME).unlink()
    log.clear()
    refused(product(f"{server}/cut/{NAME}"), tmp_path)
    assert fetch(product(f"{server}/good/{NAME}"), tmp_path).read_bytes() == CONTENT
    assert log[-1] == ("good", None)


@pytest.mark.parametrize(("part", "state"), cases("transfer/partial_files"))
def test_partial_files_are_not_trusted(server, tmp_path, part, state):
    address = f"{server}/cut/{NAME}"
    Handler.log.append(("cut", None))  # only the first answer is cut
    (tmp_path / f"{NAME}.part").write_bytes(body(part))
    if isinstance(state, dict):
        state = json.dumps({"address": address, "version": OLD, "total": None} | state)
    if state is not None:
        (tmp_path / f"{NAME}.part.json").write_text(state)
    assert fetch(product(address, hash=SHA), tmp_path).read_bytes() == CONTENT
    assert not list(tmp_path.glob("*.part*"))


def test_https_is_not_left():
    answer = requests.Response()
    answer.status_code, answer.url = 302, "https://archive.org/maps/a.fits"
    for there, leaves in cases("transfer/redirections"):
        answer.headers["Location"] = there
        if leaves:
            with pytest.raises(archive.RefusedError, match=r"sends on to .*, which is not https"):
                archive._stay_safe(answer)
        else:
            archive._stay_safe(answer)
    answer.url, answer.headers["Location"] = "http://archive.org/a.fits", "http://b.org/a.fits"
    archive._stay_safe(answer)


@pytest.mark.parametrize("mirror", ["file:///data", "/data", "ftp://a.org", "archive.org", ""])
def test_mirrors_are_addresses(tmp_path, mirror):
    with pytest.raises(ValueError, match=r"--mirror must begin with https:// or http://, but is"):
        fetch(product(), tmp_path, mirror=mirror)
    assert not list(tmp_path.iterdir())


def test_mirrors_end_as_they_like(server, tmp_path, log):
    for number, slash in enumerate(("", "/", "//")):
        fetch(product(), tmp_path / str(number), mirror=f"{server}/good{slash}")
    assert [kind for kind, _ in log] == 3 * ["good"]


@pytest.mark.parametrize(("content", "words"), cases("transfer/what_is_there"))
def test_what_is_there_is_checked_and_left(server, tmp_path, log, content, words):
    path = tmp_path / NAME
    content = content if content is None else body(content)
    path.mkdir() if content is None else path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        fetch(product(f"{server}/good/{NAME}"), tmp_path)
    assert words in str(caught.value)
    assert str(caught.value).endswith("It is left as it is; move it away and fetch it again.")
    assert content is None or path.read_bytes() == content
    assert not log


def test_sizes_of_what_is_there(server, tmp_path):
    path, wanted = tmp_path / NAME, product(f"{server}/good/{NAME}", size=7)
    path.write_bytes(CONTENT)
    raises(InputError, r"map.fits: has \d+ bytes, but should have 7\.", fetch, wanted, tmp_path)
    path.unlink()
    # One that was accepted is not asked about again.
    assert fetch(wanted, tmp_path, accept=True) == fetch(wanted, tmp_path) == path


def test_accepted_files_still_have_the_structure(server, tmp_path):
    for kind in ("page", "other", "columns", "unit", "short table"):
        assert "sent another file" in refused(
            product(f"{server}/{kind}/{NAME}", hash=SHA), tmp_path, accept=True
        )
    wanted = product(f"{server}/reissued/{NAME}", hash=SHA, size=1)
    assert fetch(wanted, tmp_path, accept=True).read_bytes() == REISSUED


@pytest.mark.parametrize(("text", "words"), cases("transfer/texts"))
def test_text_is_the_table_that_it_should_be(server, tmp_path, text, words):
    name = "spectra.txt"
    Handler.files[name] = text.encode()
    wanted = Product(name, "test", "A test", "spectra", (f"{server}/good/{name}",), lmax=8)
    if words is None:
        assert fetch(wanted, tmp_path).read_text() == text
        return
    with pytest.raises(DownloadError) as caught:
        fetch(wanted, tmp_path)
    assert words in str(caught.value)
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize(
    "content", ["{", "[]", '{"map.fits": 1}', '{"map.fits": "sha1:00"}', "\x00", "", "folder"]
)
def test_damaged_records_of_hashes_are_said_and_kept(server, tmp_path, log, content):
    path = tmp_path / "checksums.json"
    path.mkdir() if content == "folder" else path.write_text(content)
    for there in (False, True):
        if there:
            (tmp_path / NAME).write_bytes(CONTENT)
        with pytest.raises(InputError, match=r"checksums.json: .*; move it away to go on without"):
            fetch(product(f"{server}/good/{NAME}"), tmp_path)
    assert content == "folder" or path.read_text() == content
    assert not log


def no_room(number):
    def fail(*_, **__):
        raise OSError(number, os.strerror(number))

    return fail


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.ENOSPC, "the disk is full; make room and fetch it again to resume."),
        (errno.EDQUOT, "the disk quota is used up; make room"),
        (errno.EROFS, r"cannot be written \(Read-only file system\); give another --dir."),
    ],
)
def test_disks_are_called_full(server, tmp_path, monkeypatch, number, words):
    wanted = product(f"{server}/good/{NAME}")
    for module, name in ((Path, "mkdir"), (os, "replace"), (Path, "write_text")):
        with monkeypatch.context() as patch:
            patch.setattr(module, name, no_room(number))
            raises(DownloadError, words, fetch, wanted, tmp_path)
        assert not (tmp_path / NAME).exists()
    assert fetch(wanted, tmp_path).read_bytes() == CONTENT


def test_a_disk_that_is_full_while_a_file_comes(server, tmp_path, monkeypatch):
    part = tmp_path / f"{NAME}.part"
    part.symlink_to("/dev/full")
    with monkeypatch.context() as patch:
        patch.setattr(archive, "discard", lambda part: None)
        with pytest.raises(DownloadError, match=f"{tmp_path}: the disk is full; make room"):
            fetch(product(f"{server}/good/{NAME}"), tmp_path)
    assert fetch(product(f"{server}/good/{NAME}"), tmp_path).read_bytes() == CONTENT


def test_files_for_which_there_is_no_room_do_not_begin(server, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)._replace(free=1000)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage)
    said = refused(product(f"{server}/good/{NAME}"), tmp_path)
    assert said.startswith(f"{tmp_path}: 1 kB are free, but {NAME} takes 9 kB more; make room")
    assert not list(tmp_path.glob("*.part*"))


def test_the_cache_is_a_folder(server, tmp_path):
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", tmp_path / "file" / "cache"):
        with pytest.raises(DownloadError, match=r"file.*: cannot be written \(.*\); give another"):
            fetch(product(f"{server}/good/{NAME}"), folder)


def _fetch(wanted, folder):
    fetch(wanted, folder)


@pytest.mark.slow
def test_processes_do_not_fetch_twice(server, tmp_path, log):
    wanted = product(f"{server}/steady/{NAME}", hash=SHA)
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_fetch, args=(wanted, tmp_path)) for _ in range(2)]
    for process in others:
        process.start()
    for process in others:
        process.join()
    assert [process.exitcode for process in others] == [0, 0]
    assert len(log) == 1
    assert (tmp_path / NAME).read_bytes() == CONTENT


def test_file_systems_without_locks(server, tmp_path, monkeypatch):
    monkeypatch.setattr("filelock.FileLock.acquire", no_room(errno.ENOSYS))
    assert fetch(product(f"{server}/good/{NAME}"), tmp_path).read_bytes() == CONTENT


def test_leftovers_of_a_process_that_ended_are_removed(server, tmp_path):
    (tmp_path / NAME).write_bytes(CONTENT)
    for name in (f"{NAME}.part", f"{NAME}.part.json", f".{NAME}.lock"):
        (tmp_path / name).touch()
    fetch(product(f"{server}/good/{NAME}"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [NAME]


@pytest.mark.slow
def test_stopped_downloads_say_how_to_resume(server, tmp_path, log):
    name = "LFI_RIMO_R2.50.fits"
    Handler.files[name] = 20 * CONTENT
    process = fetch_command(server, tmp_path, name)
    while not log:
        time.sleep(0.05)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    said = process.communicate(timeout=20)[1]
    assert process.returncode == 130
    assert "Stopped; fetch it again to resume." in said
    assert "Traceback" not in said
    assert (tmp_path / f"{name}.part").stat().st_size
