"""A local server of one file, which misbehaves in the way that the address names."""

import contextlib
import hashlib
import http.server
import io
import socket
import struct
import subprocess
import sys
import threading
import time

import numpy as np
from astropy.io import fits as pyfits

from jaxsky.products import Product
from refusals import cases

NAME = "map.fits"
OLD, NEW = '"1"', '"2"'


def fits_bytes(nside=4, names=("Q_STOKES", "U_STOKES"), unit="K_CMB", scale=1.0):
    """A file in the structure of the archives'."""
    values = scale * np.arange(12.0 * nside**2, dtype=np.float32)
    columns = [pyfits.Column(name=n, format="E", array=values, unit=unit) for n in names]
    table = pyfits.BinTableHDU.from_columns(columns)
    table.header.update({"PIXTYPE": "HEALPIX", "NSIDE": nside, "ORDERING": "NESTED"})
    stream = io.BytesIO()
    pyfits.HDUList([pyfits.PrimaryHDU(), table]).writeto(stream)
    return stream.getvalue()


CONTENT = fits_bytes()
SHA = "sha256:" + hashlib.sha256(CONTENT).hexdigest()
#: Another version of the same length.
REISSUED = fits_bytes(scale=2.0)
#: What comes of a file that is cut.
CUT = 1000

#: Files by name, of which bodies of answers are parts.
BODIES = {
    "content": CONTENT,
    "reissued": REISSUED,
    "other": fits_bytes(8),
    "unit": fits_bytes(unit="mK_CMB"),
    "columns": fits_bytes(names=("I_STOKES",)),
}
#: Answers by kind: status, headers that replace those that would be right, and the body.
ANSWERS = cases("transfer/answers")
#: Answers to a request for a rest, of files whose first answer is cut.
RESTS = {
    "cut": lambda first: (206, {}, CONTENT[first:]),
    "dated": lambda first: (206, {"ETag": None}, CONTENT[first:]),
    "capped": lambda first: (206, {}, CONTENT[first : first + CUT]),
    "untagged": lambda first: (206, {"ETag": None}, REISSUED[first:]),
    "whole": lambda first: (200, {}, CONTENT),
    "offset": lambda first: (206, {"Content-Range": _range(0)}, CONTENT[: len(CONTENT) - first]),
    "total": lambda first: (206, {"Content-Range": f"bytes {first}-9/10"}, CONTENT[first:]),
    "no range": lambda first: (206, {"Content-Range": None}, CONTENT[first:]),
    "new": lambda first: (206, {"ETag": NEW}, REISSUED[first:]),
    "new, whole": lambda first: (200, {"ETag": NEW}, REISSUED),
    "beyond": lambda first: (416, {"Content-Range": f"bytes */{first}"}, b""),
    "gone": lambda first: (404, {}, b""),
    "no versions": lambda first: (206, {}, CONTENT[first:]),
}


def body(given):
    """Text as it is, or a part of a file, and what is added to it."""
    if isinstance(given, str):
        return given.encode()
    return BODIES[given["of"]][: given.get("last")] + given.get("add", "").encode()


