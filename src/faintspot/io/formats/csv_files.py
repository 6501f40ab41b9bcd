"""Slopes in .csv files: one line per frame and sub-aperture, without coordinates and attributes."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from faintspot.base.files import check_file_size
from faintspot.base.variables import VARIABLES
from faintspot.io.formats.file_format import FileFormat
from faintspot.io.stored.slopes_format import (
    UNITS,
    ExistingOutput,
    StoredSlopes,
    most_slopes_bytes,
    with_absent,
)

_LINES = 1 << 14
_INDEX = ("frame", "subaperture")


class Csv(FileFormat):
    """A table with the quantities of `VARIABLES` as columns."""

    name = "CSV"
    endings = (".csv",)

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
    """Return the heading of a variable's column."""
    variable = VARIABLES[name]
    return variable.csv_name.replace("_px", f"_{unit}") if "px" in variable.units else variable.csv_name
