"""Commands that are killed twice: see `make validate` for more kills."""

import pytest

from kills import COMMANDS, Killing


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_commands_end_as_if_they_had_not_been(name, tmp_path):
    killing = Killing(name, tmp_path)
    killing.run(2)
    assert killing.finished >= 1  # to the end, with the results of the undisturbed run
