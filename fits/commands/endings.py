"""How a command ends: an error as one sentence, and Ctrl-C within seconds, whatever it is doing.

Tracebacks, which are for those who look for the cause, are in a file.
"""

import _thread
import atexit
import dis
import os
import signal
import socket
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import jaxsky
from fits.commands.console import console

#: Where the traceback of an error is written, in the folder of the results.
ERROR_LOG = "error.log"
#: Longest message of a library that is repeated.
LONGEST = 500
#: Ctrl-C is repeated after this time [s], in case a callback has swallowed it; and after so many
#: repetitions the process ends where it is.
PATIENCE, REPETITIONS = 1.0, 3
#: Time for a thread to take notice [s].
MOMENT = 0.1


def _raised_in(error: BaseException) -> tuple[str, bool]:
    """Package in which an error came up, and whether its code has raised it, or what it called."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return "", False
    package = str(trace.tb_frame.f_globals.get("__name__", "")).partition(".")[0]
    return package, trace.tb_frame.f_code.co_code[trace.tb_lasti] == dis.opmap["RAISE_VARARGS"]


def _sentence(error: BaseException) -> str | None:
    """What is wrong with which file, key or argument, if the error says that already."""
    from fits.results import FitError

    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}."
    package, raised = _raised_in(error)
    kinds = (ValueError, KeyError, OSError, FitError)
    if not (raised and package in ("jaxsky", "fits") and isinstance(error, kinds)):
        return None
    if isinstance(error, KeyError):  # of a dictionary, it is the key alone
        words = str(error.args[0] if error.args else "")
        return words if " " in words else None
    return str(error)


def _summary(error: BaseException) -> str:
    """What a library says, on one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    first = lines[0][:LONGEST].rstrip(".") if lines else ""
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in first:
        return f"There is not enough memory ({first or 'MemoryError'})."
    kind = f"{type(error).__name__} in {_raised_in(error)[0]}"
    return f"{kind}: {first}." if first else f"{kind}."


def keep_traceback(error: Exception, path: Path) -> None:
    """Write the traceback of an error to a file, unless its message says enough."""
    if _sentence(error) is None:
        text = f"jaxsky {jaxsky.__version__}\n{''.join(traceback.format_exception(error))}"
        with suppress(OSError):
            path.write_text(text, encoding="utf-8", errors="replace")
            error.add_note(str(path))


def print_error(error: Exception) -> None:
    """Print an error as one sentence, and where its traceback is if that may be of use."""
    if (message := _sentence(error)) is None:
        notes = getattr(error, "__notes__", [])
        log = next((note for note in notes if note.endswith(ERROR_LOG)), None)
        if log is None:
            log = tempfile.mkstemp(f"-{ERROR_LOG}", "jaxsky-")[1]
            keep_traceback(error, Path(log))
        message = f"{_summary(error)} Traceback: {log}"
    console.print("jaxsky: ", style="red", end="")
    console.print(message, soft_wrap=True)


class _Interrupts:
    """Whether Ctrl-C was pressed, whether the command has ended by it, and what is said then."""

    def __init__(self) -> None:
        self.pressed, self.seen, self.words = threading.Event(), threading.Event(), "Stopped."

    def watch(self, reader: socket.socket) -> None:
        """Wait for Ctrl-C; then see to it that the process ends."""
        while signal.SIGINT not in (received := reader.recv(64)):
            if not received:  # the command has ended
                return
        self.pressed.set()
        for _ in range(REPETITIONS):
            if not self.seen.wait(PATIENCE):
                _thread.interrupt_main()
        threading.Event().wait(PATIENCE)  # what remains is the end of the interpreter
        if not self.seen.is_set():
            self.say()
        console.show_cursor()
        os._exit(130)

    def say(self) -> None:
        """Say that the command was stopped, once."""
        if not self.seen.is_set():
            self.seen.set()
            console.print(self.words)


_current = _Interrupts()


def _unraisable(error: "sys.UnraisableHookArgs") -> None:
    """Keep the traceback of an interrupt to ourselves that was raised where none can be."""
    if error.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(error)


@contextmanager
def prompt() -> Iterator[None]:
    """Have the process end with exit code 130 within seconds after Ctrl-C.

    An interrupt is an exception in the main thread once that runs Python code, which it does not
    while it waits for a computation or compiles, and an exception in a callback (of the garbage
    collector, of JAX) is printed or becomes another one. So a thread hears of the signal, too.
    Everything on disk is complete at any moment; what is stopped in this way can be resumed.
    """
    global _current
    _current = interrupts = _Interrupts()
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    before, sys.unraisablehook = sys.unraisablehook, _unraisable
    descriptor = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=interrupts.watch, args=(reader,), daemon=True).start()
    try:
        with interruptible():
            yield
    finally:
        # At the end of the interpreter nothing is left to stop, and nobody to catch an exception.
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
        if not interrupts.pressed.is_set():
            signal.set_wakeup_fd(descriptor)
            sys.unraisablehook = before
            writer.close()


@contextmanager
def interruptible(resumed: str = "") -> Iterator[None]:
    """Have Ctrl-C end the command with exit code 130, and say how it is resumed."""
    words, _current.words = _current.words, f"Stopped{resumed}."
    try:
        yield
    except KeyboardInterrupt:
        pass
    except Exception:
        # It may be what a library made of the interrupt, of which the thread hears only now.
        if not _current.pressed.wait(MOMENT):
            raise
    else:
        _current.words = words
        return
    _current.say()
    sys.exit(130)
