"""A command that is killed twice: see `make validate` for more kills, of all commands."""

from kills import Killing


def test_a_killed_simulation_ends_as_if_it_had_not_been(tmp_path):
    killing = Killing("simulate", tmp_path)
    killing.run(2)
    assert killing.finished >= 1  # to the end, with the results of the undisturbed run
