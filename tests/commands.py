"""The command line, run in the process of the tests."""

import re
import sys

from fits import app

#: A line about a step of a command's work, in a pipe.
STEP = re.compile(r"^ *\d+\.\d s  .*\n", re.MULTILINE)


def jaxsky(monkeypatch, *arguments) -> int:
    """Run a command; its exit code."""
    monkeypatch.setattr(sys, "argv", ["jaxsky", *map(str, arguments)])
    try:
        app.main()
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def said(capsys) -> str:
    """What a command has printed for people, without its steps, on one line."""
    return " ".join(STEP.sub("", capsys.readouterr().err).split())


def one_sentence(capsys) -> str:
    """What was printed: one sentence, no traceback."""
    printed = said(capsys)
    assert "Traceback" not in printed
    assert printed.startswith("jaxsky:"), printed
    return printed
