"""Between frames or stacks of images and groups of W sub-apertures with all lanes of a pixel side by side."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Array
from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.slopes.kernels.compiling import compiled, inlined
from faintspot.slopes.kernels.simd import (
    Lanes,
    Vector,
    absolute,
    copy_transposed,
    get,
    load,
    put,
    select,
    splat,
    store,
    widened,
    width_of,
)


class Frames(NamedTuple):
    """Frames (n, h, w) of either type that kernels read: the other array has none.

    Kernels choose between the two as they run: for each type one more compilation would take seconds.
    """

    counts: Array
    """uint16."""
    values: Array
    """float32."""
    are_counts: bool

    @classmethod
    def of(cls, array: NDArray[np.generic]) -> "Frames":
        """Return contiguous frames, uint16 or float32, of which nothing is copied."""
        none = (0, *array.shape[1:])
        if array.dtype == np.uint16:
            return cls(array, np.empty(none, np.float32), True)
        return cls(np.empty(none, np.uint16), array, False)

    @property
    def array(self) -> NDArray[Any]:
        """The array that has the frames."""
        frames: NDArray[Any] = self.counts if self.are_counts else self.values
        return frames


@inlined
def pixels_of(lanes: Lanes, frames: Frames, offset: int) -> Vector:
    """Return W consecutive pixels of frames, as numbers of the lanes' type."""
    if frames.are_counts:
        return widened(lanes, frames.counts, offset)
    return widened(lanes, frames.values, offset)


@compiled
def gather_raw(
    lanes: Lanes, frames: Frames, frame: int, corners: Array, ny: int, nx: int, block: Array, image: Array
) -> None:
    """Copy W sub-apertures of a frame into the lanes, as they are.

    Parameters
    ----------
    frames : Frames
    frame : int
    corners : (W,) int64
        Flat offset of each sub-aperture's first pixel in its frame.
    block : array
        Scratch; with W * W numbers, windows whose width W does not divide are gathered faster.
    image : (ny * nx * W,) array
        Written.
    """
    if frames.are_counts:
        _gather(lanes, frames.counts, frame, corners, ny, nx, block, image)
    else:
        _gather(lanes, frames.values, frame, corners, ny, nx, block, image)


@compiled
def _gather(
    lanes: Lanes, frames: Array, frame: int, corners: Array, ny: int, nx: int, block: Array, image: Array
) -> None:
    """See `gather_raw`; of frames of one type."""
    width = width_of(lanes)
    height, line = frames.shape[1:]
    whole, last = nx - nx % width, 0
    for lane in range(width):
        last = max(last, get(corners, lane))
    for y in range(ny):
        start, to = (frame * height + y) * line, y * nx * width
        for x in range(0, whole, width):
            copy_transposed(lanes, frames, corners, start + x, image, to + x * width)
        if whole < nx and last + start + whole + width <= frames.size and block.size >= width * width:
            # More columns than the window still has, of which only those are used.
            copy_transposed(lanes, frames, corners, start + whole, block, 0)
            for x in range(whole, nx):
                store(image, to + x * width, load(lanes, block, (x - whole) * width))
        else:
            for x in range(whole, nx):
                for lane in range(width):
                    put(image, to + x * width + lane, get(frames, get(corners, lane) + start + x))


@compiled
def calibrate(
    lanes: Lanes,
    image: Array,
    pixels: int,
    calibration: Array,
    place: int,
    saturation: float,
    lane_values: Array,
) -> None:
    """Turn a group's raw images into electrons, in place: (raw - dark) * scale.

    What is not finite or absurdly large becomes NaN; a bad pixel has scale NaN.

    Parameters
    ----------
    calibration : array
        From element `place`: dark and scale of every pixel, W numbers each.
    saturation : float
    lane_values : (2 * W,) array
        Number of bad and of saturated pixels in every lane; written.
    """
    width = width_of(lanes)
    limit, level = splat(lanes, LARGEST_FLOAT32), splat(lanes, saturation)
    zero, one, nan = splat(lanes, 0.0), splat(lanes, 1.0), splat(lanes, math.nan)
    bad = saturated = zero
    for i in range(pixels):
        raw = load(lanes, image, i * width)
        dark = load(lanes, calibration, place + 2 * i * width)
        scale = load(lanes, calibration, place + (2 * i + 1) * width)
        value = (raw - dark) * scale
        good = absolute(value) <= limit
        bad = bad + select(good, zero, one)
        saturated = saturated + select(raw >= level, one, zero)
        store(image, i * width, select(good, value, nan))
    store(lane_values, 0, bad)
    store(lane_values, width, saturated)


@compiled
def fill_bad_pixels(width: int, lane: int, ny: int, nx: int, image: Array, original: Array) -> None:
    """Give every NaN of a lane the mean of its good neighbours (up to 8), else of all good pixels, else 0.

    `original` is scratch for ny * nx numbers.
    """
    total, good = 0.0, 0
    for i in range(ny * nx):
        value = image[i * width + lane]
        original[i] = value
        if value == value:
            total += value
            good += 1
    mean = total / good if good > 0 else 0.0
    for y in range(ny):
        for x in range(nx):
            if original[y * nx + x] == original[y * nx + x]:
                continue
            near, count = 0.0, 0
            for j in range(max(y - 1, 0), min(y + 2, ny)):
                for i in range(max(x - 1, 0), min(x + 2, nx)):
                    value = original[j * nx + i]
                    if value == value:
                        near += value
                        count += 1
            image[(y * nx + x) * width + lane] = near / count if count > 0 else mean


@compiled
def gather_images(width: int, images: Array, first: int, image: Array) -> None:
    """Copy W images of a stack (n, pixels) into the lanes; the last one fills those that are left."""
    n, pixels = images.shape
    for lane in range(width):
        start = min(first + lane, n - 1) * pixels
        for i in range(pixels):
            put(image, i * width + lane, get(images, start + i))


@compiled
def scatter_images(width: int, image: Array, first: int, images: Array) -> None:
    """Copy the lanes into a stack (n, pixels), as far as it has images."""
    n, pixels = images.shape
    for lane in range(min(width, n - first)):
        start = (first + lane) * pixels
        for i in range(pixels):
            put(images, start + i, get(image, i * width + lane))
