"""Storage of the arrays of telemetry: types, dimensions and units."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from faintspot.base.variables import VARIABLES


class ArrayStorage(NamedTuple):
    """Storage of an array of telemetry."""

    dtype: np.dtype[np.generic]
    dimensions: tuple[str, ...]
    units: str
    in_all: bool
    """Whether all recordings have it; else it is read as zeros, e.g. commands of an engine without any."""


def array(dtype: Any, dimensions: str, units: str = "1", *, in_all: bool = True) -> dict[str, ArrayStorage]:
    """Return the metadata of a field of `Telemetry`; dimensions are words."""
    return {"stored": ArrayStorage(np.dtype(dtype), tuple(dimensions.split()), units, in_all)}


def of_slopes(name: str, dtype: object, *, in_all: bool = True) -> dict[str, ArrayStorage]:
    """Return those of a quantity of each slope."""
    return array(dtype, "frame subaperture", VARIABLES[name].units, in_all=in_all)
