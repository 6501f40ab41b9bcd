"""Text files: slopes in .csv, a line for each frame and sub-aperture; arrays in .csv, .txt and .dat."""

from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import check_file_size, read_bytes
from faintspot.base.flags import VARIABLES
from faintspot.io.file_format import (
    UNITS,
    ExistingOutput,
    FileFormat,
    StoredSlopes,
    most_slopes_bytes,
    with_absent,
)
from faintspot.io.stored_array import MOST_WHOLE_BYTES, StoredArray, one_line

_LINES = 1 << 14
_INDEX = ("frame", "subaperture")
TEXTS = (".csv", ".txt", ".dat")
"""Endings of arrays in text files."""


class Csv(FileFormat):
    """Slopes as a table with the quantities of `VARIABLES`; other arrays as rows of numbers."""

    name = "CSV"
    endings = (".csv",)

    def has_frames(self, path: Path, start: bytes) -> bool:
        """Return whether the name of a file ends as that of a text."""
        return bool(start) and path.suffix.lower() in TEXTS

    def find(self, path: Path, key: str | None) -> StoredArray:
        """Return the numbers of a text; fields are apart by commas, semicolons or blanks.

        A first line of names and comments after # are left out. Empty fields between commas are NaN.
        """
        if key is not None:
            raise InputError(f"{path}: expected no name of an array, as a text has one, got {key!r}")
        try:
            # A number takes at least two characters.
            content = read_bytes(path, "rows of numbers", MOST_WHOLE_BYTES // 4)
            values = _numbers(content.decode("utf-8-sig").splitlines())
        except InputError:
            raise
        except ValueError as error:
            raise InputError(f"{path}: expected rows of numbers ({one_line(error)})") from None
        return StoredArray.whole(f"{path}", values.shape, values.dtype, lambda: values)

    def write(self, stream: IO[bytes], slopes: StoredSlopes) -> None:
        """Write floats with the fewest digits that reproduce them."""
        names = [
            *_INDEX,
            *(column_name(name, str(slopes.attributes.get("unit", "px"))) for name in VARIABLES),
        ]
        stream.write((",".join(names) + "\n").encode())
        count, width = slopes.variables["x"].shape
        step = max(1, _LINES // width)
        for start in range(0, count, step):
            stop = min(start + step, count)
            frames, subapertures = np.divmod(np.arange(start * width, stop * width), width)
            columns = [frames, subapertures]
            for name in VARIABLES:
                piece = np.asarray(slopes.variables[name][start:stop]).reshape(-1)
                columns.append(piece.view(np.uint8) if piece.dtype == np.bool_ else piece)
            lines = zip(*(column.astype(str).tolist() for column in columns), strict=True)
            stream.write("".join(",".join(line) + "\n" for line in lines).encode())

    def has_slopes(self, path: Path) -> bool:
        """Return whether the first line names the columns of slopes."""
        check_file_size(path, "slopes", most_slopes_bytes() // 4)
        with path.open("rb") as stream:
            return stream.readline(1 << 12).startswith(",".join(_INDEX).encode())

    def finished(self, path: Path) -> ExistingOutput | None:
        """Return an output without a fingerprint: a table does not identify its run."""
        return ExistingOutput(None, (0, 0), complete=True) if path.exists() else None

    def read(self, path: Path) -> StoredSlopes:
        """Read the whole table."""
        check_file_size(path, "slopes", most_slopes_bytes() // 4)  # a number takes at least two characters
        with path.open(encoding="utf-8") as stream:
            names = stream.readline().strip().split(",")
        unit = next((unit for unit in UNITS if column_name("x", unit) in names), "px")
        table = np.loadtxt(path, delimiter=",", skiprows=1, ndmin=2)
        width = int(table[:, names.index("subaperture")].max()) + 1
        columns = {name: column_name(name, unit) for name in VARIABLES}
        stored = {
            name: table[:, names.index(column)].reshape(-1, width).astype(VARIABLES[name].dtype)
            for name, column in columns.items()
            if column in names
        }
        variables = with_absent(stored)
        attributes = {} if unit == "px" else {"unit": unit}
        return StoredSlopes(variables, {}, attributes, True, len(variables["x"]))


def column_name(name: str, unit: str) -> str:
    """Return the heading of a variable's column, with the unit of positions."""
    units = VARIABLES[name].units
    suffix = {"1": "", "e-": "_e"}.get(units, f"_{units.replace('px', unit).replace('^', '')}")
    return f"{name}{suffix}"


def _numbers(lines: list[str]) -> NDArray[np.float64]:
    """Return the rows of a text, (rows, columns)."""
    lines = [line for line in lines if line.split("#")[0].strip()]
    separator = next((sign for sign in ",;" if lines and sign in lines[0]), None)
    if lines and not any(map(_is_number, lines[0].split(separator))):
        del lines[0]  # a line of names
    if not lines:
        raise ValueError("it has none")
    try:
        return np.loadtxt(lines, delimiter=separator, ndmin=2)
    except ValueError:  # empty fields
        return np.loadtxt(lines, delimiter=separator, ndmin=2, converters=_number)


def _number(field: str) -> float:
    return float(field.strip() or "nan")


def _is_number(field: str) -> bool:
    try:
        _number(field)
    except ValueError:
        return False
    return True
