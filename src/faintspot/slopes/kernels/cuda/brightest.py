"""Brightest-pixel background subtraction and centre of gravity of one sub-aperture by a warp.

The algorithms are those of `faintspot.slopes.kernels.gravity.brightest`, which says how and why.
"""

from __future__ import annotations

import math
from typing import Any

from numba import float32, int32

from faintspot.slopes.kernels.cuda import warp
from faintspot.slopes.kernels.cuda.compiling import device
from faintspot.slopes.kernels.cuda.strips import Strips

warp_total, largest, smallest = warp.total, warp.largest, warp.smallest

COUNTING_PASSES = 24  # usually 6 to 10 are enough; ties and outliers go on to the exact passes


@device
def pivot_between(low: Any, high: Any, wanted: Any) -> Any:
    """The wanted number if it is in [low, high), for low < high; else one in their middle."""
    if low <= wanted and wanted < high:
        return wanted
    middle = max(float32(0.5) * low + float32(0.5) * high, low)
    return middle if middle < high else low


def make_extremes(strips: Strips) -> Any:
    """Return the function that finds the smallest and largest pixel and the sum of all."""
    rows = strips.rows

    @device
    def extremes(image: Any, present: Any) -> Any:
        low, high, total = float32(math.inf), float32(-math.inf), float32(0.0)
        for r in range(rows):
            if r < present:
                low, high = min(low, image[r]), max(high, image[r])
                total += image[r]
        return smallest(low), largest(high), warp_total(total)

    return extremes


def make_exact_step(strips: Strips) -> Any:
    """Return the function that narrows the bracket of the rank-th largest pixel to pixel values."""
    rows = strips.rows

    @device
    def step_exactly(image: Any, present: Any, rank: Any, low: Any, high: Any, pivot: Any) -> Any:
        count, next_above, next_below = float32(0.0), high, low
        for r in range(rows):
            if r < present:
                if image[r] > pivot:
                    count += float32(1.0)
                    next_above = min(next_above, image[r])
                else:
                    next_below = max(next_below, image[r])
        count, next_above, next_below = warp_total(count), smallest(next_above), largest(next_below)
        # With exactly `rank` pixels above, the smallest of them is it; with one less, the largest below.
        if count >= rank:
            return next_above, high if count > rank else next_above
        return next_below if count >= rank - float32(1.0) else low, next_below

    return step_exactly


def make_threshold(strips: Strips) -> Any:
    """Return the function that finds the rank-th largest pixel, exactly."""
    rows, pixels = strips.rows, strips.ny * strips.nx
    step_exactly = make_exact_step(strips)

    @device
    def find_threshold(image: Any, present: Any, rank: Any, low: Any, high: Any, low_sum: Any) -> Any:
        """`low`, `high` and `low_sum`: smallest and largest pixel and the sum of all."""
        low_count, high_count, high_sum = float32(pixels), float32(0.0), float32(0.0)
        pivot = low
        narrowed = low < high
        passes = int32(0)
        while narrowed and passes < COUNTING_PASSES:
            passes += int32(1)
            between = max(low_count - high_count, float32(1.0))
            pivot = pivot_between(low, high, (low_sum - high_sum) / between)
            count, total = float32(0.0), float32(0.0)
            for r in range(rows):
                if r < present and image[r] > pivot:
                    count += float32(1.0)
                    total += image[r]
            count, total = warp_total(count), warp_total(total)
            narrowed = False
            if count > rank:
                narrowed = pivot > low
                low, low_count, low_sum = pivot, count, total
            elif count < rank - float32(1.0):
                narrowed = pivot < high
                high, high_count, high_sum = pivot, count, total
        while low < high:
            low, high = step_exactly(image, present, rank, low, high, pivot_between(low, high, pivot))
        return low

    return find_threshold


def make_subtract(strips: Strips) -> Any:
    """Return the function that zeroes the pixels below the threshold and takes `offset` off the others."""
    rows = strips.rows

    @device
    def subtract(image: Any, present: Any, threshold: Any, offset: Any) -> None:
        for r in range(rows):
            image[r] = image[r] - offset if r < present and image[r] >= threshold else float32(0.0)

    return subtract


def make_centroid(strips: Strips) -> Any:
    """Return the function that sums an image and finds its centre of gravity; (0, 0) without flux."""
    rows = strips.rows

    @device
    def centroid(image: Any, away_x: Any, away_y: Any) -> Any:
        """`away_x` and `away_y`: of the thread's first pixel from the window's centre, px."""
        total, moment_y = float32(0.0), float32(0.0)
        for r in range(rows):
            total += image[r]
            moment_y += image[r] * (away_y + float32(r))
        moment_x = warp_total(total * away_x)
        total, moment_y = warp_total(total), warp_total(moment_y)
        inverse = float32(1.0) / total if total > float32(0.0) else float32(0.0)
        return total, moment_x * inverse, moment_y * inverse

    return centroid


def make_standard_errors(strips: Strips) -> Any:
    """Return the function that propagates the noise of the pixels left, VARIANCE + EXCESS max(g, 0)."""
    rows = strips.rows

    @device
    def standard_errors(
        image: Any, left: Any, from_x: Any, from_y: Any, variance: Any, excess: Any, total: Any
    ) -> Any:
        """Return standard errors of x and y, and their correlation.

        `from_x` and `from_y`: of the thread's first pixel from the centre of gravity, px.
        """
        within = float32(1.0 / 12.0)  # of the flux in a pixel, where in it is not known: px^2
        noise, noise_y, first_y = float32(0.0), float32(0.0), float32(0.0)
        for r in range(rows):
            if left[r] != float32(0.0):
                pixel = max(image[r], float32(0.0)) * excess + variance
                away = from_y + float32(r)
                noise += pixel
                noise_y += pixel * (away * away + within)
                first_y += pixel * away
        noise_x = warp_total(noise * (from_x * from_x + within))
        noise_y = warp_total(noise_y)
        noise_xy = warp_total(first_y * from_x)
        inverse = float32(1.0) / total if total > float32(0.0) else float32(1.0)
        root_x, root_y = math.sqrt(noise_x), math.sqrt(noise_y)
        both = root_x * root_y
        return root_x * inverse, root_y * inverse, noise_xy / both if both > float32(0.0) else float32(0.0)

    return standard_errors
