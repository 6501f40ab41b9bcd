"""Dark sub-apertures: windows whose flux is not above zero, judged from pixels alone, for any estimator.

The flux of a window is the largest sum over a box of pixels above the window's border. It is compared with
the noise that the borders of windows show in the same frame, so that neither gain nor dark level is needed.
"""

import math
from typing import NamedTuple

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.base.flags import UNMEASURED, SubapertureFlag
from faintspot.slopes.kernels.compiling import compiled, inlined
from faintspot.slopes.kernels.gather import Frames, pixels_of
from faintspot.slopes.kernels.groups import SlopeArrays
from faintspot.slopes.kernels.simd import (
    Lanes,
    Vector,
    absolute,
    get,
    load,
    maximum,
    select,
    splat,
    store,
    sum_of,
    width_of,
)

_UNMEASURED = int(UNMEASURED)
_NO_FLUX = int(SubapertureFlag.NO_FLUX)
_AT_SEARCH_LIMIT = int(SubapertureFlag.AT_SEARCH_LIMIT)

SAMPLED = 32
"""Largest number of sub-apertures from which the typical flux of a frame is taken."""
GAUGES = 3
"""Sub-apertures of that flux whose significance shows whether the frame is bright."""
NOISE_WINDOWS = 16
"""Windows that show the noise of the pixels."""
BRIGHT = 50.0
"""Significance of typical spots from which a single frame decides: a tenth of their flux still shows."""
BRIGHT_E = 100.0
"""Least flux in the box of typical spots [electrons]: photon noise alone never leaves one dark."""
SUSPECT = 0.5
"""Flux over the typical one below which the pixels of a window are looked at."""
MOST_LANES = 8
"""Largest number of pixels at once: windows are rarely wider, and code is compiled for each number."""
_ABSOLUTE_TO_STD = 0.5 * math.sqrt(math.pi)  # of the mean absolute difference of two pixels


class LightTest(NamedTuple):
    """Windows of a sensor, and the limit that makes them dark."""

    lanes: Lanes
    """Lanes: pixels of a row, at most as many as a window has."""
    last: Array
    """(W,) float32: 1 in the pixels of the last vector of a row that the one before does not hold, else 0."""
    maps: Array
    """(2, h, w) float32: dark in ADU, and electrons per ADU (NaN in bad pixels), of each pixel of a frame."""
    corners: Array
    """(n, 2) int64: row and column of every window's first pixel."""
    window: tuple[int, int]
    """Its height and width, (ny, nx)."""
    box: int
    """Side of the box, px; 0: no test."""
    limit: np.float32
    """Significance that a dark window exceeds once in a thousand times."""
    unit: np.float32
    """Standard deviation of a box above the border, in units of a pixel's."""
    dark: Array
    """Numbers of the sub-apertures that are known to be dark in all frames, int64."""


@compiled
def flag_dark(test: LightTest, frames: Frames, slopes: SlopeArrays, scratch: Array) -> None:
    """Flag dark sub-apertures NO_FLUX: known ones, and those that bright frames show; slopes become 0.

    A frame is bright if its typical spots are so significant that a much fainter one would be seen.

    Parameters
    ----------
    test : LightTest
    frames : Frames
    slopes : SlopeArrays
    scratch : float32 array
        At least `scratch_size` numbers.
    """
    n = slopes.x.shape[1]
    for f in range(slopes.x.shape[0]):
        for i in range(test.dark.shape[0]):
            _make_dark(f, test.dark[i], slopes)
        if test.box == 0:
            continue
        typical = _typical_flux(slopes.flux[f], slopes.flags[f], scratch)
        least = np.float32(SUSPECT) * typical
        suspects = 0
        for s in range(n):
            suspects += slopes.flux[f, s] < least
        if suspects == 0 or not typical > 0.0:
            continue
        noise = frame_noise(test, frames, f, min(n, NOISE_WINDOWS), slopes.flags[f], scratch)
        if not (noise > 0.0 and _is_bright(test, frames, f, noise, scratch)):
            continue
        for s in range(n):
            if not slopes.flux[f, s] < least or slopes.flags[f, s] & _UNMEASURED:
                continue
            if peak_above_border(test, frames, f, s, scratch) < test.limit * test.unit * noise:
                _make_dark(f, s, slopes)


def scratch_size(ny: int, nx: int) -> int:
    """Return the number of float32 numbers that `flag_dark` and `significances` need."""
    return 2 * SAMPLED + 2 * ny * nx + 4 * MOST_LANES + ny


