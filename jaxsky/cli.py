"""The command line: `jaxsky fit`, `jaxsky simulate`."""

import contextlib
import ctypes
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

import jaxsky

app = typer.Typer(
    help="A JAX-differentiable model of the polarized microwave sky, with the tools to fit it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
console = Console(stderr=True)

#: Parameters of glibc's mallopt: M_ARENA_MAX, M_MMAP_THRESHOLD.
MALLOC = {-8: 1, -3: 8 * 2**20}

#: What a fit leaves in its folder.
RESULTS = (
    "result.json",
    "log.json",
    "grid.png",
    "marginals.png",
    "posterior.png",
    "chain.h5",
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"jaxsky {jaxsky.__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """A JAX-differentiable model of the polarized microwave sky, with the tools to fit it."""


@app.command()
def fit(
    settings_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ANALYSIS.toml]", help="Settings; without, the embedded sky is fitted."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the results.")] = Path("results/fit"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of simulated maps and chains.")] = None,
    region: Annotated[
        list[str] | None, typer.Option(help="strip, outside, full or a mask file; repeatable.")
    ] = None,
    stokes: Annotated[list[str] | None, typer.Option(help="Q, U or QU; repeatable.")] = None,
    nside: Annotated[int | None, typer.Option(help="Common nside of the comparison.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the chains in --out.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the results that are in --out.")
    ] = False,
) -> None:
    """Fit spectral indices to polarization maps: on a grid, by gradient and by MCMC."""
    started = time.perf_counter()
    from fits import settings as fit_settings

    if init:
        _write_example(settings_file or Path("analysis.toml"), fit_settings.EXAMPLE)
        return
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    # Files on the command line are relative to the folder one is in, not to the settings.
    files = [str(Path(r).resolve()) if Path(r).is_file() else r for r in region or []]
    overrides = {"seed": seed, "regions": files or None, "stokes": stokes, "nside": nside}
    settings = fit_settings.load_settings(settings_file or fit_settings.EMBEDDED, overrides)
    if not (resume or overwrite) and any((out / name).exists() for name in RESULTS):
        raise ValueError(
            f"{out}: holds results already; go on with --resume, replace them with --overwrite, "
            "or choose another --out."
        )

    with console.status("starting") as status:
        import matplotlib as mpl

        mpl.use("Agg")  # pictures go to files
        from fits import inputs as fit_inputs
        from fits import report, spectral_index

        status.update("reading and preparing maps")
        regions = spectral_index.region_masks(settings)
        inputs = (
            fit_inputs.embedded_inputs(settings)
            if settings.embedded
            else fit_inputs.read_inputs(settings)
        )
        prepared = spectral_index.prepare(inputs, settings.analysis.nside, settings.analysis.fwhm)
        chains = _claim(out, overwrite)

        def report_step(message: str) -> None:
            # emcee's progress bar takes the place of the status line.
            (status.stop if message.endswith("mcmc") else status.start)()
            status.update(message)

        try:
            fits = spectral_index.run(
                settings, prepared, regions, chains, report_step, progress=True
            )
        except KeyboardInterrupt:
            status.stop()
            console.print("Stopped; go on with --resume.")
            raise typer.Exit(130) from None
        status.start()
        status.update("drawing")
        seconds = time.perf_counter() - started
        written = report.write_report(out, inputs, settings, fits, seconds)
    console.print(inputs.description, highlight=False)
    Console().print(report.result_table(fits))
    for sentence in report.warnings(fits, settings.analysis.methods):
        console.print(f"[yellow](!)[/] {sentence}", highlight=False)
    written += [chains] if chains.exists() else []
    # Not wrapped, so that paths can be copied.
    console.print("Written: " + ", ".join(map(str, written)), highlight=False, soft_wrap=True)


#: What is simulated with --only: from the names of the foregrounds.
ONLY: dict[str, Callable[[list[str]], list[str]]] = {
    "noise": lambda foregrounds: ["noise"],
    "signal": lambda foregrounds: [*foregrounds, "cmb"],
    "foregrounds": lambda foregrounds: foregrounds,
    "cmb": lambda foregrounds: ["cmb"],
}


@app.command()
def simulate(
    experiment_file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[EXPERIMENT.toml]",
            help="Settings; without, COrE observes the embedded sky at 1 degree.",
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the maps.")] = Path("results/simulate"),
    init: Annotated[
        bool, typer.Option("--init", help="Write a commented example of the settings and stop.")
    ] = False,
    nsims: Annotated[int, typer.Option(min=1, help="Number of realisations.")] = 1,
    first: Annotated[int, typer.Option(min=0, help="Number of the first one.")] = 0,
    only: Annotated[
        str | None, typer.Option(help=f"Simulate one thing only: {', '.join(ONLY)}.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all realisations.")] = None,
    nside: Annotated[int | None, typer.Option(help="Resolution of the maps.")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep the files in --out and make what is missing.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the simulation that is in --out.")
    ] = False,
) -> None:
    """Simulate maps of the microwave sky as an experiment observes it."""
    from jaxsky import experiment

    if init:
        _write_example(experiment_file or Path("experiment.toml"), experiment.EXAMPLE)
        return
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    if only is not None and only not in ONLY:
        raise ValueError(f"--only must be one of {', '.join(ONLY)}, not {only!r}.")
    settings = experiment.load_experiment(
        experiment_file or experiment.DEFAULT, {"experiment": {"seed": seed, "nside": nside}}
    )
    if only is not None:
        main = {"include": ONLY[only](settings.foregrounds())}
        settings = settings.model_copy(
            update={"experiment": settings.experiment.model_copy(update=main)}
        )
    started = time.perf_counter()
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
    ) as progress:
        task = progress.add_task("reading templates", total=None)

        def report(message: str) -> None:
            progress.update(task, description=message)

        from jaxsky import montecarlo
        from jaxsky.io import read_maps

        setup = experiment.build(settings)
        montecarlo.check_folder(out, settings, resume, overwrite)
        names = setup.observation.names
        progress.update(task, total=nsims * len(names))
        seconds, notes = {}, dict[str, None]()  # a set that keeps its order
        indices = range(first, first + nsims)
        try:
            for file in montecarlo.run(
                settings,
                setup,
                out,
                indices,
                overwrite,
                report,
                lambda note: notes.setdefault(note),
            ):
                progress.advance(task)
                if file.seconds is not None:
                    seconds[file.path] = file.seconds
        except KeyboardInterrupt:
            progress.stop()
            console.print("Stopped; go on with --resume.")
            raise typer.Exit(130) from None
        written = [out / "sim_*"]
        if settings.experiment.sheet:
            import matplotlib as mpl

            mpl.use("Agg")  # pictures go to files
            from jaxsky import plots

            report("drawing")
            written.append(out / f"sim_{first:05d}.png")
            plots.contact_sheet(
                written[-1],
                montecarlo.paths(out, names, first),
                lambda path: read_maps(path, fields=["Q", "U"]).maps,
                setup.observation.lmax,
                settings.experiment.unit,
                settings.title,
            )
    console.print(setup.description, highlight=False, markup=False)
    for sentence in notes:
        console.print(f"[yellow](!)[/] {sentence}", highlight=False)
    kept = nsims * len(names) - len(seconds)
    rate = f"{statistics.median(seconds.values()):.2g} s a band, " if seconds else ""
    console.print(
        f"Written: {len(seconds)} maps in {' and '.join(map(str, written))}"
        + (f"; {kept} maps were there already" if kept else "")
        + f" ({rate}{time.perf_counter() - started:.1f} s in all).",
        highlight=False,
        soft_wrap=True,
    )


def _write_example(path: Path, example: Path) -> None:
    if path.exists():
        raise ValueError(f"{path}: exists already and is left as it is.")
    path.write_text(example.read_text())
    console.print(f"Written: {path}")


def _claim(out: Path, overwrite: bool) -> Path:
    """The place of the chains in the folder of the results, made, and emptied if wanted."""
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is not a folder; choose another --out.")
    out.mkdir(parents=True, exist_ok=True)
    if overwrite:
        for name in RESULTS:
            (out / name).unlink(missing_ok=True)
    return out / "chain.h5"


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
    import jax

    jax.config.update("jax_enable_x64", True)
    try:
        app()
    except (ValueError, KeyError, OSError) as error:
        message = error.args[0] if isinstance(error, KeyError) else error
        console.print(f"[red]jaxsky:[/] {escape(str(message))}", highlight=False, soft_wrap=True)
        sys.exit(2)
