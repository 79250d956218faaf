"""Commands that are killed again and again; `JAXSKY_KILLS=40` for more kills than 12."""

import os

import pytest

from kills import COMMANDS, Killing


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_commands_end_as_if_they_had_not_been(name, tmp_path):
    kills = int(os.environ.get("JAXSKY_KILLS", "12"))
    killing = Killing(name, tmp_path, seed=kills)
    killing.run(kills, interrupts=2)
    assert killing.finished >= 1
    print(f"{name}: {killing.seconds:.1f} s undisturbed, {killing.finished} ends")
