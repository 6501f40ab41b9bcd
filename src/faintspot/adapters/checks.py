"""Checks of an adapter's input: version of the tool, matrices, predicted slopes."""

from __future__ import annotations

import functools
import importlib.metadata
import re
import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import real_array
from faintspot.base.errors import InputError


class UntestedVersionWarning(UserWarning):
    """Warning for another version of a tool than its adapter was tested with."""


@functools.cache
def check_version(tool: str, distribution: str, tested: str) -> None:
    """Warn once if a tool's version is not the one that its adapter was tested with.

    Parameters
    ----------
    tool, distribution : str
        Name of the tool, and of its installed distribution.
    tested : str
        Tested version.
    """
    try:
        version = importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return  # used from source: its version is not known
    if _numbers(version) != _numbers(tested):
        warnings.warn(
            f"{tool} {version}: faintspot's adapter was tested with {tested}; compare its slopes with "
            f"{tool}'s own before you rely on them",
            UntestedVersionWarning,
            stacklevel=3,
        )


def _numbers(version: str) -> tuple[int, ...]:
    """Return major, minor and patch version."""
    found = [int(number) for number in re.findall(r"\d+", version)[:3]]
    return tuple(found + [0] * (3 - len(found)))


def check_matrix(name: str, matrix: ArrayLike) -> NDArray[np.generic]:
    """Return an interaction or control matrix after checking that it is usable.

    Raises
    ------
    InputError
        When it has NaN or infinite numbers, or only zeros, e.g. after a failed calibration.
    """
    array = real_array(name, matrix, minimum_dimensions=2)
    bad = array.size - int(np.count_nonzero(np.isfinite(array)))
    if bad or not array.any():
        got = f"{bad} NaN or infinite of {array.size}" if bad else "zeros only"
        raise InputError(
            f"{name}: expected finite numbers that are not all 0, got {got}; calibrate again with noise-free "
            "frames that illuminate every sub-aperture"
        )
    return array


def predicted(
    predict: object, last: NDArray[np.generic] | None, shape: tuple[int, ...]
) -> NDArray[np.float64] | None:
    """Return the slopes that a tool's loop predicts for the next frame, in the tool's unit and order.

    Parameters
    ----------
    predict : callable or object with `predict`, optional
        Takes the last slopes. If it is None or returns None, there is no prediction.
    last : array, optional
        Last slopes; None before the first frame, when there is no prediction.
    shape : tuple of int
        Shape of the slopes.

    Raises
    ------
    InputError
        When the object cannot be called, or the slopes have another shape.
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
