"""The command line: `jaxsky simulate`, `fit`, `compare`, `separate`, `forecast` and others.

A command is declared here; its module in `fits.commands` is imported when it runs.
"""

import inspect
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated

import jax
import typer

import jaxsky
from fits.commands.data import data_commands
from fits.commands.report import console, print_written
from fits.commands.run import DEFAULTS, Command, interruptible, print_error, run_command
from jaxsky import job
from jaxsky.io.files import cache_folder
from jaxsky.programs import keep_programs, return_memory

#: The experiment file with all keys, commented.
TEMPLATE = "experiment"
#: What `jaxsky simulate` may be restricted to.
ONLY = ("noise", "signal", "foregrounds", "cmb")
#: Commands with the same options, but for those that some lack.
ANALYSES = {
    "fit": "Fit spectral indices to polarization maps: on a grid, by gradient and by MCMC.",
    "compare": "Compare observed maps with the model of foregrounds, CMB and noise.",
    "separate": "Separate CMB and foregrounds by their laws, and measure r from cleaned B modes.",
    "forecast": "Forecast B modes: foregrounds against primordial ones; errors on r and the laws.",
}
LACKING = {"fit": {"workers"}, "forecast": {"maps", "workers", "resume"}}

SettingsPath = Annotated[
    Path | None,
    typer.Argument(metavar="[EXPERIMENT.toml]", help="Without, one with the embedded sky."),
]
Out = Annotated[Path, typer.Option(help="Folder for the results.")]
Values = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Any key of the file; repeatable."),
]
Resume = Annotated[bool, typer.Option("--resume", help="Keep what is in --out, and go on with it.")]
Workers = Annotated[
    str | None,
    typer.Option(
        metavar="N|tcp://HOST:PORT",
        help="Make realisations in N processes, or on the workers of a Dask scheduler.",
    ),
]
Overwrite = Annotated[
    bool, typer.Option("--overwrite", help="Replace the results that are in --out.")
]

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)


@app.callback()
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
) -> None:
    """A JAX-differentiable model of the polarized microwave sky, with the tools to fit it."""


def _experiments(incomplete: str = "") -> list[str]:
    """Return the experiments of `jaxsky init` whose names begin with these letters."""
    return sorted(p.stem for p in DEFAULTS.glob("*.toml") if p.stem.startswith(incomplete))


@app.command("init")
def _init(
    name: Annotated[
        str,
        typer.Argument(
            help=f"{TEMPLATE}: all keys, commented; planck-44-70, planck-separate: Planck's maps "
            "of 2018; or a command, for what it does without a file.",
            autocompletion=_experiments,
        ),
    ] = TEMPLATE,
    out: Annotated[
        Path | None, typer.Option(help="File to write.", show_default="NAME.toml")
    ] = None,
) -> None:
    """Write an experiment file to start from."""
    if name not in _experiments():
        raise ValueError(f"There is no experiment {name!r}; there are {', '.join(_experiments())}.")
    path = out or Path(f"{name}.toml")
    if path.exists():
        raise ValueError(f"{path}: exists already and is left as it is.")
    path.write_text((DEFAULTS / f"{name}.toml").read_text())
    print_written([path])


@app.command("simulate")
def _simulate(
    file: SettingsPath = None,
    out: Annotated[Path, typer.Option(help="Folder for the maps.")] = Path("results/simulate"),
    nsims: Annotated[int, typer.Option(min=1, help="Number of realisations.")] = 1,
    first: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Number of the first one.")] = 0,
    only: Annotated[
        str | None, typer.Option(help=f"Simulate one thing only: {', '.join(ONLY)}.")
    ] = None,
    values: Values = None,
    workers: Workers = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
) -> None:
    """Simulate maps of the microwave sky as an experiment observes it."""
    from fits.commands.simulate import make_realisations

    if only is not None and only not in ONLY:
        raise ValueError(f"--only must be one of {', '.join(ONLY)}, not {only!r}.")
    command = Command("simulate", partial(make_realisations, only=only))
    part = range(first, first + nsims)
    run_command(
        command, file, out, values, part=part, resume=resume, overwrite=overwrite, workers=workers
    )


def _analysis(name: str) -> Callable[..., None]:
    """Return the command of a name, with its options."""
    lacking = LACKING.get(name, set())

    def command(
        file: SettingsPath = None,
        out: Out = Path(f"results/{name}"),
        maps: Annotated[
            Path | None,
            typer.Option(
                help="Folder of a realisation of `jaxsky simulate`, for bands without a file."
            ),
        ] = None,
        values: Values = None,
        workers: Workers = None,
        resume: Resume = False,
        overwrite: Overwrite = False,
    ) -> None:
        own = import_module(f"fits.commands.{name}").COMMAND
        again = None if "resume" in lacking else resume
        run_command(
            own, file, out, values, maps=maps, resume=again, overwrite=overwrite, workers=workers
        )

    given = inspect.signature(command)
    kept = [one for one in given.parameters.values() if one.name not in lacking]
    command.__signature__ = given.replace(parameters=kept)  # type: ignore[attr-defined]
    return command


for _name, _help in ANALYSES.items():
    app.command(_name, help=_help)(_analysis(_name))


@app.command("paper")
def _paper(
    file: SettingsPath = None,
    out: Out = Path("results/paper"),
    only: Annotated[
        list[str] | None,
        typer.Option(help="A figure by its number, or 'table 1'; repeatable. Default all."),
    ] = None,
    values: Values = None,
    workers: Workers = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
) -> None:
    """Make the figures and tables of the paper again, and a page that shows them."""
    from fits.commands.paper import KEPT, report_figures

    command = Command("paper", partial(report_figures, only=only or ()), (KEPT,), stokes=("QU",))
    run_command(command, file, out, values, resume=resume, overwrite=overwrite, workers=workers)


app.add_typer(data_commands, name="data")


def main() -> None:
    """Run the command line in double precision; an error is one sentence and exit code 2."""
    return_memory()
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # what a terminal's encoding lacks is replaced
            stream.reconfigure(errors="replace")
    try:
        with interruptible():
            jax.config.update("jax_enable_x64", True)
            keep_programs(cache_folder() / "programs")
            if "--version" in sys.argv:  # after any command
                print(f"jaxsky {jaxsky.__version__}")
            else:
                with job.processes():
                    app()
    except Exception as error:
        if not job.told:  # else the first of several processes says it
            console.quiet = False
        print_error(error)
        sys.exit(2)
