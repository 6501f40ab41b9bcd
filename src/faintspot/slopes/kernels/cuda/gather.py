"""A sub-aperture's pixels out of a frame: calibration, bad pixels, smoothing.

What looks at neighbours here does so in shared memory, `tile` of (ny, nx): it happens once per image, or only
where a pixel is bad.
"""

from __future__ import annotations

import math
from typing import Any

from numba import float32, uint32

from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.slopes.kernels.cuda import warp
from faintspot.slopes.kernels.cuda.compiling import device
from faintspot.slopes.kernels.cuda.strips import WARP, Strips

warp_total, synchronise = warp.total, warp.synchronise


def make_gather(strips: Strips) -> Any:
    """Return the function that reads a thread's pixels and turns them into electrons, NaN where bad."""
    rows = strips.rows

    @device
    def gather(
        frame: Any, dark: Any, scale: Any, line: Any, place: Any, present: Any, saturation: Any, image: Any
    ) -> Any:
        """Return the number of bad and of saturated pixels.

        `frame` and maps are flat, `line` pixels a row; `place` is that of the thread's first pixel.
        """
        bad, saturated = float32(0.0), float32(0.0)
        for r in range(rows):
            image[r] = float32(0.0)
            if r < present:
                at = uint32(place + r * line)  # unsigned: Numba then does not ask if it counts from the end
                raw = float32(frame[at])
                value = (raw - dark[at]) * scale[at]
                good = abs(value) <= float32(LARGEST_FLOAT32)
                image[r] = value if good else float32(math.nan)
                bad += float32(0.0) if good else float32(1.0)
                saturated += float32(1.0) if raw >= saturation else float32(0.0)
        return warp_total(bad), warp_total(saturated)

    return gather


def make_share(strips: Strips) -> Any:
    """Return the function that puts an image into shared memory for all threads to see."""
    rows = strips.rows

    @device
    def share(image: Any, top: Any, column: Any, present: Any, tile: Any) -> None:
        """`top`, `column`: in the window, of the thread's first pixel."""
        synchronise()
        for r in range(rows):
            if r < present:
                tile[uint32(top + r), uint32(column)] = image[r]
        synchronise()

    return share


def make_recall(strips: Strips) -> Any:
    """Return the function that takes a thread's pixels out of shared memory again."""
    rows = strips.rows

    @device
    def recall(tile: Any, top: Any, column: Any, present: Any, image: Any) -> None:
        for r in range(rows):
            image[r] = tile[uint32(top + r), uint32(column)] if r < present else float32(0.0)

    return recall


def make_fill(strips: Strips) -> Any:
    """Return the function that gives every NaN the mean of its good neighbours, else of all, else 0."""
    ny, nx = strips.ny, strips.nx
    pixels = ny * nx

    @device
    def fill(tile: Any, lane: Any, filled: Any) -> None:
        total, good = float32(0.0), float32(0.0)
        for i in range(lane, pixels, WARP):
            value = tile[i // nx, i % nx]
            if value == value:
                total += value
                good += float32(1.0)
        total, good = warp_total(total), warp_total(good)
        mean = total / good if good > float32(0.0) else float32(0.0)
        for i in range(lane, pixels, WARP):
            y, x = i // nx, i % nx
            value = tile[y, x]
            if value != value:
                near, count = float32(0.0), float32(0.0)
                for k in range(max(y - 1, 0), min(y + 2, ny)):
                    for j in range(max(x - 1, 0), min(x + 2, nx)):
                        neighbour = tile[k, j]
                        if neighbour == neighbour:
                            near += neighbour
                            count += float32(1.0)
                value = near / count if count > float32(0.0) else mean
            filled[y, x] = value
        synchronise()

    return fill


def make_smooth(strips: Strips) -> Any:
    """Return the function that smooths an image with the sub-aperture's taps, along x, then along y."""
    ny, nx = strips.ny, strips.nx
    pixels = ny * nx

    @device
    def smooth_along(source: Any, taps: Any, lane: Any, down: Any, right: Any, result: Any) -> None:
        """`down`, `right`: 1 along this axis, else 0; `taps`: (1 + reach,), the central one first."""
        for i in range(lane, pixels, WARP):
            y, x = i // nx, i % nx
            value = source[y, x] * taps[0]
            for k in range(1, taps.shape[0]):
                both = float32(0.0)
                if y >= k * down and x >= k * right:
                    both += source[y - k * down, x - k * right]
                if y + k * down < ny and x + k * right < nx:
                    both += source[y + k * down, x + k * right]
                value += both * taps[k]
            result[y, x] = value
        synchronise()

    @device
    def smooth(tile: Any, taps: Any, lane: Any, scratch: Any, result: Any) -> None:
        """`tile`, `scratch` and `result` are (ny, nx); `taps` (2, 1 + reach) along x and y."""
        smooth_along(tile, taps[0], lane, 0, 1, scratch)
        smooth_along(scratch, taps[1], lane, 1, 0, result)

    return smooth
