"""Errors as one sentence; tracebacks, which are for those who look for the cause, in a file."""

import dis
import tempfile
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import jaxsky
from fits.commands.console import console

#: Where the traceback of an error is written, in the folder of the results.
LOG = "error.log"
#: Longest message of a library that is repeated.
LONGEST = 500


def _raised_in(error: BaseException) -> tuple[str, bool]:
    """Package in which an error came up, and whether its code has raised it, or what it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return "", False
    package = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
    return package, trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


def _is_sentence(error: BaseException) -> bool:
    """Whether an error says already what is wrong with which file, key or argument."""
    from fits.results import FitError

    if isinstance(error, OSError) and error.filename and error.strerror:
        return True
    if isinstance(error, KeyError) and " " not in str(error.args[0] if error.args else ""):
        return False
    kinds = (ValueError, KeyError, OSError, FitError)
    package, raised = _raised_in(error)
    return isinstance(error, kinds) and raised and package in ("jaxsky", "fits")


def _sentence(error: BaseException) -> str:
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}."
    return str(error.args[0]) if isinstance(error, KeyError) else str(error)


def _summary(error: BaseException) -> str:
    """What a library says, on one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first = lines[0][:LONGEST].rstrip(".") if lines else ""
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in first:
        return f"There is not enough memory ({first or 'MemoryError'})."
    kind = f"{type(error).__name__} in {_raised_in(error)[0]}"
    return f"{kind}: {first}." if first else f"{kind}."


def _write(error: BaseException, path: Path) -> None:
    text = "".join(traceback.format_exception(error))
    path.write_text(f"jaxsky {jaxsky.__version__}\n{text}", encoding="utf-8", errors="replace")


@contextmanager
def logged(out: Path) -> Iterator[None]:
    """Keep the traceback of an error in a folder, unless its message says enough."""
    (out / LOG).unlink(missing_ok=True)
    try:
        yield
    except Exception as error:
        if not _is_sentence(error):
            with suppress(OSError):
                _write(error, out / LOG)
                error.add_note(str(out / LOG))
        raise


def print_error(error: Exception) -> None:
    """Print an error as one sentence, and where its traceback is if that may be of use."""
    if _is_sentence(error):
        message = _sentence(error)
    else:
        notes = getattr(error, "__notes__", [])
        log = next((note for note in notes if note.endswith(LOG)), None)
        if log is None:
            log = tempfile.mkstemp(f"-{LOG}", "jaxsky-")[1]
            _write(error, Path(log))
        message = f"{_summary(error)} Traceback: {log}"
    console.print("jaxsky: ", style="red", end="")
    console.print(message, soft_wrap=True)
