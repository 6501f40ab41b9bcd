"""Frames with light that is no spot: reflections, a background that varies, a colour mosaic."""

from functools import cache
from typing import NamedTuple

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from tests.slopes.sensor.sensor_cases import lattice, spot_frame

Floats = NDArray[np.float64]

PITCH_PX = 24.0


class Frame(NamedTuple):
    """A frame in ADU, and x, y of its spots (n, 2)."""

    pixels: NDArray[np.uint8]
    spots: Floats


def gaussian(shape: tuple[int, int], x: float, y: float, std: float) -> Floats:
    """Return a Gaussian with peak 1."""
    rows, columns = (
        np.exp(-0.5 * ((np.arange(n) - at) / std) ** 2) for n, at in zip(shape, (y, x), strict=True)
    )
    return np.outer(rows, columns)


@cache
def flat_frame(reflection_e: float) -> Frame:
    """Return 221 spots of FWHM 4.7 px and 1000 ADU, without aberration, under one reflection."""
    side = round(17 * PITCH_PX + 60)
    centre = (side - 1) / 2
    row, column = np.mgrid[-8:9, -8:9].reshape(2, -1)
    spots = centre + PITCH_PX * np.stack([column, row], axis=1)[np.hypot(row, column) <= 8.3]
    camera = {"background_e": 10.0, "gain_e_per_adu": 2.0, "offset_adu": 20.0}
    frame = spot_frame(spots @ [1, 1j], (side, side), flux_e=2000.0, width_px=2.0, seed=2, **camera)
    light = reflection_e * gaussian((side, side), centre + 8, centre - 6, 20.0)
    adu = np.round(frame + np.random.default_rng(3).poisson(light) / 2)
    return Frame(np.clip(adu, 0, 255).astype(np.uint8), spots)


@cache
def eye_frame(seed: int, n: int = 15) -> Frame:
    """Return an aberrated eye: speckled spots of 5 px with haloes, haze, and reflections of cornea and lens.

    Half of a spot's flux is in its core, the rest in a halo of 8 px (standard deviation).
    """
    rng = np.random.default_rng(seed)
    side = round(n * PITCH_PX + 50)
    centre = (side - 1) / 2
    shape = side, side
    offset = np.arange(n) - (n - 1) / 2
    cells = np.stack(np.meshgrid(offset, offset), axis=-1).reshape(-1, 2)
    cells = cells[np.hypot(*cells.T) <= n / 2 - 0.3]
    u, v = (2 * cells / n).T
    coma = 1.5 * (3 * (u**2 + v**2) - 2)
    displacement = np.stack([2.5 * u + 1.2 * v + coma * u, -v + 1.2 * u + coma * v], axis=1)
    spots = centre + PITCH_PX * cells + displacement
    flux = 1500 * np.exp(-0.8 * (u**2 + v**2)) * rng.lognormal(0, 0.35, len(cells))
    electrons = np.zeros(shape)
    for (x, y), electrons_of_spot in zip(spots, flux, strict=True):
        for std in (5.0 / 2.3548, 8.0):
            electrons += 0.5 * electrons_of_spot / (2 * np.pi * std**2) * gaussian(shape, x, y, std)
    speckle = np.square(scipy.ndimage.gaussian_filter(rng.standard_normal((2, side, side)), (0, 1.1, 1.1)))
    electrons *= 0.55 + 0.45 * speckle.sum(axis=0) / speckle.sum(axis=0).mean()
    electrons += 40 * gaussian(shape, centre + 60, centre - 40, 120.0) + 10 * np.arange(side) / side
    for right, down, peak, std in ((15, -20, 900, 22), (-80, 40, 250, 12), (60, 70, 150, 30)):
        electrons += peak * gaussian(shape, centre + right, centre + down, std)
    adu = 0.5 * (rng.poisson(electrons) + rng.normal(0, 2, shape)) + 6
    return Frame(np.clip(np.round(adu), 0, 255).astype(np.uint8), spots)


@cache
def mosaic_frames(gains: tuple[float, float, float, float]) -> NDArray[np.uint16]:
    """Return a frame of 9 x 9 spots of FWHM 3.5 px through filters of a Bayer mosaic."""
    frame = spot_frame(lattice((9, 9), 20.3, (28.3, 28.3)), (220, 220), flux_e=5000.0, width_px=1.5)
    mosaic = np.tile(np.reshape(gains, (2, 2)), (110, 110))
    return np.asarray(np.round(100 + (frame - 100) * mosaic), np.uint16)
