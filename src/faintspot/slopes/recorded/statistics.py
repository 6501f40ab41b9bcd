"""The numbers of a report: what one or several methods of a slopes run did, over frames and sub-apertures.

Everything is computed from valid measurements only (one measurement: one sub-aperture in one frame), and
comparisons between methods from the measurements that are valid in every method. In the per-sub-aperture
arrays NaN stands for "no valid frame".
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import finite_array
from faintspot.base.errors import InputError
from faintspot.base.flags import NO_FLAG, SubapertureFlag, are_valid
from faintspot.base.statistics import Estimate, absolute_errors, slope_statistics
from faintspot.slopes.pipeline.slopes import Slopes

Floats = NDArray[np.float64]


ARRAYS = ("x", "y", "flux", "flags")
_BLOCK_NUMBERS = 1 << 22  # numbers worked on at a time: bounds the memory of the double-precision copies


@dataclass(frozen=True)
class MeasuredSlopes:
    """Slopes of all frames, measured in one way; every array has shape (n_frames, n_subapertures).

    Parameters
    ----------
    name : str
        For legends, as "TV" or "no TV".
    x, y : array, px
        Spot positions from the sub-aperture's centre.
    flux : array, electrons
    flags : array of uint8
        Bits of `SubapertureFlag`.
    frames : (n_frames,) array of int, optional
        Frame numbers; frames follow each other where these do. Default: counted from 0.
    slopes : Slopes, optional
        All of them, whose wavefront is shown.
    standard_error_px : float
        Median standard error that the estimator states, per axis; NaN where it is not known.
    keep : SubapertureFlag
        Flags that do not make a measurement invalid, see `faintspot.Slopes`.

    Raises
    ------
    InputError
        When the arrays are not two-dimensional, not of one shape or not finite.
    """

    name: str
    x: NDArray[Any]
    y: NDArray[Any]
    flux: NDArray[Any]
    flags: NDArray[Any]
    frames: NDArray[np.int64] | None = field(default=None, kw_only=True)
    slopes: Slopes | None = field(default=None, kw_only=True, repr=False)
    standard_error_px: float = field(default=np.nan, kw_only=True)
    keep: SubapertureFlag = field(default=NO_FLAG, kw_only=True)

    def __post_init__(self) -> None:
        for name in ARRAYS:
            array = finite_array(f"{self.name}: {name}", getattr(self, name))
            if array.ndim != 2 or array.shape != np.shape(self.x):
                raise InputError(
                    f"{self.name}: {name}: expected shape (n_frames, n_subapertures), as x of shape "
                    f"{np.shape(self.x)}, got {array.shape}"
                )
            object.__setattr__(self, name, array)

    @classmethod
    def of(cls, name: str, slopes: Slopes, **more: Any) -> MeasuredSlopes:
        """Make one of the slopes of one frame or several."""
        errors = np.hypot(slopes.standard_error_x, slopes.standard_error_y)[slopes.valid] / np.sqrt(2)
        more |= {"standard_error_px": median(errors.astype(np.float64)), "keep": slopes.keep}
        arrays = (np.atleast_2d(getattr(slopes, array)) for array in ARRAYS)
        return cls(name, *arrays, slopes=slopes, **more)

    @property
    def number(self) -> NDArray[np.int64]:
        """Number of each frame."""
        return np.arange(len(self.x)) if self.frames is None else self.frames

    @cached_property
    def repeated(self) -> NDArray[np.bool_]:
        """Mask of frames, from the second on, whose slopes are those of the one before: written twice."""
        same = (self.x[1:] == self.x[:-1]).all(axis=1) & (self.y[1:] == self.y[:-1]).all(axis=1)
        return np.asarray(same)

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.x)

    @property
    def n_subapertures(self) -> int:
        """Number of sub-apertures."""
        return int(self.x.shape[1])

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Mask of valid measurements."""
        return are_valid(self.flags, self.keep)

    def flag_count(self, flag: SubapertureFlag) -> int:
        """Return in how many measurements all bits of `flag` are set."""
        return int(np.count_nonzero((self.flags & int(flag)) == int(flag)))


@dataclass(frozen=True)
class SlopesSummary:
    """Slopes in numbers: of the whole run, and per sub-aperture, (n_subapertures,), over its valid frames."""

    valid_fraction: float
    median_flux_e: float
    """Over all valid measurements; NaN when there is none."""
    valid_frames: NDArray[np.int64]
    flux_e: Floats
    """Median."""
    x_px: Floats
    """Mean."""
    y_px: Floats


@dataclass(frozen=True)
class Jitter:
    """Scatter of each sub-aperture's position over frames, px, (n_subapertures,); NaN below two frames."""

    n_frames: NDArray[np.int64]
    x_px: Floats
    """Standard deviation (n - 1)."""
    y_px: Floats

    @property
    def px(self) -> Floats:
        """Rms of x and y."""
        combined: Floats = np.sqrt((self.x_px**2 + self.y_px**2) / 2)
        return combined

    @property
    def measured(self) -> NDArray[np.bool_]:
        """Mask of sub-apertures with at least two frames."""
        return self.n_frames >= 2


