"""Between frames or stacks of images and groups of W sub-apertures with all lanes of a pixel side by side."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from faintspot.checks import LARGEST_FLOAT32
from faintspot.kernels.compiling import compiled
from faintspot.kernels.simd import get, put


@compiled
def gather_calibrated(
    width: Any,
    frames: Any,
    frame_start: Any,
    calibration: Any,
    frame_pixels: Any,
    line: Any,
    corners: Any,
    saturation: Any,
    ny: Any,
    nx: Any,
    image: Any,
    tile: Any,
    counts: Any,
) -> None:
    """Copy W sub-apertures of a frame into the lanes, in electrons.

    (raw - dark) * scale; a bad pixel has scale NaN. What is not finite or absurdly large becomes NaN.

    Parameters
    ----------
    frame_start, line, corners : int, int, (W,) int64
        Flat offsets: of the frame in `frames`, of one row from the next, of each sub-aperture in the frame.
    calibration, frame_pixels : (2, h, w) array, int
        Dark and scale, and the number of pixels of each.
    saturation : float
    image : (ny * nx * W,) array
        Written.
    tile : array
        Scratch for nx * W numbers: one row of every sub-aperture, so that the frame is read and the image
        written in order.
    counts : (2 * W,) int64
        Bad and saturated pixels of every lane; written.
    """
    limit, level, nan = np.float32(LARGEST_FLOAT32), np.float32(saturation), np.float32(math.nan)
    for lane in range(2 * width):
        counts[lane] = 0
    for y in range(ny):
        for lane in range(width):
            start = get(corners, lane) + y * line
            bad, saturated = 0, 0
            for x in range(nx):
                raw = np.float32(get(frames, frame_start + start + x))
                dark, scale = get(calibration, start + x), get(calibration, frame_pixels + start + x)
                value = (raw - dark) * scale
                good = abs(value) <= limit
                bad += 0 if good else 1
                saturated += 1 if raw >= level else 0
                put(tile, lane * nx + x, value if good else nan)
            counts[lane] += bad
            counts[width + lane] += saturated
        for x in range(nx):
            for lane in range(width):
                put(image, (y * nx + x) * width + lane, get(tile, lane * nx + x))


@compiled
def fill_bad_pixels(width: Any, lane: Any, ny: Any, nx: Any, image: Any, original: Any) -> None:
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
def gather_image(width: Any, images: Any, index: Any, lane: Any, image: Any) -> None:
    """Copy one image of a stack (n, pixels) into a lane."""
    pixels = images.shape[1]
    for i in range(pixels):
        put(image, i * width + lane, get(images, index * pixels + i))


@compiled
def scatter_image(width: Any, image: Any, lane: Any, images: Any, index: Any) -> None:
    """Copy a lane into one image of a stack (n, pixels)."""
    pixels = images.shape[1]
    for i in range(pixels):
        put(images, index * pixels + i, get(image, i * width + lane))
