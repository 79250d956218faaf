"""`jaxsky paper`, from settings to a page."""

from collections.abc import Sequence

from fits.commands.run import PAGE, Command, Report, Run
from fits.paper.run import run as make
from jaxsky.settings import Experiment


def figures(only: Sequence[str]) -> Command:
    """The command that makes some figures, or all; each sees to what is kept of it."""

    def work(settings: Experiment, command: Run) -> Report:
        items = make(
            settings,
            command.out,
            only,
            resume=command.options.resume,
            overwrite=command.options.overwrite,
            begin=command.begin,
            progress=command.steps,
        )
        missing = [f"{i.label}: {i.differs}" for i in items if not (i.picture or i.table)]
        remark = f"{len(items)} figures and tables ({command.steps.seconds:.1f} s)."
        return Report("", (), missing, [command.out / PAGE], remark, page=False)

    return Command("paper", work)
