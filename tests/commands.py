"""The command line, run in the process of the tests, and experiments for it."""

import re
import sys
from pathlib import Path

from fits import app

#: A line about a step of a command's work, in a pipe.
STEP = re.compile(r"^ *\d+\.\d s  .*\n", re.MULTILINE)


EXPERIMENTS = Path(__file__).with_name("experiments")


def experiment(name: str, *changes: tuple[str, str]) -> str:
    """The text of an experiment; each change is a text that is in it, and what replaces it once."""
    text = (EXPERIMENTS / f"{name}.toml").read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    return text


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