def _range(first):
    return f"bytes {first}-{len(CONTENT) - 1}/{len(CONTENT)}"


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves a file in the way that the first folder of the path names."""

    log: list[tuple[str, str | None]] = []  # noqa: RUF012
    #: Content of files that "slow" serves.
    files: dict[str, bytes] = {}  # noqa: RUF012

    def do_GET(self):
        kind, name = self.path.strip("/").replace("%20", " ").rsplit("/", 1)
        asked = self.headers.get("Range")
        Handler.log.append((kind, asked))
        first = int(asked[6:-1]) if asked else 0
        if kind in RESTS and first:
            self.answer(*RESTS[kind](first), first=first)
        elif kind in RESTS:
            # The second version is there from the second request on.
            again = kind.startswith("new") and (kind, None) in Handler.log[:-1]
            version = {"dated": None, "no versions": None}.get(kind, OLD)
            headers = {"Content-Length": str(len(CONTENT)), "ETag": NEW if again else version}
            if kind == "no versions":
                headers["Last-Modified"] = None
            seen = sum(k == kind for k, _ in Handler.log)
            cut = CONTENT[:CUT] if seen == 1 else REISSUED if again else CONTENT
            self.answer(200, headers, cut)
        elif kind in ANSWERS:
            status, headers, given = ANSWERS[kind]
            self.answer(status, headers, body(given))
        else:
            getattr(self, kind)(Handler.files.get(name, CONTENT), first)

    def head(self, status, length, first, of, headers):
        """The status of an answer, and headers that are right or replace these."""
        self.send_response(status)
        right = {"ETag": OLD, "Content-Length": str(length)}
        if status == 206:
            right["Content-Range"] = f"bytes {first}-{first + length - 1}/{of}"
        for key, value in (right | headers).items():
            if value is not None:
                self.send_header(key, value)
        self.end_headers()

    def answer(self, status, headers, body, first=0):
        dated = {"Last-Modified": "Sat, 28 Nov 2026 00:00:00 GMT"}
        self.head(status, len(body), first, len(CONTENT), dated | headers)
        with contextlib.suppress(OSError):
            self.wfile.write(body)

    def begin(self, content, first, **headers):
        """The headers of a file, of which the caller sends the body."""
        rest = len(content) - first
        self.head(206 if first else 200, rest, first, len(content), headers)

    def piece(self, content, seconds):
        """A part of a file, and a pause."""
        self.wfile.write(content)
        self.wfile.flush()
        time.sleep(seconds)

    def good(self, content, first):
        self.begin(content, first)
        self.wfile.write(content[first:])

    def steady(self, content, first):
        self.begin(content, first)
        time.sleep(0.5)
        self.wfile.write(content[first:])

    def stalled(self, content, first):
        self.begin(content, first)
        self.piece(content[first : first + 100], 1.5)

    def trickle(self, content, first, step=1000):
        self.begin(content, first)
        for at in range(first, len(content), step):
            self.piece(content[at : at + step], 0.01)

    def slow(self, content, first):
        """About a second for a file."""
        with contextlib.suppress(OSError):
            self.trickle(content, first, max(1, len(content) // 100))

    def chunked(self, content, first, end=b"0\r\n\r\n"):
        self.begin(content, 0, **{"Transfer-Encoding": "chunked", "Content-Length": "7"})
        for at in range(0, len(content), 5000):
            chunk = content[at : at + 5000]
            self.wfile.write(b"%x\r\n%s\r\n" % (len(chunk), chunk))
        self.wfile.write(end)

    def chunked_cut(self, content, first):
        self.chunked(content[:CUT], first, end=b"")

    def reset(self, content, first):
        """The connection is reset amid the file."""
        self.begin(content, first)
        self.piece(content[first : first + CUT], 0.1)
        self.hang_up()

    def hang_up(self, *_):
        """The connection is reset before an answer."""
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.close()
        self.wfile = io.BytesIO()

    def gibberish(self, content, first):
        self.wfile.write(b"good morning\r\n\r\n")

    def log_message(self, *arguments):
        pass


def product(*addresses, **changes):
    """The file as the catalogue would have it."""
    common = {"nside": 4, "unit": "K_CMB", "columns": ("Q_STOKES",)}
    return Product(NAME, "test", "A test", "a map", addresses, **(common | changes))


@contextlib.contextmanager
def serving():
    """The server; its address."""
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        server.handle_error = lambda *_: None  # connections that the tests break
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def fetch_command(address, folder, name):
    """`jaxsky data fetch` as a process."""
    code = "from fits.app import main; main()"
    arguments = ["data", "fetch", name, "--mirror", f"{address}/slow", "--dir", str(folder)]
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments], stderr=subprocess.PIPE, text=True
    )


def kill_fetches(address, folder, kills, seed=0):
    """Fetch a product again and again, kill it at random moments, and compare what is there.

    Returns the bytes with which transfers began: more than zero where one was resumed. A file
    that was complete before is removed.
    """
    # It has no hash in the catalogue, so that any FITS file may be it.
    name, rng = "LFI_RIMO_R2.50.fits", np.random.default_rng(seed)
    content = fits_bytes(64)
    Handler.files[name] = content
    path, killed = folder / name, 0
    Handler.log.clear()
    while killed < kills:
        begun = len(Handler.log)
        process = fetch_command(address, folder, name)
        if rng.random() < 0.8:
            while len(Handler.log) == begun and process.poll() is None:
                time.sleep(0.01)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(rng.uniform(0, 1.3))
        killed += process.poll() is None
        process.kill()
        said = process.communicate()[1]
        assert process.returncode in (0, -9), said
        assert process.returncode or path.exists()
        if path.exists():
            assert path.read_bytes() == content
            path.unlink()
    process = fetch_command(address, folder, name)
    said = process.communicate()[1]
    assert process.returncode == 0, said
    assert path.read_bytes() == content
    left = {p.name for p in folder.iterdir()}
    assert left <= {name, "checksums.json", ".checksums.json.lock", ".checksums.json.new"}
    return [int(asked[6:-1]) if asked else 0 for _, asked in Handler.log]
