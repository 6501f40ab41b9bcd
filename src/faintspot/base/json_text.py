"""JSON as its standard has it: the package's one writer and one reader, without NaN and infinity."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np


def to_json(value: object, *, indent: int | None = None, exact: bool = False) -> str:
    """Return JSON text that every reader accepts.

    Parameters
    ----------
    value
        Mappings, sequences, NumPy arrays and numbers, paths and plain values.
    indent : int, optional
    exact : bool
        Whether to refuse values that JSON lacks. Otherwise numbers that are not finite become null (unknown),
        and other objects text.

    Raises
    ------
    ValueError, TypeError
        With `exact`, for a number that is not finite, or another object.
    """
    return json.dumps(plain_values(value, exact=exact), indent=indent, allow_nan=False)


def plain_values(value: object, *, exact: bool = False) -> Any:
    """Return a value as JSON allows it; parameters and errors are those of `to_json`."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain_values(item, exact=exact) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_values(item, exact=exact) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        if exact:
            raise ValueError(f"{value} is not a finite number")
        return None
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if exact and not isinstance(value, Path):
        raise TypeError(f"{type(value).__name__} is neither number nor text")
    return str(value)


def parse_json(text: str | bytes) -> Any:
    """Return the content of a JSON text.

    Raises
    ------
    ValueError
        If it is not JSON, holds NaN or infinity, or is nested too deeply for Python.
    """
    try:
        return json.loads(text, parse_constant=_refused)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _refused(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not JSON")
