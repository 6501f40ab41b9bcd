"""Input checks on entry to every public function and on reading every file; independent random generators."""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError

# Largest pixel values whose sums and squares the kernels form without overflow.
LARGEST_FLOAT32 = 1e30
LARGEST_FLOAT64 = 1e290
_WHOLE = -(2.0**53), 2.0**53  # whole numbers that float64 holds

_Value = TypeVar("_Value")


def not_none(value: _Value | None) -> _Value:
    """Return a value that must have been set before; a TypeError is an error of the program, not its user."""
    if value is None:
        raise TypeError("a value that must have been set before is None")
    return value


def real_array(name: str, value: Any, *, minimum_dimensions: int = 0) -> NDArray[np.generic]:
    """Return `value` as a real numeric array (bool counts as integer); dtype is kept.

    Masked values (numpy.ma) become NaN, and integer arrays with masked values become floats.

    Raises
    ------
    InputError
        If it is not numeric, is complex, is empty or has too few dimensions.
    """
    try:
        array = _masked_as_nan(value) if np.ma.is_masked(value) else np.asarray(value)
    except (ValueError, TypeError) as error:
        got = f"{type(value).__name__} ({error})"
        raise InputError(f"expected an array of real numbers, got {got}", name=name) from None
    if array.dtype == np.bool_:
        array = array.astype(np.uint8)
    if array.dtype.kind not in "iuf":
        raise InputError(f"expected real numbers, got dtype {array.dtype}", name=name)
    if array.ndim < minimum_dimensions:
        raise InputError(
            f"expected at least {minimum_dimensions} dimensions, got shape {array.shape}", name=name
        )
    if array.size == 0:
        raise InputError(f"expected at least one value, got an empty array of shape {array.shape}", name=name)
    return array


def _masked_as_nan(value: np.ma.MaskedArray[Any, Any]) -> NDArray[np.generic]:
    """Return a masked array as floats with NaN in masked places; float32 if it is exact."""
    dtype = np.result_type(value.dtype, np.float32)
    filled: NDArray[np.generic] = np.ma.filled(value.astype(dtype), np.nan)
    return filled


def finite_array(name: str, value: object, *, minimum_dimensions: int = 0) -> NDArray[Any]:
    """Return `value` as a real array without NaN or infinity."""
    array = real_array(name, value, minimum_dimensions=minimum_dimensions)
    if array.dtype.kind == "f":
        bad = array.size - int(np.count_nonzero(np.isfinite(array)))
        if bad:
            got = f"{bad} NaN or infinite of {array.size}"
            raise InputError(f"expected finite numbers, got {got}", name=name)
    return array


def check_shape(name: str, array: NDArray[Any], *shapes: tuple[int | str, ...]) -> None:
    """Check that an array has one of some shapes; a text stands for any length, as in ("n", 2).

    Raises
    ------
    InputError
        If it has another one.
    """
    if array.shape in shapes:  # at once, as of each frame
        return
    for shape in shapes:
        pairs = zip(shape, array.shape, strict=False)
        if len(shape) == array.ndim and all(isinstance(n, str) or n == found for n, found in pairs):
            return
    expected = " or ".join(f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})" for shape in shapes)
    raise InputError(f"expected shape {expected}, got {array.shape}", name=name)


def image_stack(name: str, value: object) -> NDArray[np.floating[Any]]:
    """Return `value` as finite float32 or float64 images (..., ny, nx), contiguous.

    float32 and float16 images become float32, all others float64.
    """
    array = finite_array(name, value, minimum_dimensions=2)
    dtype = np.float32 if array.dtype.kind == "f" and array.dtype.itemsize <= 4 else np.float64
    limit = LARGEST_FLOAT32 if dtype == np.float32 else LARGEST_FLOAT64
    largest = float(np.max(np.abs(array)))
    if largest > limit:
        kind = np.dtype(dtype)
        raise InputError(f"expected magnitudes up to {limit:g} in {kind}, got {largest:g}", name=name)
    return np.ascontiguousarray(array, dtype=dtype)


