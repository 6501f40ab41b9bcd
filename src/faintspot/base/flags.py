"""Quantities and flags known of every frame and sub-aperture, and the line that names slopes left out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError


class SubapertureFlag(IntFlag):
    """Bits of `Slopes.flags`: `INVALID` ones make a slope invalid, the others are information."""

    NO_FLUX = 1
    """No flux: nothing usable after the background subtraction, or not above zero with 99.9 % confidence.

    The slope is 0 (the reference position).
    """
    TOO_MANY_BAD_PIXELS = 2
    """Too many bad pixels for the settings; the slope is 0 (the reference position).

    Of the other flags, only SATURATED may be set then.
    """
    UNLIKE_NEIGHBOURS = 4
    """The slope differs from those of all neighbours, as if the spot were wrongly identified; invalid.

    Not set if the layout has no pitch.
    """
    SATURATED = 8
    """At least one pixel reached the saturation level."""
    INFEASIBLE_STRENGTH = 16
    """The strength exceeds 0.9 of the image's own rms, and was lowered to 0.6 of it."""
    NOT_CONVERGED = 32
    """The iteration limit was reached before the tolerance (not for a tolerance of 0). For other estimators,
    the last steps were still long: more steps would change the slope by several standard errors.
    """
    OUTLIER_LIKELY = 64
    """The spot is so faint that noise causes more than about 1 % of such slopes."""
    AT_SEARCH_LIMIT = 128
    """The slope reaches `search_range_px` along x or y, or the edge of the window cuts the spot; invalid.

    The spot may be outside.
    """


UNMEASURED = SubapertureFlag.NO_FLUX | SubapertureFlag.TOO_MANY_BAD_PIXELS
"""Flags of sub-apertures without a position: their slope is 0."""

KEEPABLE = {"limited": SubapertureFlag.AT_SEARCH_LIMIT, "unlike": SubapertureFlag.UNLIKE_NEIGHBOURS}
"""Flags of positions that are probably wrong, by the names under which they can be kept valid."""

NO_FLAG = SubapertureFlag(0)

INVALID = UNMEASURED | SubapertureFlag.AT_SEARCH_LIMIT | SubapertureFlag.UNLIKE_NEIGHBOURS
"""Flags that make a slope invalid, unless it is kept; without a flag of `UNMEASURED` it has its value."""


def kept_flags(names: Iterable[str]) -> SubapertureFlag:
    """Return the flags of some names of `KEEPABLE`.

    Raises
    ------
    InputError
        If a name is another one.
    """
    flags = NO_FLAG
    for name in names:
        if name not in KEEPABLE:
            raise InputError(
                f"keep = {name!r}: expected names from {', '.join(KEEPABLE)}, separated by commas"
            )
        flags |= KEEPABLE[name]
    return flags


_CAUSES = {"dark": SubapertureFlag.NO_FLUX, "bad pixels": SubapertureFlag.TOO_MANY_BAD_PIXELS, **KEEPABLE}


def are_valid(flags: NDArray[Any], keep: SubapertureFlag = NO_FLAG) -> NDArray[np.bool_]:
    """Return which slopes no flag of `INVALID` marks; those in `keep` do not count."""
    return (flags & int(INVALID & ~keep)) == 0  # type: ignore[no-any-return]


def leave_out(
    flags: NDArray[Any],
    keep: SubapertureFlag = NO_FLAG,
    others: Mapping[str, NDArray[np.bool_]] | None = None,
) -> tuple[NDArray[np.bool_], str]:
    """Return which slopes to use, and a line about the others; it is empty if there are none.

    Parameters
    ----------
    flags : (n,) or (n_frames, n) array of int
        Bits of `SubapertureFlag`.
    keep : SubapertureFlag
        Flags of `KEEPABLE` that do not make a slope invalid.
    others : dict of str to array of bool, optional
        Further causes, each with the slopes to leave out; arrays of a shape that broadcasts to that of
        `flags`.

    Returns
    -------
    array of bool, str

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.base.flags import leave_out
    >>> leave_out(np.array([[0, 1, 128], [0, 1, 0]], np.uint8))
    (array([[ True, False, False],
           [ True, False,  True]]), 'left out 1 of 3 sub-apertures, 1 slope of others: dark, limited')
    """
    causes = {word: (flags & int(flag & ~keep)) != 0 for word, flag in _CAUSES.items()}
    causes |= {word: np.broadcast_to(mask, flags.shape) for word, mask in (others or {}).items()}
    counts = {word: int(np.count_nonzero(mask)) for word, mask in causes.items()}
    invalid = np.logical_or.reduce(list(causes.values()))
    rows = invalid.reshape(-1, flags.shape[-1])
    never: NDArray[np.bool_] = np.logical_and.reduce(rows)
    single, parts = int(np.count_nonzero(rows[:, ~never])), []
    if never.any():
        parts.append(f"{np.count_nonzero(never)} of {len(never)} sub-apertures")
    if single:
        rest = "of others" if never.any() else f"of {rows.size}"
        parts.append(f"{single} {'slope' if single == 1 else 'slopes'} {rest}")
    if not parts:
        return ~invalid, ""
    words = [word for word in sorted(counts, key=lambda word: -counts[word]) if counts[word]]
    return ~invalid, f"left out {', '.join(parts)}: {', '.join(words)}"


@dataclass(frozen=True)
class Variable:
    """Definition of a quantity that has a value for every frame and sub-aperture."""

    dtype: str
    units: str
    long_name: str
    if_absent: float | None = None
    """Value used if it is not given."""


VARIABLES: Mapping[str, Variable] = {
    "x": Variable("float32", "px", "spot position along columns, from the sub-aperture's centre"),
    "y": Variable("float32", "px", "spot position along rows, from the sub-aperture's centre"),
    "flux": Variable("float32", "e-", "flux left after background subtraction"),
    "valid": Variable("bool", "1", "position was measured and is not doubtful"),
    "flags": Variable("uint8", "1", "how a position came about, as bits: see faintspot.SubapertureFlag"),
    "iterations": Variable("int32", "1", "iterations of the denoiser"),
    "bad_pixels": Variable("int32", "1", "pixels that were replaced"),
    "standard_error_x": Variable("float32", "px", "standard error of x, infinite where not known", np.inf),
    "standard_error_y": Variable("float32", "px", "standard error of y, infinite where not known", np.inf),
    "covariance_xy": Variable(
        "float32", "px^2", "covariance of the errors of x and y, 0 where not known", 0.0
    ),
}


def scaled_positions(variables: Mapping[str, NDArray[Any]], factor: float) -> dict[str, NDArray[np.generic]]:
    """Return variables with positions and their errors converted to pixels of another size."""
    factors = {"px": np.float32(factor), "px^2": np.float32(factor**2)}
    return {
        name: values * factors[VARIABLES[name].units]
        if factor != 1 and VARIABLES[name].units in factors
        else values
        for name, values in variables.items()
    }
