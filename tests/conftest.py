"""What tests of the command line and of downloads have in common."""

from collections.abc import Callable, Iterator

import pytest

from commands import jaxsky, one_sentence
from jaxsky.workers import Processes
from misbehaving import Handler, serving


@pytest.fixture
def mistake(monkeypatch, capsys) -> Callable[..., str]:
    """Runs a command that is refused; its one sentence."""

    def run(*arguments) -> str:
        capsys.readouterr()
        assert jaxsky(monkeypatch, *arguments) == 2
        return one_sentence(capsys)

    return run


@pytest.fixture(scope="session")
def two() -> Iterator[Processes]:
    """Two processes that make realisations."""
    with Processes(2) as processes:
        yield processes


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    """The address of a server that misbehaves in the way that it is asked."""
    with serving() as address:
        yield address


@pytest.fixture
def log() -> list[tuple[str, str | None]]:
    """What the server has been asked in the test."""
    Handler.log.clear()
    return Handler.log
