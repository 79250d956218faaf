"""`jaxsky simulate`."""

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from jaxsky.cli.console import console, progress_bar, warn, write_example
from jaxsky.cli.results import results_folder
from jaxsky.io.folders import ALL
from jaxsky.settings_keys import of_file

__all__ = ["simulate"]

#: What is simulated with --only: from the names of the foregrounds.
ONLY: dict[str, Callable[[list[str]], list[str]]] = {
    "noise": lambda foregrounds: ["noise"],
    "signal": lambda foregrounds: [*foregrounds, "cmb"],
    "foregrounds": lambda foregrounds: foregrounds,
    "cmb": lambda foregrounds: ["cmb"],
}


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
    first: Annotated[int, typer.Option(min=0, max=2**32 - 1, help="Number of the first one.")] = 0,
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
        write_example(experiment_file or Path("experiment.toml"), experiment.EXAMPLE)
        return
    if only is not None and only not in ONLY:
        raise ValueError(f"--only must be one of {', '.join(ONLY)}, not {only!r}.")
    experiment_file = experiment_file or experiment.DEFAULT
    settings = experiment.load_experiment(
        experiment_file, {"experiment": {"seed": seed, "nside": nside}}
    )
    if only is not None:
        main = {"include": ONLY[only](settings.foregrounds())}
        settings = settings.model_copy(
            update={"experiment": settings.experiment.model_copy(update=main)}
        )
    started = time.perf_counter()
    indices = range(first, first + nsims)
    # With --overwrite all realisations are removed, so nobody else may be making any.
    part = ALL if overwrite else indices
    with (
        of_file(experiment_file),
        results_folder(out, resume=resume, overwrite=overwrite, part=part) as folder,
        progress_bar() as progress,
    ):
        task = progress.add_task("reading templates", total=None)

        def report(message: str) -> None:
            progress.update(task, description=message)

        from jaxsky import montecarlo
        from jaxsky.io import read_maps

        montecarlo.check_folder(out, settings, resume, overwrite, indices)
        setup = experiment.build(settings)
        names = setup.observation.names
        progress.update(task, total=nsims * len(names))
        seconds, notes = {}, dict[str, None]()  # a set that keeps its order
        for file in montecarlo.run(
            settings,
            setup,
            out,
            indices,
            overwrite,
            report,
            lambda note: notes.setdefault(note),
            lambda: folder.narrow(indices),
        ):
            progress.advance(task)
            if file.seconds is not None:
                seconds[file.path] = file.seconds
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
                lambda path: read_maps(path, fields=["Q", "U"], missing=[]).maps,
                setup.observation.lmax,
                settings.experiment.unit,
                settings.title,
            )
    console.print(setup.description)
    for sentence in notes:
        warn(sentence)
    kept = nsims * len(names) - len(seconds)
    rate = f"{statistics.median(seconds.values()):.2g} s a band, " if seconds else ""
    console.print(
        f"Written: {len(seconds)} maps in {' and '.join(map(str, written))}"
        + (f"; {kept} maps were there already" if kept else "")
        + f" ({rate}{time.perf_counter() - started:.1f} s in all).",
        soft_wrap=True,
    )
