"""Noisy images of spots at random positions, drawn on the GPU: a warp per image.

Every number comes from a counter (pixel, image, attempt, purpose) and the study's key, so that an image does
not depend on which others are drawn with it.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numba import cuda, float32, float64, int32, uint64
from numpy.typing import NDArray

from faintspot.cuda.compiling import device, kernel
from faintspot.cuda.philox import normal, philox, uniform
from faintspot.cuda.poisson import poisson
from faintspot.cuda.strips import WARP

POSITION, PHOTONS, READ_NOISE = 0, 1, 2  # purposes
STEPS_PER_WIDTH = 32.0
"""Points of a profile's table per unit width (2 px times the size): cubic interpolation between them errs by
less than 5e-6 of the peak."""


@device
def fraction(table: Any, away: Any, per_px: Any) -> Any:
    """Light of a pixel's column or row so far from the spot, px, by Lagrange's cubic interpolation.

    `table`: at distances -1, 0, 1, ... steps, of which `per_px` are a pixel.
    """
    place = abs(away) * per_px
    i = int32(place)
    t = place - float32(i)
    left, right = t + float32(1.0), t - float32(1.0)
    beyond = t - float32(2.0)
    outer = table[i + 3] * t * left * right - table[i] * t * right * beyond
    inner = table[i + 1] * left * right * beyond - table[i + 2] * left * t * beyond
    return max(outer * float32(1.0 / 6.0) + inner * float32(0.5), float32(0.0))


@cache
def drawing_kernel(side: int) -> Any:
    """Return the kernel that draws images (n, side * side) float32 and their true positions (n, 2) float64.

    One warp a block, one block an image.
    """
    pixels, middle = side * side, 0.5 * (side - 1)

    @kernel
    def draw(
        key: Any,
        first: Any,
        reach: Any,
        tables: Any,
        per_px: Any,
        background: Any,
        read_noise: Any,
        images: Any,
        truth: Any,
    ) -> None:
        """`key` (2,) uint64; `first`: number of the first image; `tables`: along x and y, (2, length)."""
        at, lane = cuda.blockIdx.x, cuda.threadIdx.x
        if at >= images.shape[0]:
            return
        image, key_0, key_1 = uint64(first + at), key[0], key[1]
        a, b, c, d = philox(uint64(0), image, uint64(0), uint64(POSITION), key_0, key_1)
        x, y = reach * (2.0 * uniform(a, b) - 1.0), reach * (2.0 * uniform(c, d) - 1.0)
        if lane == 0:
            truth[at, 0], truth[at, 1] = x, y
        for i in range(lane, pixels, WARP):
            away_x, away_y = float32(float64(i % side) - middle - x), float32(float64(i // side) - middle - y)
            light = fraction(tables[0], away_x, per_px[0]) * fraction(tables[1], away_y, per_px[1])
            pixel = uint64(i)
            mean = float64(light) + background
            electrons = poisson(mean, pixel, image, uint64(PHOTONS), key_0, key_1)
            a, b, _, _ = philox(pixel, image, uint64(0), uint64(READ_NOISE), key_0, key_1)
            noisy = float32(electrons + read_noise * float64(normal(a, b)))
            images[at, i] = noisy - float32(background)

    return draw


def profile_tables(
    side: int, reach_px: float, flux_e: float, profile: str, size: float, elongation: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the light along x and along y against the distance from the spot, and their points per pixel.

    Parameters
    ----------
    side : int
        Of the images, px.
    reach_px : float
        Largest position on each axis.
    flux_e, profile, size, elongation
        Of the spots, as `faintspot.simulate.subapertures` takes them.

    Returns
    -------
    tables : (2, length) float32
        Their product is a pixel's mean, electrons.
    per_px : (2,) float32
    """
    from faintspot.simulate import spots

    def light(x: Any, y: Any, factor: float, shape: tuple[int, int] = (1, 1)) -> NDArray[np.float64]:
        """Light within images of whole spots at x, y."""
        places = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
        images = spots(places, shape=shape, profile=profile, size=size, elongation=factor)
        return np.asarray(images.sum(axis=(1, 2)))

    whole = flux_e / light(0.0, 0.0, elongation, (side, side))[0]
    per_px = np.maximum(STEPS_PER_WIDTH / (2.0 * size * np.array([elongation, 1.0])), 4.0)
    length = int((side / 2 + reach_px) * per_px.max()) + 6
    steps = np.arange(-1, length - 1)
    middle = np.sqrt(light(0.0, 0.0, 1.0)[0])  # what a round spot leaves in the middle pixel of one axis
    along = light(steps / per_px[0], 0.0, elongation) / middle
    across = light(0.0, steps / per_px[1], 1.0) / middle
    tables = np.stack([along * whole, across]).astype(np.float32)
    return tables, per_px.astype(np.float32)