def numbers_between(
    name: str,
    value: object,
    low: float = -np.inf,
    high: float = np.inf,
    *,
    integer: bool = False,
    low_open: bool = False,
) -> NDArray[Any]:
    """Return `value` (scalar or array) as float64, or int64 when `integer`, within [low, high].

    With `low_open`, `low` itself is not allowed. True and False are no numbers.
    """
    if _has_truth_values(value):
        raise InputError("expected a number, got true or false", name=name, value=value)
    array = finite_array(name, value)
    wrong = (array <= low) if low_open else (array < low)
    wrong = wrong | (array > high)
    if np.any(wrong):
        bad = float(array[wrong].flat[0])
        raise InputError(f"expected {_range_text(low, high, low_open)}", name=name, value=bad)
    if integer:
        rounded: NDArray[np.generic] = np.rint(array)
        if np.any(rounded != array):
            bad = float(array[rounded != array].flat[0])
            raise InputError("expected a whole number", name=name, value=bad)
        return rounded.astype(np.int64)
    numbers: NDArray[np.generic] = array.astype(np.float64)
    return numbers


def _has_truth_values(value: object) -> bool:
    """Return whether a value, or an item of a sequence, is True or False."""
    if isinstance(value, np.ndarray):
        return bool(value.dtype == np.bool_)
    if isinstance(value, list | tuple):
        return any(map(_has_truth_values, value))
    return isinstance(value, bool | np.bool_)


def number_between(
    name: str,
    value: object,
    low: float = -np.inf,
    high: float = np.inf,
    *,
    integer: bool = False,
    low_open: bool = False,
) -> float:
    """Return one number within the range, like `numbers_between`; as float (exact for whole numbers)."""
    array = numbers_between(name, value, low, high, integer=integer, low_open=low_open)
    if array.ndim:
        raise InputError(f"expected one number, got an array of shape {array.shape}", name=name)
    return float(array)


def increasing(name: str, value: object, count: int, *, integer: bool = False) -> NDArray[Any]:
    """Return `count` increasing numbers, (count,), such as times or frame numbers; a column is one, too."""
    array = numbers_between(name, value, *(_WHOLE if integer else ()), integer=integer)
    is_column = array.size == count == max(array.shape, default=0)
    if not is_column or (np.diff(array.ravel()) <= 0).any():
        raise InputError(f"expected {count} increasing numbers, got shape {array.shape}", name=name)
    return array.ravel()


def one_of(name: str, value: object, choices: Sequence[str]) -> str:
    """Return `value` if it is one of the names in `choices`."""
    if not isinstance(value, str) or value not in choices:
        raise InputError(f"expected one of {', '.join(map(repr, choices))}", name=name, value=value)
    return value


def strings_of(name: str, value: object) -> tuple[str, ...]:
    """Return a sequence of texts as a tuple.

    Raises
    ------
    InputError
        If it is something else.
    """
    if (
        isinstance(value, str)
        or not isinstance(value, Sequence)
        or not all(isinstance(v, str) for v in value)
    ):
        raise InputError("expected a list of texts", name=name, value=value)
    return tuple(value)


def _range_text(low: float, high: float, low_open: bool) -> str:
    """Return a range in words: 'a number from 0 to 1', 'a number above 0'."""
    start = f"above {low:g}" if low_open else f"from {low:g}"
    if np.isinf(high):
        return f"a number above {low:g}" if low_open else f"a number of at least {low:g}"
    if np.isinf(low):
        return f"a number up to {high:g}"
    return f"a number {start} to {high:g}"


def spawn(rng: object, count: int) -> list[np.random.Generator]:
    """Return `count` independent generators spawned from `rng`.

    With separate generators, switching one source of randomness on or off does not change the draws of the
    others. Spawning does not advance the caller's stream, but a second call gives different children.

    Parameters
    ----------
    rng : numpy.random.Generator or None
        Parent generator; None uses fresh entropy from the operating system.
    count : int
        Number of generators.

    Returns
    -------
    list of numpy.random.Generator

    Raises
    ------
    InputError
        If `rng` is neither None nor a generator that can spawn.
    """
    if rng is None:
        rng = np.random.default_rng()
    if not isinstance(rng, np.random.Generator):
        raise InputError(f"rng: expected a numpy.random.Generator or None, got {type(rng).__name__}")
    try:
        return rng.spawn(count)
    except TypeError:
        raise InputError(
            "rng: expected a generator that can spawn, such as numpy.random.default_rng(seed)"
        ) from None
