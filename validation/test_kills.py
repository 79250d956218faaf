"""Commands and downloads that are killed again and again; `JAXSKY_KILLS=40` for more than 5."""

import os

import pytest

from kills import COMMANDS, Killing
from misbehaving import kill_fetches, serving

WITH_WORKERS = [(name, ("--workers", "2")) for name in ("simulate", "compare")]


@pytest.mark.parametrize(("name", "options"), [*((n, ()) for n in COMMANDS), *WITH_WORKERS])
def test_killed_commands_end_as_if_they_had_not_been(name, options, tmp_path):
    kills = int(os.environ.get("JAXSKY_KILLS", "3" if options else "5"))
    killing = Killing(name, tmp_path, seed=kills, options=options)
    killing.run(kills, interrupts=2)
    assert killing.finished >= 1
    print(f"{name}: {killing.seconds:.1f} s undisturbed, {killing.finished} ends")


def test_downloads_survive_kills(tmp_path):
    with serving() as address:
        begun = kill_fetches(address, tmp_path, kills=12)
    assert sum(first > 0 for first in begun) >= 3, begun  # so many were resumed
