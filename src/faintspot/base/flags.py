"""Flags that describe the state of a sub-aperture's slope: one bit each."""

from __future__ import annotations

from enum import IntFlag


class SubapertureFlag(IntFlag):
    """Bits of `Slopes.flags`. The first two make a slope invalid; the others are information."""

    NO_FLUX = 1
    """No usable flux after the background subtraction; the slope is 0 (the reference position)."""
    TOO_MANY_BAD_PIXELS = 2
    """Too many bad pixels for the settings; the slope is 0 (the reference position).

    Of the other flags, only SATURATED may be set then.
    """
    UNLIKE_NEIGHBOURS = 4
    """The slope differs from those of all neighbours, as if the spot were wrongly identified.

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
    """The slope reaches `search_range_px` along x or y, or the edge of the window cuts the spot.

    The spot may be outside.
    """


INVALID = SubapertureFlag.NO_FLUX | SubapertureFlag.TOO_MANY_BAD_PIXELS
