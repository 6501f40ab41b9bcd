"""Binning of frames: the sum of blocks of pixels, and the calibration of binned frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.slopes.camera.calibration import Calibration


def blocks(array: ArrayLike, factor: int) -> NDArray[Any]:
    """Return blocks of pixels: (..., h, w) as (..., h // factor, w // factor, factor^2).

    Rows and columns that fill no block are left out.
    """
    values = np.asarray(array)
    height, width = (side // factor for side in values.shape[-2:])
    whole = values[..., : height * factor, : width * factor]
    split = whole.reshape(*values.shape[:-2], height, factor, width, factor)
    return np.moveaxis(split, -3, -2).reshape(*values.shape[:-2], height, width, factor**2)


def binned(frames: ArrayLike, factor: int, saturation: float = np.nan) -> NDArray[np.float32]:
    """Return the sum of each block of factor x factor pixels, float32; NaN where one pixel is not finite.

    A block with a saturated pixel becomes saturated as a whole: at least factor^2 times `saturation`.
    """
    array = np.asarray(frames)
    height, width = (side // factor * factor for side in array.shape[-2:])
    # Strided parts of the frame: several times as fast as a reduction over blocks.
    parts = [array[..., y:height:factor, x:width:factor] for y in range(factor) for x in range(factor)]
    total = np.zeros(parts[0].shape)
    with np.errstate(over="ignore", invalid="ignore"):
        for part in parts:
            total += part
        sums = total.astype(np.float32)
    if not np.isnan(saturation):
        level = np.nextafter(np.float32(saturation * factor**2), np.float32(np.inf))
        saturated = np.zeros(sums.shape, bool)
        for part in parts:
            saturated |= part >= saturation
        sums[saturated & (sums < level)] = level
    return sums


def spread(images: ArrayLike, factor: int) -> NDArray[np.float32]:
    """Return images with each pixel spread evenly over the block that it is the sum of."""
    values = np.asarray(images, np.float32) / np.float32(factor**2)
    return values.repeat(factor, axis=-2).repeat(factor, axis=-1)


def binned_calibration(calibration: Calibration, factor: int, frame_shape: tuple[int, int]) -> Calibration:
    """Return the calibration of binned frames: dark levels and variances add up, and the gain stays.

    A block with a bad pixel is bad. The flat field is the mean of the block.
    """
    n = factor**2
    values: dict[str, Any] = {"background_e": calibration.background_e * n}
    if calibration.saturation_adu is not None:
        values["saturation_adu"] = calibration.saturation_adu * n
    if isinstance(calibration.dark, np.ndarray):
        values["dark"] = blocks(calibration.dark, factor).sum(axis=-1)
    elif calibration.dark is not None:
        values["dark"] = calibration.dark * n
    if isinstance(calibration.read_noise_e, np.ndarray):
        values["read_noise_e"] = np.sqrt(np.square(blocks(calibration.read_noise_e, factor)).sum(axis=-1))
    elif calibration.read_noise_e is not None:
        values["read_noise_e"] = calibration.read_noise_e * factor
    if calibration.flat is not None:
        values["flat"] = blocks(calibration.flat, factor).mean(axis=-1)
    bad = ~np.isfinite(calibration.maps(frame_shape)).all(axis=0)
    if bad.any():
        values["bad_pixels"] = blocks(bad, factor).any(axis=-1)
    return replace(calibration, **values)


def camera_calibration(calibration: Calibration, factor: int) -> Calibration:
    """Return the calibration of the camera whose binned frames have this one, without maps but the dark."""
    n, dark, noise = factor**2, calibration.dark, calibration.typical_read_noise_e
    if isinstance(dark, np.ndarray):
        dark = spread(dark, factor)
    elif dark is not None:
        dark /= n
    return Calibration(
        dark=dark,
        estimated=tuple(name for name in calibration.estimated if name == "dark"),
        gain_e_per_adu=calibration.gain_e_per_adu,
        em_gain=calibration.em_gain,
        read_noise_e=None if noise is None else noise / factor,
        background_e=calibration.background_e / n,
    )
