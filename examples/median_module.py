"""A module for `faintspot realtime load`: every inner pixel becomes the median of the 3 x 3 around it."""

import numba
import numpy as np

STAGE = "denoise"


@numba.njit(nogil=True)
def _sorted(a, b, c):
    return min(a, b, c), max(min(a, b), min(max(a, b), c)), max(a, b, c)


@numba.njit(nogil=True)
def _median(images):
    result = images.copy()
    for i, y, x in np.ndindex(len(images), images.shape[1] - 2, images.shape[2] - 2):
        image = images[i]
        a, b, c = _sorted(image[y, x], image[y, x + 1], image[y, x + 2])
        d, e, f = _sorted(image[y + 1, x], image[y + 1, x + 1], image[y + 1, x + 2])
        g, h, k = _sorted(image[y + 2, x], image[y + 2, x + 1], image[y + 2, x + 2])
        result[i, y + 1, x + 1] = _sorted(max(a, d, g), _sorted(b, e, h)[1], min(c, f, k))[1]
    return result


def make(layout, settings):
    """Return the function that is called for every frame."""
    return _median
