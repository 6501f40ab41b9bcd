"""Why a sub-aperture's slope is what it is: one bit a reason."""

from __future__ import annotations

from enum import IntFlag


class SubapertureFlag(IntFlag):
    """Bits of `Slopes.flags`. The first two make a slope invalid; the others only inform."""

    NO_FLUX = 1
    """Nothing usable is left after the background subtraction; the slope is that of the reference (0)."""
    TOO_MANY_BAD_PIXELS = 2
    """More bad pixels than the settings allow; the slope is that of the reference (0).

    No further reason is given then."""
    UNLIKE_NEIGHBOURS = 4
    """The slope is far from those of all neighbours, as that of a wrong spot; other slopes are not.

    Not where the layout has no pitch."""
    SATURATED = 8
    """At least one pixel reached the saturation level."""
    INFEASIBLE_STRENGTH = 16
    """The strength is too strong for the image, above 0.9 of its own rms: lowered to 0.6 of that."""
    NOT_CONVERGED = 32
    """The iteration limit came before the tolerance was reached (not where that is 0), or the last steps
    of an estimator were still long: more of them would move the slope by several standard errors."""
    OUTLIER_LIKELY = 64
    """The spot is so faint that more than about 1 % of such slopes are those of noise, not of the spot."""
    AT_SEARCH_LIMIT = 128
    """The slope ends at `search_range_px`, along x or y, or the window's edge cuts the spot.

    The spot may be beyond."""


INVALID = SubapertureFlag.NO_FLUX | SubapertureFlag.TOO_MANY_BAD_PIXELS
