"""Official data products: the catalogue, downloads from a server of our own, and checks."""

import hashlib
import http.server
import io
import multiprocessing
import sys
import threading
import time

import numpy as np
import pytest
from astropy.io import fits as pyfits

from jaxsky import cli
from jaxsky.archive import DownloadError, Product, catalogue, download, fetch, find, verify
from jaxsky.io import InputError
from jaxsky.units import parse_unit

NAME = "map.fits"


def fits_bytes(nside=4, names=("Q_STOKES", "U_STOKES"), unit="K_CMB"):
    """A file in the structure of the archives'."""
    values = np.arange(12.0 * nside**2, dtype=np.float32)
    columns = [pyfits.Column(name=n, format="E", array=values, unit=unit) for n in names]
    table = pyfits.BinTableHDU.from_columns(columns)
    table.header.update({"PIXTYPE": "HEALPIX", "NSIDE": nside, "ORDERING": "NESTED"})
    stream = io.BytesIO()
    pyfits.HDUList([pyfits.PrimaryHDU(), table]).writeto(stream)
    return stream.getvalue()


CONTENT = fits_bytes()
SHA = "sha256:" + hashlib.sha256(CONTENT).hexdigest()


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves CONTENT in the way that the first folder of the path names."""

    log: list[tuple[str, str | None]] = []  # noqa: RUF012

    def do_GET(self):
        kind = self.path.split("/")[1]
        asked = self.headers.get("Range")
        Handler.log.append((kind, asked))
        body = {"page": b"<html>down</html>", "other": fits_bytes(8)}.get(kind, CONTENT)
        first = int(asked[6:-1]) if asked and kind != "whole" else 0
        if kind == "missing":
            self.send_error(404)
            return
        if first >= len(body):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(body)}")
            self.end_headers()
            return
        self.send_response(206 if first else 200)
        self.send_header("Content-Length", str(len(body) - first))
        self.end_headers()
        body = body[first:]
        if kind == "cut" and not first:
            body = body[:1000]
        if kind == "slow":
            self.wfile.write(body[:100])
            self.wfile.flush()
            time.sleep(1.5)
            body = body[100:]
        if kind == "steady":
            time.sleep(0.5)
        self.wfile.write(body)

    def log_message(self, *arguments):
        pass


@pytest.fixture(scope="module")
def server():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


@pytest.fixture(autouse=True)
def log():
    Handler.log.clear()
    return Handler.log


def product(*addresses, **changes):
    common = {"nside": 4, "unit": "K_CMB", "columns": ("Q_STOKES",)}
    return Product(NAME, "test", "A test", "a map", addresses, **(common | changes))


def test_the_catalogue_is_complete():
    products = catalogue()
    assert len(products) > 40
    for name, found in products.items():
        assert found.name == name
        assert found.addresses
        assert all(a.startswith("https://") and a.endswith(name) for a in found.addresses)
        assert found.hash is None or found.hash.split(":")[0] in ("sha256", "md5")
        if found.unit is not None:
            parse_unit(found.unit)
        assert found.nside in (None, 256, 512, 1024, 2048)
        # The nside is part of the names of Planck's maps.
        parts = name.split("_")
        if "Map" in name and found.nside:
            assert str(found.nside).zfill(4) in parts
    for wanted in ("wmap9", "planck2015-lfi", "commander2015", "haslam"):
        assert find([wanted])


def test_products_are_found_by_group_name_and_part():
    assert len(find(["wmap9"])) == 5
    assert [p.what for p in find(["wmap_band_iqumap_r9_9yr_K_v5.fits"])] == ["K, 23 GHz"]
    assert {p.name[:7] for p in find(["rimo"])} == {"LFI_RIM", "HFI_RIM"}
    assert len(find(["wmap9", "wmap_band_iqumap_r9_9yr_K_v5.fits"])) == 5
    assert {p.group[:6] for p in find(["planck"])} == {"planck"}
    assert len(find(["planck"])) > 20
    assert find() == list(catalogue().values())
    with pytest.raises(ValueError, match=r"no product 'cobe'; give the name .* wmap9, wmap9-masks"):
        find(["cobe"])


@pytest.mark.parametrize("known", [None, SHA], ids=["without a hash", "with a hash"])
def test_a_file_is_fetched_once_and_checked(server, tmp_path, log, known):
    wanted = product(f"{server}/good/{NAME}", hash=known, size=len(CONTENT))
    seen = []
    path = fetch(wanted, tmp_path, report=lambda *numbers: seen.append(numbers))
    assert path.read_bytes() == CONTENT
    assert seen[0] == (0, len(CONTENT))
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert fetch(wanted, tmp_path) == path
    assert len(log) == 1
    assert verify(wanted, tmp_path) == "hash, columns, complete"
    assert not list(tmp_path.glob("*.part"))
    # Damage that leaves the length is noticed, whoever knew the hash.
    damaged = bytearray(CONTENT)
    damaged[-3000] ^= 1
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"map.fits: has the hash sha256:.* but should have"):
        verify(wanted, tmp_path)


def test_a_cut_transfer_is_gone_on_with(server, tmp_path, log):
    wanted = product(f"{server}/cut/{NAME}", hash=SHA)
    with pytest.raises(DownloadError, match="ended early, after 1000 bytes; fetch it again"):
        fetch(wanted, tmp_path)
    assert not (tmp_path / NAME).exists()
    assert fetch(wanted, tmp_path).read_bytes() == CONTENT
    assert log == [("cut", None), ("cut", "bytes=1000-")]


def test_what_is_there_is_not_trusted(server, tmp_path, log):
    part = tmp_path / f"{NAME}.part"
    # A server that knows no ranges sends all of it.
    part.write_bytes(CONTENT[:500])
    assert fetch(product(f"{server}/whole/{NAME}"), tmp_path).read_bytes() == CONTENT
    (tmp_path / NAME).unlink()
    # Complete, but not moved to its place.
    part.write_bytes(CONTENT)
    assert fetch(product(f"{server}/good/{NAME}"), tmp_path).read_bytes() == CONTENT
    (tmp_path / NAME).unlink()
    # More than there is: it is something else.
    part.write_bytes(2 * CONTENT)
    with pytest.raises(DownloadError, match="ended early, after 0 bytes"):
        fetch(product(f"{server}/good/{NAME}"), tmp_path)
    # The beginning of another file: the hash tells, and the next time it is fetched whole.
    part.write_bytes(b"SIMPLE" + 500 * b"x")
    wanted = product(f"{server}/good/{NAME}", hash=SHA)
    with pytest.raises(DownloadError, match="what came has sha256:"):
        fetch(wanted, tmp_path)
    assert fetch(wanted, tmp_path).read_bytes() == CONTENT


def test_wrong_files_are_refused(server, tmp_path):
    for kind, changes, words in (
        ("page", {}, "map.fits: what came is no FITS file, it begins with '<html>down</html>'"),
        ("other", {"hash": SHA}, f"but should have {SHA}; if the archive has issued"),
        ("other", {"size": len(CONTENT)}, f"bytes, but should have {len(CONTENT)} bytes"),
    ):
        with pytest.raises(DownloadError) as caught:
            fetch(product(f"{server}/{kind}/{NAME}", **changes), tmp_path)
        assert words in str(caught.value)
        assert not list(tmp_path.glob("map*"))
    # One that was issued anew can be taken; what it is, is still checked.
    wanted = product(f"{server}/other/{NAME}", hash=SHA, size=len(CONTENT))
    assert fetch(wanted, tmp_path, accept=True).exists()
    assert verify(wanted._replace(nside=8), tmp_path) == "hash, columns, complete"
    with pytest.raises(InputError, match="nside is 8, but 4 is expected"):
        verify(wanted, tmp_path)


def test_addresses_in_turn_and_mirrors(server, tmp_path, log):
    wanted = product(f"{server}/missing/{NAME}", f"{server}/good/{NAME}")
    fetch(wanted, tmp_path)
    assert [kind for kind, _ in log] == ["missing", "good"]
    log.clear()
    fetch(product("http://127.0.0.1:9/x"), tmp_path / "new", mirror=f"{server}/good/")
    assert [kind for kind, _ in log] == ["good"]


def test_without_a_network(server, tmp_path, monkeypatch):
    wanted = product(f"http://127.0.0.1:9/{NAME}", f"{server}/missing/{NAME}")
    with pytest.raises(DownloadError) as caught:
        fetch(wanted, tmp_path)
    said = str(caught.value)
    assert (
        f"http://127.0.0.1:9/{NAME} cannot be reached; {server}/missing/{NAME} answers 404" in said
    )
    assert f"put the file into {tmp_path} by hand, or name a --mirror." in said
    monkeypatch.setattr(download, "TIMEOUT", (0.5, 0.5))
    with pytest.raises(DownloadError, match="ended early, after 100 bytes"):
        fetch(product(f"{server}/slow/{NAME}"), tmp_path)


def _fetch(wanted, folder):
    fetch(wanted, folder)


def test_processes_do_not_fetch_twice(server, tmp_path, log):
    wanted = product(f"{server}/steady/{NAME}", hash=SHA)
    context = multiprocessing.get_context("spawn")
    others = [context.Process(target=_fetch, args=(wanted, tmp_path)) for _ in range(3)]
    for process in others:
        process.start()
    for process in others:
        process.join()
    assert [process.exitcode for process in others] == [0, 0, 0]
    assert len(log) == 1
    assert (tmp_path / NAME).read_bytes() == CONTENT


def test_what_verify_refuses(tmp_path):
    path = tmp_path / NAME
    wanted = product()
    with pytest.raises(InputError, match=r"is not there; fetch it with `jaxsky data fetch`"):
        verify(wanted, tmp_path)
    for content, changes, words in (
        (CONTENT[:-3000], {}, "map.fits: not a FITS file, or a truncated one"),
        (CONTENT, {"size": 7}, f"map.fits: has {len(CONTENT)} bytes, but should have 7."),
        (CONTENT, {"columns": ("II_COV",)}, "no column 'II_COV'; it has Q_STOKES, U_STOKES"),
        (CONTENT, {"unit": "uK_RJ"}, "column Q_STOKES is in K_CMB, but uK_RJ is expected"),
        (CONTENT, {"nside": 8}, "nside is 4, but 8 is expected"),
    ):
        path.write_bytes(content)
        with pytest.raises(InputError) as caught:
            verify(wanted._replace(**changes), tmp_path)
        assert words in str(caught.value)
    path.write_bytes(fits_bytes(unit="mK"))
    # Bare kelvins, as in older files, may be the ones that are expected.
    assert verify(wanted._replace(unit="mK_CMB"), tmp_path) == "columns, complete"


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["jaxsky", "data", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return ended.value.code


@pytest.fixture
def served(server, monkeypatch, tmp_path):
    """The server's file as the only product, and a folder for it."""
    wanted = product(f"{server}/good/{NAME}", hash=SHA)
    monkeypatch.setattr("jaxsky.archive.products.catalogue", lambda: {NAME: wanted})
    monkeypatch.setenv("JAXSKY_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_the_command(served, monkeypatch, capsys):
    assert command(monkeypatch, "list") == 0
    said = capsys.readouterr().out
    assert "map.fits" in said
    assert "yes" not in said
    assert command(monkeypatch, "verify", NAME) == 1
    assert "map.fits: is not there; fetch it with" in capsys.readouterr().err
    assert command(monkeypatch, "verify") == 0
    assert f"No product is in {served}." in capsys.readouterr().err
    assert command(monkeypatch, "fetch", "test") == 0
    assert f"In {served}: 1 files." in capsys.readouterr().err
    assert command(monkeypatch, "list", "map") == 0
    assert "yes" in capsys.readouterr().out
    assert command(monkeypatch, "verify") == 0
    assert "map.fits: hash, columns, complete" in capsys.readouterr().err
    (served / NAME).write_bytes(CONTENT[:-3000])
    assert command(monkeypatch, "verify") == 1
    assert "has the hash" in capsys.readouterr().err


def test_mistakes_of_the_command(served, server, monkeypatch, capsys, tmp_path):
    for arguments, words in (
        (("fetch", "cobe"), "There is no product 'cobe'"),
        (("fetch", NAME, "--mirror", f"{server}/missing"), "answers 404. Without a network"),
        (("fetch", NAME, "--mirror", f"{server}/cut"), "ended early, after 1000 bytes"),
    ):
        assert command(monkeypatch, *arguments) == 2
        said = capsys.readouterr().err
        assert words in said
        assert "Traceback" not in said
        assert not (served / NAME).exists()
    # The rest comes from wherever.
    assert command(monkeypatch, "fetch", NAME, "--dir", served) == 0
    assert (served / NAME).read_bytes() == CONTENT
