"""The numbers of a report: what one or several methods of a slopes run did, over frames and sub-apertures.

Everything is computed from valid measurements only (one measurement: one sub-aperture in one frame), and
comparisons between methods from the measurements that are valid in every method. In the per-sub-aperture
arrays NaN stands for "no valid frame".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import finite_array
from faintspot.base.flags import SubapertureFlag
from faintspot.base.statistics import UNKNOWN, Estimate, absolute_errors, slope_statistics
from faintspot.slopes.pipeline.slopes import Slopes

_BLOCK_NUMBERS = 1 << 22  # numbers worked on at a time: bounds the memory of the double-precision copies


@dataclass(frozen=True)
class MeasuredSlopes:
    """Slopes of all frames, measured in one way.

    Parameters
    ----------
    name : str
        For legends, as "TV" or "no TV".
    slopes : Slopes
        Arrays of shape (n_frames, n_subapertures).
    frames : (n_frames,) array of int, optional
        Frame numbers; frames follow each other where these do. Default: counted from 0.

    Raises
    ------
    InputError
        When a slope is not finite.
    """

    name: str
    slopes: Slopes
    frames: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        for name in ("x", "y", "flux"):  # of files that may be damaged
            finite_array(f"{self.name}: {name}", getattr(self.slopes, name))

    @property
    def number(self) -> NDArray[np.int64]:
        """Number of each frame."""
        return np.arange(self.n_frames) if self.frames is None else self.frames

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.slopes.x)

    @property
    def n_subapertures(self) -> int:
        """Number of sub-apertures."""
        return int(self.slopes.x.shape[1])

    @cached_property
    def valid(self) -> NDArray[np.bool_]:
        """Mask of valid measurements."""
        return self.slopes.valid

    @cached_property
    def valid_frames(self) -> NDArray[np.int64]:
        """Number of frames in which each sub-aperture is valid, (n_subapertures,)."""
        return np.asarray(self.valid.sum(axis=0))

    @cached_property
    def flux_e(self) -> Floats:
        """Median flux of each sub-aperture, (n_subapertures,)."""
        return of_columns(median_over_valid, self.slopes.flux, self.valid)

    @cached_property
    def mean_px(self) -> Floats:
        """Mean x and y of each sub-aperture, (n_subapertures, 2)."""
        axes = (self.slopes.x, self.slopes.y)
        return np.stack([of_columns(mean_over_valid, axis, self.valid) for axis in axes], axis=-1)

    @property
    def median_flux_e(self) -> float:
        """Median of all valid measurements; NaN when there is none."""
        return float(np.median(self.slopes.flux[self.valid])) if self.valid.any() else np.nan

    @property
    def stated_error_px(self) -> float:
        """Median standard error that the estimator states, per axis; NaN where it is not known."""
        errors = np.hypot(self.slopes.standard_error_x, self.slopes.standard_error_y)[self.valid]
        return median((errors / np.sqrt(2)).astype(np.float64))

    def flag_count(self, flag: SubapertureFlag) -> int:
        """Return the number of measurements with a flag."""
        return int(np.count_nonzero(self.slopes.flags & int(flag)))


def of_columns(function: Callable[..., Floats], *arrays: NDArray[Any]) -> Floats:
    """Return what a function gives for all sub-apertures, from blocks of the columns of arrays."""
    n_frames, n = arrays[-1].shape
    step = max(1, _BLOCK_NUMBERS // max(n_frames, 1))
    parts = (slice(start, start + step) for start in range(0, n, step))
    return np.concatenate([function(*(array[:, part] for array in arrays)) for part in parts], axis=-1)


def jitter(method: MeasuredSlopes, valid: NDArray[np.bool_]) -> Floats:
    """Return the standard deviation of each position over frames, rms of x and y [px]; NaN below two."""
    x, y = (of_columns(std_over_valid, axis, valid) for axis in (method.slopes.x, method.slopes.y))
    rms: Floats = np.sqrt((x**2 + y**2) / 2)
    return rms


def frame_to_frame_noise(method: MeasuredSlopes, valid: NDArray[np.bool_]) -> Floats:
    """Return the noise per axis of each sub-aperture, px, from successive frames; NaN without any."""

    def noise(x: NDArray[Any], y: NDArray[Any], used: NDArray[np.bool_]) -> Floats:
        squares = sum(np.diff(axis.astype(np.float64), axis=0) ** 2 for axis in (x, y))
        return np.asarray(np.sqrt(mean_over_valid(np.asarray(squares) / 4, used)))

    return of_columns(noise, method.slopes.x, method.slopes.y, _successive(method, valid))


def relative_gain(method: MeasuredSlopes, reference: MeasuredSlopes, valid: NDArray[np.bool_]) -> Estimate:
    """Return the centroid gain of a method over that of another one.

    Both are regressed on the slopes of the frames before and after, whose noise is independent: only motion
    and aberrations that last for two frames count. NaN where there are none.
    """
    if method is reference:
        return Estimate(1.0, 0.0)
    motion, used = np.zeros((2, method.n_subapertures)), _successive(method, valid)
    kept = np.maximum(np.count_nonzero(valid), 1)
    for axis in ("x", "y"):
        pair = [getattr(measured.slopes, axis) for measured in (method, reference)]
        means = [float(np.sum(values, where=valid, dtype=np.float64)) / kept for values in pair]
        motion += of_columns(partial(_lasting_motion, means), *pair, used)
    if motion[1].sum() <= 0:
        return UNKNOWN
    ratio = float(motion[0].sum() / motion[1].sum())
    count = method.n_subapertures
    spread = np.sum((motion[0] - ratio * motion[1]) ** 2) * count / max(count - 1, 1)
    return Estimate(ratio, float(np.sqrt(spread) / motion[1].sum()))


def _successive(method: MeasuredSlopes, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a measurement and that of the next frame are valid, (n_frames - 1, n).

    Frames whose slopes are those of the one before were written twice, and do not count.
    """
    x, y = method.slopes.x, method.slopes.y
    repeated = (x[1:] == x[:-1]).all(axis=1) & (y[1:] == y[:-1]).all(axis=1)
    following = (np.diff(method.number) == 1) & ~repeated
    are_valid: NDArray[np.bool_] = valid[1:] & valid[:-1] & following[:, None]
    return are_valid


