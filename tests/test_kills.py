"""Commands that are killed twice: see `make validate` for more kills."""

import pytest

from kills import COMMANDS, Killing


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_commands_end_as_if_they_had_not_been(name, tmp_path):
    Killing(name, tmp_path).run(2)
