"""Detection of hot pixels: single pixels and pairs that are sharper than any spot."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between, real_array
from faintspot.base.errors import InputError
from faintspot.base.statistics import MAD_TO_STD

_SHARPNESS = 4.0  # excess over the spread of the neighbours; at most 3 for a Nyquist-sampled spot


def find_hot_pixels(frame: ArrayLike, *, threshold: float = 8.0) -> NDArray[np.int64]:
    """Find isolated bright pixels, and pairs of them, in a frame.

    A pixel is hot when it exceeds the median of its 8 neighbours by more than `threshold` standard
    deviations of the noise of the frame and by more than 4 times their spread (second largest minus
    smallest). The largest neighbour may be hot, too. Peaks of spots sampled at the Nyquist rate or better
    stay below this limit; those of sharper spots do not.

    Parameters
    ----------
    frame : (h, w) array
        Image of the spots. NaN marks pixels known to be bad; they are not reported.
    threshold : float

    Returns
    -------
    (n, 2) array of int
        Row and column of each, as required by `faintspot.Calibration`.

    Raises
    ------
    InputError
        If the frame is not a real two-dimensional array.
    """
    from scipy.ndimage import median_filter, minimum_filter, rank_filter

    image = real_array("frame", frame, minimum_dimensions=2).astype(np.float64)
    if image.ndim != 2:
        raise InputError(f"frame: expected shape (h, w), got {image.shape}")
    level = number_between("threshold", threshold, 0.0, low_open=True)
    not_finite = ~np.isfinite(image)
    image[not_finite] = np.median(image[~not_finite]) if not not_finite.all() else 0.0
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    excess = image - median_filter(image, footprint=ring, mode="mirror")
    noise = MAD_TO_STD * np.median(np.abs(excess - np.median(excess)))
    second_largest = rank_filter(image, -2, footprint=ring, mode="mirror")
    spread = second_largest - minimum_filter(image, footprint=ring, mode="mirror")
    return np.argwhere((excess > level * noise) & (excess > _SHARPNESS * spread) & ~not_finite)
