"""Checks of frames: colour mosaics, saturation, bytes in the wrong order, hot pixels."""

from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, real_array
from faintspot.base.statistics import mad_std

# Standard deviation of spots below which a pixel differs from its neighbours without a filter, too: those of
# 0.9 px have a contrast of 1.16 where all lie at the same place of their pixel.
_NARROWEST_PX = 1.1
_CONTRAST = 1.25  # of the gains, from which slopes suffer
_NO_FILTER = 100.0  # pixels without any flux are gaps
_AGREE = 0.9  # part of the spots that show the same order of the gains
_FEWEST = 4  # spots
_SIGNIFICANT = 5.0  # standard errors by which the gains of many spots differ
_SMOOTHING = np.outer([1, 2, 1], [1, 2, 1]) / 16  # weighs even and odd rows and columns alike

_FEWEST_PIXELS, _FEWEST_VALUES = 4, 8  # clipped pixels of the frame, and values over all frames
_PILE = 4.0  # of values at the largest one, over those at any other value of bright pixels
_BRIGHT = 0.5  # of the range from the median to the largest value
_FEWEST_STEPS = 16  # of that range, in the steps of the camera: fewer are photons counted one by one

# By how much the correlation of neighbours is higher in the right order; and the correlations along rows of
# bytes read one by one: low and high bytes alternate, and every second is alike.
_SMOOTHER, _ALTERNATE, _ALIKE = 0.2, -0.2, 0.5
_CENTRAL, _FEW = (0.005, 0.995), 8  # pixels that count; range of the high bytes over that of the low ones
# Noise about 0 that wraps around: part of the range between neighbours, and part of the neighbours.
_WRAPPED, _OFTEN = 0.75, 0.02

_HOT = 8.0  # standard deviations of the noise
_SHARPNESS = 4.0  # excess over the spread of the neighbours; at most 3 for a Nyquist-sampled spot


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
    above = gains[gain.argmax()] - gains[gain.argmin()]
    if above.mean() < _SIGNIFICANT * (1 + 8 / len(rows)) * above.std() / np.sqrt(len(rows)):
        return 1.0
    agree = float(np.mean(above > 0))
    contrast = float(gain.max() / max(gain.min(), 1e-3))
    return contrast if agree > _AGREE and _CONTRAST < contrast < _NO_FILTER else 1.0


class LargestValues:
    """Largest values of some frames, and how many pixels have each.

    The frames of a camera whose values are aligned left, or converted to floating-point numbers, show their
    level as well: only values that are equal count, not the type that holds them.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.camera.frame_checks import LargestValues
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


def misread(frame: NDArray[Any]) -> str:
    """Return why the numbers of a frame (h, w) are probably not those of the camera; empty if they are.

    Neighbouring pixels of a camera are alike. Those of another order of bytes are not, or only their high
    bytes vary much. Neighbours near 0 and near the limit of unsigned numbers are noise below and above 0.
    """
    limit = int(np.iinfo(frame.dtype).max) if frame.dtype.kind == "u" else 65535
    numbers = np.where(frame < limit, frame, np.nan)  # pixels at the limit may be saturated
    if np.mean(np.abs(np.diff(numbers, axis=1)) > _WRAPPED * limit) > _OFTEN and np.nanmin(numbers) >= 0:
        return (
            f"many pixels near {limit} are beside others near 0, as where a dark was subtracted in unsigned "
            "integers and values below 0 wrapped around; subtract it in signed ones, or give it with --dark"
        )
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


def find_hot_pixels(frame: ArrayLike) -> NDArray[np.int64]:
    """Find isolated bright pixels, and pairs of them, in a frame.

    A pixel is hot when it exceeds the median of its 8 neighbours by more than 8 standard
    deviations of the noise of the frame and by more than 4 times their spread (second largest minus
    smallest). The largest neighbour may be hot, too. Peaks of spots sampled at the Nyquist rate or better
    stay below this limit; those of sharper spots do not.

    Parameters
    ----------
    frame : (h, w) array
        Image of the spots. NaN marks pixels known to be bad; they are not reported.

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
    check_shape("frame", image, ("h", "w"))
    not_finite = ~np.isfinite(image)
    image[not_finite] = np.median(image[~not_finite]) if not not_finite.all() else 0.0
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    excess = image - median_filter(image, footprint=ring, mode="mirror")
    noise = mad_std(excess)
    second_largest = rank_filter(image, -2, footprint=ring, mode="mirror")
    spread = second_largest - minimum_filter(image, footprint=ring, mode="mirror")
    return np.argwhere((excess > _HOT * noise) & (excess > _SHARPNESS * spread) & ~not_finite)


class MeanFrame:
    """Mean of the finite values of each pixel, over frames that come in blocks.

    Parameters
    ----------
    shape : (int, int)
        Height and width of a frame.
    """

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._total, self._count = np.zeros(shape), np.zeros(shape, np.int64)

    def add(self, block: NDArray[np.generic]) -> None:
        """Add frames, (n, h, w)."""
        finite = np.isfinite(block)
        self._total += np.where(finite, block, 0).sum(axis=0, dtype=np.float64)
        self._count += finite.sum(axis=0)

    @property
    def mean(self) -> NDArray[np.float64]:
        """(h, w), NaN in pixels that were never finite."""
        unknown = np.full(self._total.shape, np.nan)
        return np.asarray(np.divide(self._total, self._count, where=self._count > 0, out=unknown))


def are_repeated(frames: NDArray[np.generic], before: NDArray[np.generic] | None) -> NDArray[np.bool_]:
    """Return which frames (n, h, w) are the same as the one before, as a grabber writes them twice."""
    same = (frames[1:] == frames[:-1]).all(axis=(1, 2))
    first = before is not None and np.array_equal(frames[0], before)
    return np.concatenate([[first], same])
