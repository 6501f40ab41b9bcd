"""What tools and their users give an adapter, checked: a tool's version, matrices, predicted slopes."""

from __future__ import annotations

import functools
import importlib.metadata
import re
import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import real_array
from faintspot.base.errors import InputError


class UntestedVersionWarning(UserWarning):
    """A tool is older or newer than those that its adapter was tested with."""


@functools.cache
def check_version(tool: str, distribution: str, oldest: str, newest: str) -> None:
    """Warn, once, when a tool is none of the versions that its adapter was tested with.

    Parameters
    ----------
    tool, distribution : str
        What people call it, and what it is installed as.
    oldest, newest : str
        Versions that were tested.
    """
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return  # used from its sources: nothing says which version it is
    if not _numbers(oldest) <= _numbers(version) <= _numbers(newest):
        tested = oldest if oldest == newest else f"{oldest} to {newest}"
        warnings.warn(
            f"{tool} {version}: faintspot's adapter was tested with {tested}; compare its slopes with "
            f"{tool}'s own before you rely on them",
            UntestedVersionWarning,
            stacklevel=3,
        )


def _numbers(version: str) -> tuple[int, ...]:
    """Major, minor and patch."""
    found = [int(number) for number in re.findall(r"\d+", version)[:3]]
    return tuple(found + [0] * (3 - len(found)))


def check_matrix(name: str, matrix: ArrayLike) -> NDArray[Any]:
    """Return an interaction or control matrix that can be used.

    Raises
    ------
    InputError
        When it has NaN or infinite numbers, or nothing but zeros, as after a calibration that went wrong.
    """
    array = real_array(name, matrix, minimum_dimensions=2)
    bad = array.size - int(np.count_nonzero(np.isfinite(array)))
    if bad or not array.any():
        got = f"{bad} NaN or infinite of {array.size}" if bad else "zeros only"
        raise InputError(
            f"{name}: expected finite numbers that are not all 0, got {got}; calibrate again with frames "
            "without noise and light in every sub-aperture"
        )
    return array


def predicted(predict: Any, last: NDArray[Any] | None, shape: tuple[int, ...]) -> NDArray[np.float64] | None:
    """Return the slopes that a tool's loop predicts for the next frame, in the tool's own unit and order.

    Parameters
    ----------
    predict : callable or object with `predict`, optional
        Takes the last slopes. None, also what it returns: nothing is predicted.
    last : array, optional
        None before the first frame: nothing is predicted then.
    shape : tuple of int
        Of the slopes.

    Raises
    ------
    InputError
        For something that cannot be called, or slopes of another shape.
    """
    if predict is None:
        return None
    call = getattr(predict, "predict", predict)
    if not callable(call):
        raise InputError(f"predict: expected a callable or an object with predict(slopes), got {predict!r}")
    value = None if last is None else call(last)
    if value is None:
        return None
    array = real_array("predict", value)
    if array.size != int(np.prod(shape)):
        raise InputError(f"predict: expected slopes of shape {shape}, got {array.shape}")
    return array.astype(np.float64).reshape(shape)