def _lasting_motion(
    means: Sequence[float], own: NDArray[Any], other: NDArray[Any], used: NDArray[np.bool_]
) -> Floats:
    """Return the covariance sums of both slopes with their sum in the next and the last frame, (2, n)."""
    centred = own - means[0], other - means[1]
    common = centred[0] + centred[1]
    lagged = (values[1:] * common[:-1] + values[:-1] * common[1:] for values in centred)
    return np.stack([np.sum(each, axis=0, where=used, dtype=np.float64) for each in lagged])


def median(values: Floats) -> float:
    """Return the median of the values that are not NaN; NaN when there is none."""
    kept = values[np.isfinite(values)]
    return float(np.median(kept)) if kept.size else np.nan


def slope_error(method: MeasuredSlopes, truth: Floats, valid: NDArray[np.bool_]) -> tuple[Estimate, float]:
    """Return the slope error R of the selected measurements [px], and their centroid gain."""
    if not valid.any():
        return UNKNOWN, np.nan
    x, y = method.slopes.x, method.slopes.y
    statistics = slope_statistics(x[valid], y[valid], truth[valid])
    error = standard_error(absolute_errors(x, y, truth), valid)
    return Estimate(statistics.error.value, error), statistics.gain.value


def standard_error(values: Floats, valid: NDArray[np.bool_]) -> float:
    """Return the standard error of the mean of the valid values; NaN from a single one.

    Measurements of one frame, and of one sub-aperture, may have errors in common (a static bias): it is
    computed with either as the independent unit, and the larger one returned.
    """
    n = np.count_nonzero(valid)
    residual = np.where(valid, values - values[valid].mean(), 0.0)
    errors = []
    for axis in (0, 1):
        groups = int(np.count_nonzero(valid.any(axis=axis)))
        if groups > 1:
            sums = residual.sum(axis=axis)
            errors.append(np.sqrt(np.sum(sums**2) * groups / (groups - 1)) / n)
    return float(max(errors, default=np.nan))


def mean_over_valid(values: NDArray[np.generic], valid: NDArray[np.bool_]) -> Floats:
    """Return the mean of each column's valid values."""
    sums: Floats = np.sum(values, axis=0, where=valid, dtype=np.float64)
    return _divide(sums, valid.sum(axis=0))


def std_over_valid(values: NDArray[np.generic], valid: NDArray[np.bool_]) -> Floats:
    """Return the standard deviation (n - 1) of each column's valid values; NaN below two of them."""
    mean = mean_over_valid(values, valid)
    squares: Floats = np.sum(np.square(values - np.nan_to_num(mean)), axis=0, where=valid)
    return np.sqrt(_divide(squares, valid.sum(axis=0) - 1))


def median_over_valid(values: NDArray[np.generic], valid: NDArray[np.bool_]) -> Floats:
    """Return the median of each column's valid values."""
    ordered: Floats = np.sort(np.where(valid, values.astype(np.float64), np.inf), axis=0)
    count = valid.sum(axis=0)
    columns = np.arange(ordered.shape[1])
    upper = ordered[np.minimum(count // 2, len(ordered) - 1), columns]
    lower = ordered[np.maximum(count - 1, 0) // 2, columns]
    return _divide(np.where(count > 0, lower + upper, 0.0), 2 * (count > 0))


def _divide(sums: Floats, counts: NDArray[np.int64]) -> Floats:
    quotient: Floats = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    return quotient
