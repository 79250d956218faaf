"""The command line: `jaxsky simulate`, `fit`, `compare`, `separate`, `forecast` and others."""

import contextlib
import ctypes
import sys
from typing import Annotated

import typer

import jaxsky
from fits.commands import compare, data, fit, forecast, init, paper, separate, simulate
from fits.commands.console import replace_unprintable
from fits.commands.errors import print_error
from fits.commands.interrupt import prompt
from jaxsky.io.folders import cache_folder
from jaxsky.programs import keep_programs

#: Parameters of glibc's mallopt: M_ARENA_MAX, M_MMAP_THRESHOLD.
MALLOC = {-8: 1, -3: 8 * 2**20}


def _version(value: bool) -> None:
    if value:
        typer.echo(f"jaxsky {jaxsky.__version__}")
        raise typer.Exit


Version = Annotated[
    bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
]
app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def options(version: Version = False) -> None:
    """A JAX-differentiable model of the polarized microwave sky, with the tools to fit it."""


for _command in (init, simulate, fit, compare, separate, forecast, paper):
    _name = _command.__name__.rpartition(".")[2]
    app.command(_name)(getattr(_command, _name))
app.add_typer(data.data, name="data")


def _return_memory() -> None:
    """Have memory returned when it is freed.

    JAX computes in threads, and glibc gives each a heap that keeps what was freed in it, maps of
    up to 32 MiB among it: a third of all memory in use. So there is one heap for all threads,
    and large arrays are outside.
    """
    with contextlib.suppress(OSError, AttributeError):  # other systems have other ways
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in MALLOC.items():
            mallopt(parameter, value)


def main() -> None:
    """Run the command line: double precision on, mistakes as one sentence and exit code 2."""
    _return_memory()
    replace_unprintable()
    try:
        with prompt():
            import jax

            jax.config.update("jax_enable_x64", True)
            keep_programs(cache_folder() / "programs")
            if "--version" in sys.argv:  # after any command
                sys.argv[1:] = ["--version"]
            app()
    except Exception as error:
        print_error(error)
        sys.exit(2)
