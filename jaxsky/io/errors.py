"""What is wrong with files."""

import os
import stat
from pathlib import Path


class InputError(ValueError):
    """A file that cannot be used, as it is or as it was asked for; one sentence with the names."""


class MissingFileError(InputError):
    """A file that is not there."""


def check_file(path: Path) -> None:
    """Raise InputError unless a path is a file that can be read; says what else it is."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        if path.is_symlink():
            link = f"is a link to {os.readlink(path)}, which is not there"
            raise InputError(f"{path}: {link}.") from None
        raise MissingFileError(f"{path}: no such file.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}).") from None
    except ValueError:
        raise InputError(f"{str(path)!r}: is no name of a file.") from None
    if not stat.S_ISREG(mode):
        kind = "a folder, not a file" if stat.S_ISDIR(mode) else "no regular file"
        raise InputError(f"{path}: is {kind}.")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: cannot be read (no permission).")
