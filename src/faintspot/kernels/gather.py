"""Between frames or stacks of images and groups of W sub-apertures with all lanes of a pixel side by side."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from faintspot.checks import LARGEST_FLOAT32
from faintspot.kernels.compiling import compiled


@compiled
def gather_calibrated(
    width: Any,
    frame: Any,
    dark: Any,
    scale: Any,
    saturation: Any,
    row: Any,
    column: Any,
    lane: Any,
    ny: Any,
    nx: Any,
    image: Any,
) -> Any:
    """Copy one sub-aperture of a frame into a lane, in electrons; return bad and saturated pixels.

    (raw - dark) * scale; a bad pixel has scale NaN. What is not finite or absurdly large becomes NaN.
    """
    bad, saturated = 0, 0
    for y in range(ny):
        for x in range(nx):
            raw = np.float32(frame[row + y, column + x])
            value = (raw - dark[row + y, column + x]) * scale[row + y, column + x]
            saturated += raw >= saturation
            if not abs(value) <= LARGEST_FLOAT32:
                bad += 1
                value = math.nan
            image[(y * nx + x) * width + lane] = value
    return bad, saturated


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
    for i in range(images.shape[1]):
        image[i * width + lane] = images[index, i]


@compiled
def scatter_image(width: Any, image: Any, lane: Any, images: Any, index: Any) -> None:
    """Copy a lane into one image of a stack (n, pixels)."""
    for i in range(images.shape[1]):
        images[index, i] = image[i * width + lane]
