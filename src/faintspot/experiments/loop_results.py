"""Results of closed-loop experiments: their files, their statistics, and numbers with errors in words."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.ao_loop.files import INTERLEAVED_FILE, Stored, make_folder
from faintspot.ao_loop.record import LoopRecord
from faintspot.base.checks import finite_array
from faintspot.base.errors import InputError
from faintspot.base.files import parse_json, write_atomically
from faintspot.experiments.statistics import DRAWS, FEWEST_PIECES, SEED, Estimate, of_draws, student

Floats = NDArray[np.float64]
_FORMAT = 1


@dataclass(frozen=True, eq=False)
class InterleavedResult:
    """Observations with and without denoising in turn, as on the sky; one item per set."""

    records: tuple[LoopRecord, ...]
    block: tuple[NDArray[np.int64], ...]
    """(frames,) each: number of the measurement that a frame belongs to."""
    strengths: tuple[Floats, ...]
    """(methods,) each: strength of the denoising, electrons; NaN: none."""
    set_names: tuple[str, ...]
    settle_in_block: int
    """Frames at the start of every measurement that are not scored."""

    def save(self, folder: str | Path) -> None:
        """Write the sets and what they are to a folder, which is made.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        folder = make_folder(folder)
        for number, record in enumerate(self.records, start=1):
            record.save(set_file(folder, number))
        self.save_description(folder)

    def save_description(self, folder: Path) -> None:
        """Write what the sets are, where their records are written already.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        sets = [
            {
                "name": name,
                "strengths_e": [None if math.isnan(strength) else float(strength) for strength in strengths],
                "block_frames": np.bincount(block).tolist(),
            }
            for name, strengths, block in zip(self.set_names, self.strengths, self.block, strict=True)
        ]
        document = {"format": _FORMAT, "settle_in_block": self.settle_in_block, "sets": sets}
        write_atomically(folder / INTERLEAVED_FILE, json.dumps(document, indent=1) + "\n")

    @classmethod
    def load(cls, folder: str | Path) -> InterleavedResult:
        """Read what `save` wrote.

        Raises
        ------
        InputError
            When it cannot be read, or is something else.
        """
        folder = Path(folder)
        path = folder / INTERLEAVED_FILE
        try:
            document: Any = parse_json(path.read_text(encoding="utf-8"))
            sets = document["sets"]
            if document["format"] != _FORMAT:
                raise ValueError(f"format {document['format']}")
            strengths = [
                np.array([math.nan if value is None else value for value in each["strengths_e"]], np.float64)
                for each in sets
            ]
            block = [np.repeat(np.arange(len(each["block_frames"])), each["block_frames"]) for each in sets]
            names = tuple(str(each["name"]) for each in sets)
            settle = int(document["settle_in_block"])
        except FileNotFoundError:
            raise InputError(f"{path}: no such file") from None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not the result of interleaved observations ({error})") from None
        records = tuple(LoopRecord.load(set_file(folder, number)) for number in range(1, len(sets) + 1))
        return cls(records, tuple(block), tuple(strengths), names, settle)


@dataclass(frozen=True, eq=False)
class MagnitudeResult(Stored):
    """Strehl ratio against the star's flux: A methods, F fluxes, R realisations of the air."""

    WHAT: ClassVar[str] = "a magnitude experiment"
    FORMAT: ClassVar[int] = 3

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.experiments.loop_methods.method_kind`."""
    labels: tuple[str, ...]
    """(A,)"""
    photons: Floats
    """(F,): photo-electrons of a fully lit sub-aperture in a frame."""
    magnitudes: Floats
    """(F,)"""
    strehl: Floats
    """(A, F, R): long exposure; NaN where not measured yet."""
    centroid_gain: Floats
    """(A, F, R)"""
    settings: NDArray[np.str_]
    """(A, F): TOML text of the tuned settings; "" where not tuned yet."""
    choices: NDArray[np.str_]
    """(A, F): JSON text of the tuned values, loop gain included; "{}" where not tuned yet."""
    psf: NDArray[np.float32]
    """(A, F, p, p): long-exposure image, mean over realisations; 1 at the peak of a flat wavefront's."""
    configuration: str
    """TOML text."""


@dataclass(frozen=True, eq=False)
class BudgetResult(Stored):
    """Error budget: A methods with T terms switched off, R realisations of the air."""

    WHAT: ClassVar[str] = "an error budget"
    FORMAT: ClassVar[int] = 2

    names: tuple[str, ...]
    """(A,): of the methods, see `faintspot.experiments.loop_methods.method_kind`."""
    terms: tuple[str, ...]
    """(T,): what is switched off; the first is nothing."""
    labels: tuple[str, ...]
    """(A,)"""
    strehl: Floats
    """(A, T, R): long exposure; NaN where not measured yet."""
    residual_nm: Floats
    """(A, T, R): rms of the wavefront after the mirror, root of the mean square over the frames."""


def set_file(folder: Path, number: int) -> Path:
    """Return where the record of a set is, counted from 1."""
    return folder / f"set-{number}.npz"


@dataclass(frozen=True)
class RegressionLine:
    """Least-squares line y = intercept + slope x."""

    slope: float
    intercept: float
    correlation: float
    """Pearson's; NaN when x or y does not vary."""
    slope_low: float
    slope_high: float
    """95 % interval of the slope, as if the points were independent."""
    count: int

    def __call__(self, x: ArrayLike) -> Floats:
        """Return the line's values."""
        return self.intercept + self.slope * np.asarray(x, np.float64)


def neighbour_differences(values: ArrayLike, time: ArrayLike, reference: ArrayLike) -> Floats:
    """Return each value's difference from those of the reference just before and after it.

    Between two references it is taken from the straight line between them, so that what drifts slowly
    cancels; before the first and after the last from that one.

    Parameters
    ----------
    values, time : (n,) arrays
        In the order of time.
    reference : (n,) array of bool
        Which values are references; for them the result is NaN.

    Raises
    ------
    InputError
        When shapes differ, time does not rise, or there is no reference.
    """
    series, when = (
        finite_array(name, a).astype(np.float64) for name, a in (("values", values), ("time", time))
    )
    chosen = np.asarray(reference, np.bool_)
    if series.ndim != 1 or series.shape != when.shape or series.shape != chosen.shape:
        raise InputError(
            f"values, time, reference: expected the same number of each, got shapes {series.shape}, "
            f"{when.shape} and {chosen.shape}"
        )
    if (np.diff(when) <= 0).any():
        raise InputError("time: expected rising values")
    if not chosen.any():
        raise InputError("reference: expected at least one measurement without denoising")
    differences = series - np.interp(when, when[chosen], series[chosen])
    differences[chosen] = np.nan
    return differences


def regression_line(x: ArrayLike, y: ArrayLike) -> RegressionLine:
    """Return the least-squares line through points.

    Raises
    ------
    InputError
        When there are fewer than three points, shapes differ, or a value is not finite.
    """
    across, up = (
        finite_array(name, values).astype(np.float64).ravel() for name, values in (("x", x), ("y", y))
    )
    count = len(across)
    if count < 3 or len(up) != count:
        raise InputError(f"x, y: expected at least three points, got {count} and {len(up)}")
    dx, dy = across - across.mean(), up - up.mean()
    sum_xx, sum_yy, sum_xy = float(dx @ dx), float(dy @ dy), float(dx @ dy)
    if sum_xx == 0:
        return RegressionLine(0.0, float(up.mean()), math.nan, math.nan, math.nan, count)
    slope = sum_xy / sum_xx
    correlation = sum_xy / math.sqrt(sum_xx * sum_yy) if sum_yy > 0 else math.nan
    left = max(0.0, sum_yy - slope * sum_xy)
    half = student(count - 2) * math.sqrt(left / (count - 2) / sum_xx)
    return RegressionLine(
        slope, float(up.mean() - slope * across.mean()), correlation, slope - half, slope + half, count
    )


def magnitude_gain(
    magnitudes: ArrayLike,
    strehl: ArrayLike,
    reference: ArrayLike,
    level: float,
    rng: np.random.Generator | None = None,
) -> Estimate:
    """Return the gain in limiting magnitude at a Strehl ratio, with its interval over realisations.

    Each method's mean curve is made to fall with magnitude (isotonic regression) and read off between its
    points, never beyond them. Realisations are drawn with replacement, the same ones for both methods.

    Parameters
    ----------
    magnitudes : (F,) array
    strehl, reference : (F, R) arrays
        Of the method and of what it is compared with; the same realisations. NaN: not measured.
    level : float
        The Strehl ratio.
    rng : numpy.random.Generator, optional

    Returns
    -------
    Estimate
        Infinite where the method's curve stays above the level and the reference's does not, minus infinite
        where it stays below; NaN where neither crosses it, or nothing is measured yet. An end of the interval
        is infinite where more than 2.5 % of the draws left the measured magnitudes there.

    Raises
    ------
    InputError
        When shapes do not fit together.
    """
    faint = finite_array("magnitudes", magnitudes).astype(np.float64)
    curves = [np.asarray(values, np.float64) for values in (strehl, reference)]
    if faint.ndim != 1 or any(curve.ndim != 2 or curve.shape != curves[0].shape for curve in curves):
        raise InputError("strehl, reference: expected the same shape (magnitudes, realisations)")
    if len(curves[0]) != len(faint):
        raise InputError(f"strehl: expected {len(faint)} magnitudes, got {len(curves[0])}")
    whole = ~np.isnan(curves[0] + curves[1]).any(axis=1)
    order = np.flatnonzero(whole)[np.argsort(faint[whole])]
    if len(order) < 2:
        return Estimate(math.nan)
    faint, curves = faint[order], [curve[order] for curve in curves]
    limits = [float(limiting_magnitudes(faint, curve.mean(axis=1), level)) for curve in curves]
    realisations = curves[0].shape[1]
    gain = limits[0] - limits[1]
    if not math.isfinite(gain) or realisations < FEWEST_PIECES:
        return Estimate(gain)
    rng = np.random.default_rng(SEED) if rng is None else rng
    draws = rng.integers(0, realisations, (DRAWS, realisations))
    ends = [limiting_magnitudes(faint, curve[:, draws].mean(axis=2).T, level) for curve in curves]
    return of_draws(gain, _differences(*ends), realisations)


def limiting_magnitudes(magnitudes: ArrayLike, strehl: ArrayLike, level: float) -> Floats:
    """Return the magnitude at which each curve falls below a level, after `falling`.

    Infinite when it stays above within the magnitudes measured, minus infinite when it is never above.

    Parameters
    ----------
    magnitudes : (F,) array
        Rising.
    strehl : (..., F) array
    level : float
    """
    faint = np.asarray(magnitudes, np.float64)
    curves = falling(strehl)
    after = np.argmax(curves < level, axis=-1)[..., None]
    before = np.maximum(after - 1, 0)
    high, low = (np.take_along_axis(curves, place, -1)[..., 0] for place in (before, after))
    first, last = faint[before[..., 0]], faint[after[..., 0]]
    part = (high - level) / np.where(high > low, high - low, 1.0)
    crossing = first + part * (last - first)
    bounded = np.where(curves[..., -1] >= level, np.inf, crossing)
    return np.asarray(np.where(curves[..., 0] < level, -np.inf, bounded), np.float64)


def falling(values: ArrayLike) -> Floats:
    """Return the never rising series (..., F) nearest to `values` by least squares.

    By the min-max formula: at each place, the least over all beginnings before it of the largest over all
    ends after it of the mean between them (Robertson, Wright & Dykstra 1988, Order Restricted Statistical
    Inference, chapter 1).
    """
    series = np.asarray(values, np.float64)
    count = series.shape[-1]
    sums = np.concatenate([np.zeros((*series.shape[:-1], 1)), np.cumsum(series, axis=-1)], axis=-1)
    place = np.arange(count)
    lengths = place[None, :] + 1 - place[:, None]  # from begin (rows) to end (columns)
    means = (sums[..., None, 1:] - sums[..., :-1, None]) / np.maximum(lengths, 1)
    means = np.where(lengths > 0, means, -np.inf)
    largest = np.maximum.accumulate(means[..., ::-1], axis=-1)[..., ::-1]  # over ends at or after the column
    return np.asarray(np.where(lengths > 0, largest, np.inf).min(axis=-2), np.float64)


def _differences(ends: Floats, starts: Floats) -> Floats:
    """Return ends - starts; which of two infinite ones is fainter is not known, and they count as equal."""
    same = np.isinf(ends) & (ends == starts)
    return np.asarray(np.where(same, 0.0, ends) - np.where(same, 0.0, starts), np.float64)
