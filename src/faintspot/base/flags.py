"""Flags that describe the state of a sub-aperture's slope: one bit each."""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntFlag

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

KEEPABLE = {
    "limited": SubapertureFlag.AT_SEARCH_LIMIT,
    "unlike": SubapertureFlag.UNLIKE_NEIGHBOURS,
}
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
