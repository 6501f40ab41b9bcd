"""Recognise frames whose bytes were read in the wrong order, or one by one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# By how much the correlation of neighbours is higher in the right order; and the correlations along rows of
# bytes read one by one: low and high bytes alternate, and every second is alike.
_SMOOTHER, _ALTERNATE, _ALIKE = 0.2, -0.2, 0.5
_CENTRAL, _FEW = (0.005, 0.995), 8  # pixels that count; range of the high bytes over that of the low ones


def misread(frame: NDArray[np.generic]) -> str:
    """Return why the bytes of a frame (h, w) of integers are probably read wrong; empty if they are not.

    Neighbouring pixels of a camera are alike. Those of another order of bytes are not, or only their high
    bytes vary much.
    """
    if frame.dtype.kind not in "iu" or min(frame.shape) < 3:
        return ""
    if frame.dtype.itemsize == 1:
        along = [_correlation(frame[:, :-lag], frame[:, lag:]) for lag in (1, 2)]
        if along[0] < _ALTERNATE and min(along[1], _correlation(frame[:-1], frame[1:])) > _ALIKE:
            return (
                "even and odd columns alternate, as do the low and high bytes of 16-bit pixels read as 8-bit "
                "ones; expected pixels of 16 bits"
            )
    if frame.dtype.itemsize == 2:
        pixels = frame.astype(np.uint16)
        low, high = (np.quantile(part, _CENTRAL) for part in (pixels & 255, pixels >> 8))
        few = low[1] > 0 and _FEW * np.ptp(low) <= np.ptp(high) > 0
        swapped = pixels.byteswap()
        if few or _smoothness(swapped) > _smoothness(pixels) + _SMOOTHER:
            return (
                "neighbouring pixels are alike only with their two bytes swapped; expected the other byte "
                "order (big- or little-endian)"
            )
    return ""


def _smoothness(image: NDArray[np.generic]) -> float:
    """Return the mean correlation of neighbours along both axes; hot pixels count like bright ones."""
    image = np.minimum(image, np.quantile(image.astype(np.float64), _CENTRAL[1]))
    return 0.5 * (_correlation(image[:, :-1], image[:, 1:]) + _correlation(image[:-1], image[1:]))


def _correlation(one: NDArray[np.generic], other: NDArray[np.generic]) -> float:
    a, b = (part.astype(np.float64).ravel() - part.mean() for part in (one, other))
    return float(a @ b / max(np.sqrt((a @ a) * (b @ b)), 1e-300))
