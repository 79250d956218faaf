"""Commands and downloads that are killed again and again; `JAXSKY_KILLS=40` for more than 12."""

import os

import pytest

from kills import COMMANDS, Killing
from misbehaving import kill_fetches, serving


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_commands_end_as_if_they_had_not_been(name, tmp_path):
    kills = int(os.environ.get("JAXSKY_KILLS", "12"))
    killing = Killing(name, tmp_path, seed=kills)
    killing.run(kills, interrupts=2)
    assert killing.finished >= 1
    print(f"{name}: {killing.seconds:.1f} s undisturbed, {killing.finished} ends")


def test_downloads_survive_kills(tmp_path):
    with serving() as address:
        begun = kill_fetches(address, tmp_path, kills=12)
    assert sum(first > 0 for first in begun) >= 3, begun  # so many were resumed
