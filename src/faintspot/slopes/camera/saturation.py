"""Saturation level that recorded frames show: clipped values pile up at the largest one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_FEWEST_PIXELS, _FEWEST_VALUES = 4, 8  # clipped pixels of the frame, and values over all frames
_PILE = 4.0  # of values at the largest one, over those at any other value of bright pixels
_BRIGHT = 0.5  # of the range from the median to the largest value
_FEWEST_STEPS = 16  # of that range, in the steps of the camera: fewer are photons counted one by one


class LargestValues:
    """Largest values of some frames, and how many pixels have each.

    The frames of a camera whose values are aligned left, or converted to floating-point numbers, show their
    level as well: only values that are equal count, not the type that holds them.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.camera.saturation import LargestValues
    >>> spots = np.random.default_rng(1).gamma(0.5, 3000.0, (5, 64, 64))
    >>> values = LargestValues()
    >>> values.add(np.minimum(spots, 4095).astype(np.uint16))
    >>> values.saturation_adu
    4095.0
    """

    def __init__(self) -> None:
        self._median: float | None = None
        self._step, self._limit = 0.0, np.inf
        self._values, self._counts = np.zeros(0), np.zeros(0, np.int64)
        self._clipped: NDArray[np.bool_] | None = None

    def add(self, frames: NDArray[Any]) -> None:
        """Add frames (n, h, w) [ADU]; values that are not finite do not count."""
        usable = frames if frames.dtype.kind in "iu" else np.where(np.isfinite(frames), frames, -np.inf)
        before, largest = self._values[-1] if self._values.size else -np.inf, float(usable.max())
        if not np.isfinite(largest):
            return
        if self._median is None:
            finite = np.unique(usable[0][np.isfinite(usable[0])]).astype(np.float64)
            self._median = float(np.median(usable[np.isfinite(usable)]))
            self._limit = np.iinfo(frames.dtype).max if frames.dtype.kind in "iu" else np.inf
            self._step = float(np.diff(finite).min(initial=np.inf))
        top = max(before, largest)
        bright = usable[usable > self._median + _BRIGHT * (top - self._median)].astype(np.float64)
        values, of_value = np.unique(np.concatenate([self._values, bright]), return_inverse=True)
        weights = np.concatenate([self._counts, np.ones(bright.size, np.int64)])
        counts = np.bincount(of_value, weights, minlength=len(values)).astype(np.int64)
        kept = values > self._median + _BRIGHT * (top - self._median)
        self._values, self._counts = values[kept], counts[kept]
        there = (usable == top).any(axis=0)
        self._clipped = there if self._clipped is None or top > before else self._clipped | there

    @property
    def saturation_adu(self) -> float | None:
        """Level at which pixels are clipped; None if no values pile up, or at the limit of their type only.

        At least 8 values of 4 pixels or more are the largest one. They are 4 times as many as at any other
        value in the brighter half of the range.
        """
        if self._clipped is None or not self._values.size or self._median is None:
            return None
        count, largest = int(self._counts[-1]), float(self._values[-1])
        others = self._counts[:-1].max(initial=0)
        piled = count >= max(_FEWEST_VALUES, _PILE * others) and self._clipped.sum() >= _FEWEST_PIXELS
        fine = largest - self._median >= _FEWEST_STEPS * self._step
        return largest if piled and fine and largest < self._limit else None
