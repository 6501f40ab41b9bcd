"""Recognise frames of a colour camera: its filters give every other row and column a gain of its own."""

from __future__ import annotations

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

# Standard deviation of spots below which a pixel differs from its neighbours without a filter, too: those of
# 0.9 px have a contrast of 1.16 where all lie at the same place of their pixel.
_NARROWEST_PX = 1.1
_CONTRAST = 1.25  # of the gains, from which slopes suffer
_AGREE = 0.9  # part of the spots that show the same order of the gains
_FEWEST = 4  # spots
_SMOOTHING = np.outer([1, 2, 1], [1, 2, 1]) / 16  # weighs even and odd rows and columns alike


def mosaic_contrast(
    frame: NDArray[np.float64], spots: NDArray[np.float64], pitch_px: float, spot_px: float
) -> float:
    """Return the ratio of the largest to the smallest gain of pixels at even and odd rows and columns.

    It is 1 where the four gains do not differ clearly, in the same order in almost all spots.

    Parameters
    ----------
    frame : (h, w) array
        NaN in pixels to ignore.
    spots : (n, 2) array
        x, y of the spots [px].
    pitch_px, spot_px : float
        Distance of lenslets, and standard deviation of the spot shape.
    """
    if spot_px < _NARROWEST_PX:
        return 1.0
    reach = max(2, int(min(2 * spot_px, 0.4 * pitch_px)))
    usable = np.isfinite(frame)
    image = np.where(usable, frame, np.median(frame[usable]))
    smooth = scipy.ndimage.convolve(image, _SMOOTHING, mode="nearest")
    columns, rows = np.rint(spots).astype(np.int64).T
    inside = (np.minimum(rows, columns) >= reach + 1) & (rows < frame.shape[0] - reach - 1)
    inside &= columns < frame.shape[1] - reach - 1
    offset = np.arange(-reach, reach + 1)
    rows = rows[inside, None, None] + offset[:, None]
    columns = columns[inside, None, None] + offset
    if len(rows) < _FEWEST:
        return 1.0
    values, expected = image[rows, columns], smooth[rows, columns]
    level = expected.min(axis=(1, 2), keepdims=True)
    values, expected = values - level, expected - level
    phase = 2 * (rows % 2) + columns % 2
    gains = np.stack(
        [
            np.sum(values * (phase == i), axis=(1, 2))
            / np.maximum(np.sum(expected * (phase == i), axis=(1, 2)), 1e-300)
            for i in range(4)
        ]
    )
    gain = np.median(gains, axis=1)
    agree = float(np.mean(gains[gain.argmax()] > gains[gain.argmin()]))
    contrast = float(gain.max() / max(gain.min(), 1e-3))
    return contrast if agree > _AGREE and contrast > _CONTRAST else 1.0
