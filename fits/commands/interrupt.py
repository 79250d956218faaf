"""Ctrl-C ends a command within seconds, whatever it is doing."""

import _thread
import atexit
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from fits.commands.console import console

#: Ctrl-C is repeated after this time [s], in case a callback has swallowed it; and after so many
#: repetitions the process ends where it is.
PATIENCE, REPETITIONS = 1.0, 3
#: Time for a thread to take notice [s].
MOMENT = 0.1


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
