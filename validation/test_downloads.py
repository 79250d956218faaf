"""Downloads that are killed at random moments, again and again."""

from misbehaving import kill_fetches, serving


def test_downloads_survive_kills(tmp_path):
    with serving() as address:
        begun = kill_fetches(address, tmp_path, kills=12)
    assert sum(first > 0 for first in begun) >= 3, begun  # so many were resumed
