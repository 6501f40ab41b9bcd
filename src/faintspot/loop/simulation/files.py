"""Files of results: a dataclass whose fields are written to one NumPy file, and read again."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.npz import read_arrays, save_arrays

MAGNITUDE_FILE = "magnitude.npz"
BUDGET_FILE = "budget.npz"
"""Names of the files in a folder of results."""


@dataclass(frozen=True, eq=False)
class Stored:
    """Dataclass of arrays, texts, numbers and tuples of texts that can be saved to a file.

    A subclass that changes its fields changes its `FORMAT`: files of another one are refused.
    """

    WHAT: ClassVar[str]
    """Name in messages."""
    FORMAT: ClassVar[int] = 1

    def save(self, path: str | Path) -> None:
        """Write everything to a compressed NumPy file (.npz), which is never seen half written.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        save_arrays(path, self.arrays())

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the fields as arrays for the file."""
        values = {item.name: np.asarray(getattr(self, item.name)) for item in fields(self)}
        return {"format": np.asarray(self.FORMAT), **values}

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            When it cannot be read, or is something else.
        """
        values = read_arrays(path, cls.WHAT)
        version = values.pop("format", None)
        if version != cls.FORMAT or set(values) != {item.name for item in fields(cls)}:
            raise InputError(f"{path}: expected {cls.WHAT} of format {cls.FORMAT}, got something else")
        return cls(**{name: _restored(value) for name, value in values.items()})


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


def _restored(value: NDArray[Any]) -> Any:
    """Return an array as what it was: a row of texts is a tuple, what has no axes a plain number or text."""
    if value.ndim == 0:
        return value.item()
    return tuple(value.tolist()) if value.dtype.kind == "U" and value.ndim == 1 else value
