"""The folder of a command's results: locked, checked, and left whole when a command is stopped."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from jaxsky.cli.console import warn
from jaxsky.cli.errors import logged
from jaxsky.cli.interrupt import interruptible
from jaxsky.io.folders import ALL, Folder, occupied

__all__ = ["results_folder"]


@contextmanager
def results_folder(
    out: Path,
    results: Sequence[str] = (),
    *,
    resume: bool | None,
    overwrite: bool,
    part: range = ALL,
) -> Iterator[Folder]:
    """The folder of the results, in which no other command writes the same meanwhile.

    Parameters
    ----------
    out : the folder; made if it is not there, and removed again if nothing was written
    results : patterns of what the command leaves in it
    resume, overwrite : results that are there are kept or replaced, and refused if neither is
        set. `resume` is None for commands that cannot be resumed.
    part : what of the results is made, see `occupied`

    Raises
    ------
    ValueError
        If another command works in the folder, or there are results that are not to be kept or
        replaced.
    """
    if resume and overwrite:
        raise ValueError("--resume and --overwrite exclude each other.")
    if out.exists() and not out.is_dir():
        raise ValueError(f"{out}: is not a folder; choose another --out.")
    stopped = interruptible("" if resume is None else "; resume with --resume")
    with stopped, occupied(out, part) as folder, logged(out):
        if not folder.locked:
            warn(
                f"{out}: this file system has no locks, so see to it that no other command writes "
                "there meanwhile."
            )
        if not (resume or overwrite) and any(any(out.glob(name)) for name in results):
            go_on = "" if resume is None else "go on with --resume, "
            raise ValueError(
                f"{out}: holds results already; {go_on}replace them with --overwrite, or choose "
                "another --out."
            )
        folder.clean()
        yield folder