def summarise(method: MeasuredSlopes) -> SlopesSummary:
    """Return the numbers of one method."""
    valid = method.valid
    parts: dict[str, list[Any]] = {name: [] for name in ("flux", "x", "y")}
    for block in column_blocks(method.n_frames, method.n_subapertures):
        kept = valid[:, block]
        parts["flux"].append(median_over_valid(method.flux[:, block], kept))
        for name in ("x", "y"):
            parts[name].append(mean_over_valid(getattr(method, name)[:, block], kept))
    flux, x, y = (np.concatenate(part) for part in parts.values())
    any_valid = bool(valid.any())
    return SlopesSummary(
        valid_fraction=float(valid.mean()),
        median_flux_e=float(np.median(method.flux[valid])) if any_valid else np.nan,
        valid_frames=valid.sum(axis=0),
        flux_e=flux,
        x_px=x,
        y_px=y,
    )


def valid_in_all(methods: Sequence[MeasuredSlopes]) -> NDArray[np.bool_]:
    """Return which measurements are valid in every method, (n_frames, n_subapertures)."""
    valid: NDArray[np.bool_] = np.logical_and.reduce([method.valid for method in methods])
    return valid


def jitter(x: NDArray[np.generic], y: NDArray[np.generic], valid: NDArray[np.bool_]) -> Jitter:
    """Return the scatter over the valid frames of positions (n_frames, n_subapertures)."""
    columns = []
    for block in column_blocks(*x.shape):
        kept = valid[:, block]
        columns.append([std_over_valid(axis[:, block], kept) for axis in (x, y)])
    return Jitter(valid.sum(axis=0), *(np.concatenate(part) for part in zip(*columns, strict=True)))


def frame_to_frame_noise(method: MeasuredSlopes, valid: NDArray[np.bool_]) -> Floats:
    """Return the noise per axis of each sub-aperture, px, from successive frames; NaN without any."""
    columns = []
    for block in column_blocks(method.n_frames, method.n_subapertures):
        are_valid = _successive(method, valid[:, block])
        squares = sum(
            np.diff(axis[:, block].astype(np.float64), axis=0) ** 2 for axis in (method.x, method.y)
        )
        columns.append(np.sqrt(mean_over_valid(np.asarray(squares) / 4, are_valid)))
    return np.concatenate(columns)


def relative_gain(
    method: MeasuredSlopes, reference: MeasuredSlopes, valid: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the centroid gain of a method over that of another one, and its standard error.

    Both are regressed on the slopes of the frames before and after, whose noise is independent: only motion
    and aberrations that last for two frames count. NaN where there are none.
    """
    if method is reference:
        return 1.0, 0.0
    motion, reference_motion = np.zeros(method.n_subapertures), np.zeros(method.n_subapertures)
    kept = np.maximum(np.count_nonzero(valid), 1)
    for axis in ("x", "y"):
        pair = [getattr(measured, axis) for measured in (method, reference)]
        means = [float(np.sum(values, where=valid, dtype=np.float64)) / kept for values in pair]
        for block in column_blocks(method.n_frames, method.n_subapertures):
            are_valid = _successive(method, valid[:, block])
            a, b = (values[:, block] - mean for values, mean in zip(pair, means, strict=True))
            common = a + b
            for sums, values in ((motion, a), (reference_motion, b)):
                lagged = values[1:] * common[:-1] + values[:-1] * common[1:]
                sums[block] += np.sum(lagged, axis=0, where=are_valid, dtype=np.float64)
    if reference_motion.sum() <= 0:
        return np.nan, np.nan
    ratio = float(motion.sum() / reference_motion.sum())
    spread = np.sum((motion - ratio * reference_motion) ** 2) * len(motion) / max(len(motion) - 1, 1)
    return ratio, float(np.sqrt(spread) / reference_motion.sum())


def _successive(method: MeasuredSlopes, valid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return where a measurement and that of the next frame are valid, (n_frames - 1, n)."""
    following = (np.diff(method.number) == 1) & ~method.repeated
    are_valid: NDArray[np.bool_] = valid[1:] & valid[:-1] & following[:, None]
    return are_valid


def median(values: Floats) -> float:
    """Return the median of the values that are not NaN; NaN when there is none."""
    kept = values[np.isfinite(values)]
    return float(np.median(kept)) if kept.size else np.nan


def slope_error(method: MeasuredSlopes, truth: Floats, valid: NDArray[np.bool_]) -> tuple[Estimate, float]:
    """Return the slope error R of the selected measurements [px], and their centroid gain."""
    if not valid.any():
        return Estimate(np.nan), np.nan
    statistics = slope_statistics(method.x[valid], method.y[valid], truth[valid])
    error = standard_error(absolute_errors(method.x, method.y, truth), valid)
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


def column_blocks(n_frames: int, n_subapertures: int) -> Iterator[slice]:
    """Yield ranges of sub-apertures whose measurements of all frames are a bounded number."""
    step = max(1, _BLOCK_NUMBERS // n_frames)
    for start in range(0, n_subapertures, step):
        yield slice(start, start + step)


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