@compiled
def _typical_flux(flux: Array, flags: Array, scratch: Array) -> np.float32:
    """Return the flux that about a tenth of the sub-apertures exceed; their numbers begin `scratch`.

    It is that of `GAUGES` of at most `SAMPLED` sub-apertures, evenly spread; -1 without any.
    """
    n = flux.shape[0]
    sampled = min(n, SAMPLED)
    first = sampled // 16
    kept, most, least = 0, min(first + GAUGES, sampled), np.float32(0.0)
    step, rest = n // sampled, n % sampled
    s = part = 0
    for _ in range(sampled):
        here = flux[s]
        if here > least and not flags[s] & _UNMEASURED:
            kept = min(kept + 1, most)
            place = kept - 1
            while place > 0 and here > scratch[SAMPLED + place - 1]:
                scratch[place], scratch[SAMPLED + place] = scratch[place - 1], scratch[SAMPLED + place - 1]
                place -= 1
            scratch[place], scratch[SAMPLED + place] = s, here
            if kept == most:
                least = scratch[SAMPLED + most - 1]
        s, part = s + step, part + rest  # s is i * n // sampled
        if part >= sampled:
            s, part = s + 1, part - sampled
    if kept <= first:
        return np.float32(-1.0)
    for i in range(kept - first):
        scratch[i] = scratch[first + i]
    for i in range(kept - first, GAUGES):
        scratch[i] = -1.0
    return flux[int(scratch[(kept - first) // 2])]


@compiled
def _is_bright(test: LightTest, frames: Frames, f: int, noise: float, scratch: Array) -> bool:
    """Return whether most of the typical spots, whose numbers begin `scratch`, are bright."""
    bright = total = 0
    for i in range(GAUGES):
        if scratch[i] >= 0.0:
            peak = peak_above_border(test, frames, f, int(scratch[i]), scratch)
            bright += peak >= max(BRIGHT * test.unit * noise, BRIGHT_E)
            total += 1
    return 2 * bright > total


@compiled
def _make_dark(f: int, s: int, slopes: SlopeArrays) -> None:
    """Flag a sub-aperture NO_FLUX, with the results of an unmeasured one, unless it is one."""
    if slopes.flags[f, s] & _UNMEASURED:
        return
    slopes.x[f, s] = slopes.y[f, s] = slopes.covariance_xy[f, s] = 0.0
    slopes.standard_error_x[f, s] = slopes.standard_error_y[f, s] = math.inf
    slopes.flags[f, s] = (slopes.flags[f, s] & ~_AT_SEARCH_LIMIT) | _NO_FLUX


@compiled
def significances(test: LightTest, frames: Frames, found: Array, scratch: Array) -> None:
    """Write the significance of the flux of each window of a frame (1, h, w), infinite without noise: (n,).

    `scratch` has `scratch_size` numbers or more.
    """
    n = found.shape[0]
    noise = test.unit * frame_noise(test, frames, 0, min(n, SAMPLED), found[:0], scratch)
    for s in range(n):
        found[s] = peak_above_border(test, frames, 0, s, scratch) / noise if noise > 0.0 else math.inf


@compiled
def add_windows(test: LightTest, frames: Frames, start: int, stop: int, weight: float, mean: Array) -> None:
    """Add windows [start, stop) of a frame (1, h, w) to their running means, (n * ny, nx) float32 [ADU].

    Parameters
    ----------
    weight : float
        Of the frame in the mean; pixels that are not finite do not count.
    """
    lanes, (ny, nx), line = test.lanes, test.window, frames.counts.shape[2]
    width = width_of(lanes)
    limit, zero = splat(lanes, LARGEST_FLOAT32), splat(lanes, 0.0)
    for s in range(start, stop):
        for y in range(ny):
            for x in range(0, nx, width):
                part = splat(lanes, weight)
                if x + width > nx:  # a whole vector once more, of which the last pixels count
                    x, part = nx - width, part * load(lanes, test.last, 0)
                at = (s * ny + y) * nx + x
                before = load(lanes, mean, at)
                raw = pixels_of(lanes, frames, (test.corners[s, 0] + y) * line + test.corners[s, 1] + x)
                store(mean, at, before + select(absolute(raw) <= limit, (raw - before) * part, zero))


@compiled
def frame_noise(
    test: LightTest, frames: Frames, f: int, windows: int, flags: Array, scratch: Array
) -> np.float32:
    """Return the noise of a pixel, from differences of pixels along the borders of some windows.

    It is the median over windows, evenly spread, of which each has the mean absolute difference of its first
    and second rows of pixels, and of its last two. Those that `flags` (n or 0,) call unmeasured are left out.
    `scratch` is used from element `SAMPLED`.
    """
    n, known = test.corners.shape[0], 0
    for i in range(windows):
        s = (2 * i + 1) * n // (2 * windows)
        if flags.shape[0] > 0 and int(flags[s]) & _UNMEASURED:
            continue
        difference = _border_difference(test, frames, f, s)
        if difference >= 0.0:
            place = SAMPLED + known
            while place > SAMPLED and scratch[place - 1] > difference:
                scratch[place] = scratch[place - 1]
                place -= 1
            scratch[place] = difference
            known += 1
    if known == 0:
        return np.float32(0.0)
    median = np.float32(0.5) * (scratch[SAMPLED + (known - 1) // 2] + scratch[SAMPLED + known // 2])
    return np.float32(_ABSOLUTE_TO_STD) * median


@compiled
def _border_difference(test: LightTest, frames: Frames, f: int, s: int) -> np.float32:
    """Return the mean absolute difference of a window's two first and two last rows; -1 without any."""
    lanes, row, column = test.lanes, test.corners[s, 0], test.corners[s, 1]
    width, (ny, nx) = width_of(lanes), test.window
    zero, limit = splat(lanes, 0.0), splat(lanes, LARGEST_FLOAT32)
    total = count = zero
    for end in range(2):
        y = row + end * (ny - 2)
        for x in range(0, nx, width):
            once = splat(lanes, 1.0)
            if x + width > nx:  # a whole vector once more, of which the last pixels count
                x, once = nx - width, load(lanes, test.last, 0)
            here = _calibrated(test, frames, f, y, column + x)
            difference = absolute(here - _calibrated(test, frames, f, y + 1, column + x))
            good = difference <= limit
            total = total + select(good, difference * once, zero)
            count = count + select(good, once, zero)
    pixels = sum_of(count)
    return sum_of(total) / pixels if pixels > 0.0 else np.float32(-1.0)


@inlined
def _calibrated(test: LightTest, frames: Frames, f: int, y: int, x: int) -> Vector:
    """Return the calibrated pixels of a row of a frame from x on; NaN or infinite if bad."""
    height, line = frames.counts.shape[1:]
    at = y * line + x
    raw = pixels_of(test.lanes, frames, f * height * line + at)
    dark, scale = load(test.lanes, test.maps, at), load(test.lanes, test.maps, height * line + at)
    return (raw - dark) * scale


@compiled
def peak_above_border(test: LightTest, frames: Frames, f: int, s: int, scratch: Array) -> np.float32:
    """Return the largest sum of a window's pixels in a box, above the median of its four sides' means.

    Bad pixels count as the background; infinite without a good pixel on every side. `scratch` is used behind
    its first 2 * `SAMPLED` elements.
    """
    lanes, (ny, nx), box = test.lanes, test.window, test.box
    width = width_of(lanes)
    image = 2 * SAMPLED
    sums = image + ny * nx + width + box
    for y in range(ny):
        for x in range(0, nx, width):
            x = min(x, nx - width)
            value = _calibrated(test, frames, f, test.corners[s, 0] + y, test.corners[s, 1] + x)
            store(scratch, image + y * nx + x, value)
    level = _border_level(ny, nx, scratch, image)
    if not abs(level) <= LARGEST_FLOAT32:
        return np.float32(math.inf)
    background, zero, limit = splat(lanes, level), splat(lanes, 0.0), splat(lanes, LARGEST_FLOAT32)
    for i in range(0, ny * nx, width):  # the last vector may reach beyond the window
        value = load(lanes, scratch, image + i)
        store(scratch, image + i, select(absolute(value) <= limit, value - background, zero))
    last = nx - box + 1
    for y in range(ny):
        for x in range(0, last, width):
            total = load(lanes, scratch, image + y * nx + x)
            for i in range(1, box):
                total = total + load(lanes, scratch, image + y * nx + x + i)
            store(scratch, sums + y * nx + x, total)
    peak = np.float32(-math.inf)
    for x in range(0, last, width):
        best = splat(lanes, -math.inf)
        for y in range(ny - box + 1):
            total = load(lanes, scratch, sums + y * nx + x)
            for i in range(1, box):
                total = total + load(lanes, scratch, sums + (y + i) * nx + x)
            best = maximum(total, best)
        store(scratch, image, best)
        for i in range(min(width, last - x)):
            peak = max(peak, get(scratch, image + i))
    return peak


@compiled
def _border_level(ny: int, nx: int, image: Array, at: int) -> np.float32:
    """Return the median of the means of the four sides of an image; NaN if one has no good pixel."""
    top, bottom = _side_mean(image, at, 1, nx), _side_mean(image, at + (ny - 1) * nx, 1, nx)
    left, right = _side_mean(image, at, nx, ny), _side_mean(image, at + nx - 1, nx, ny)
    low = min(min(top, bottom), min(left, right))
    high = max(max(top, bottom), max(left, right))
    return np.float32(0.5) * (((top + bottom) + (left + right)) - (low + high))


@inlined
def _side_mean(image: Array, at: int, step: int, length: int) -> np.float32:
    """Return the mean of the good pixels of one side of an image; NaN without any."""
    total, count = np.float32(0.0), np.float32(0.0)
    for i in range(length):
        value = get(image, at + i * step)
        if abs(value) <= LARGEST_FLOAT32:
            total += value
            count += np.float32(1.0)
    return total / count
