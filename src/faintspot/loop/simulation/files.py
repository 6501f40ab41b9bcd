"""Folders of results and the names of their files."""

from __future__ import annotations

from pathlib import Path

from faintspot.base.errors import InputError

MAGNITUDE_FILE = "magnitude.npz"
BUDGET_FILE = "budget.npz"
"""Names of the files in a folder of results."""


def holds_loop_results(path: Path) -> bool:
    """Return whether a folder holds results of `faintspot loop`."""
    return any((path / name).is_file() for name in (MAGNITUDE_FILE, BUDGET_FILE))


def make_folder(folder: str | Path) -> Path:
    """Make a folder if it does not exist, and return its path.

    Raises
    ------
    InputError
        When it cannot be made.
    """
    folder = Path(folder)
    try:
        folder.mkdir(exist_ok=True)
    except FileNotFoundError:
        raise InputError(f"{folder}: the folder {folder.parent} does not exist: create it first") from None
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror or error})") from None
    return folder
