"""Numbers of a recording: rates, latencies, lost frames, and methods that alternated."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import UNKNOWN, Estimate, mean_by_blocks
from faintspot.io.telemetry import Telemetry, all_left_out

_LONGEST = 80  # text of a changed value
_TURNS_TOGETHER = 10  # neighbouring turns of the bootstrap's blocks: the turbulence changes slowly


@dataclass(frozen=True)
class MethodDifference:
    """A quantity in one method, and by how much it differs from the first method, turn by turn."""

    method: str
    mean: Estimate
    difference: Estimate | None
    """None of the first method."""


def timing(telemetry: Telemetry) -> tuple[float, float]:
    """Return the frame rate [Hz] and the longest interval [s] of consecutive frame numbers; NaN without any.

    The rate is one over the median interval.
    """
    interval = np.diff(telemetry.last_row_time_ns)[np.diff(telemetry.frame) == 1] / 1e9
    if not interval.size:
        return np.nan, np.nan
    median = np.median(interval)
    return float(1 / median) if median > 0 else np.nan, float(interval.max())


def gaps(telemetry: Telemetry) -> NDArray[np.int64]:
    """Return the numbers of frames missing in each gap of the record; none where the camera began anew."""
    lost = all_left_out(telemetry.frame)
    return lost[lost > 0]


def restarts(telemetry: Telemetry) -> int:
    """Return how often the camera's frame numbers began anew."""
    return int(np.count_nonzero(all_left_out(telemetry.frame) < 0))


def method_names(telemetry: Telemetry) -> list[str]:
    """Return the names of the methods that have frames in the record, by number; one without interleaving."""
    names = telemetry.attributes.get("methods") or ["slopes"]
    return [
        names[method] if method < len(names) else f"method {method}" for method in np.unique(telemetry.method)
    ]


def quantities(telemetry: Telemetry) -> dict[str, Floats]:
    """Return what methods are compared in, by its name with unit, a number for each frame; NaN where none is.

    The rms of slopes is taken about each sub-aperture's mean in the method, which differs between methods.
    """
    valid = telemetry.valid
    count = valid.sum(axis=1)
    squares = np.zeros(len(valid))
    for method in np.unique(telemetry.method):
        rows = telemetry.method == method
        used = valid[rows]
        for axis in (telemetry.x, telemetry.y):
            values = np.where(used, axis[rows], 0.0).astype(np.float64)
            mean = values.sum(axis=0) / np.maximum(used.sum(axis=0), 1)
            squares[rows] += np.sum(np.where(used, values - mean, 0.0) ** 2, axis=1)
    n_valid = np.where(count > 0, count, np.nan)
    flux = np.where(valid, telemetry.flux, 0.0).sum(axis=1) / n_valid
    return {
        "rms of slopes about their mean (px)": np.sqrt(squares / (2 * n_valid)),
        "flux (e-)": flux,
        "valid (%)": 100.0 * valid.mean(axis=1),
        "latency (µs)": 1e6 * telemetry.latency_s,
    }


def compared_methods(
    methods: NDArray[np.int64], names: Sequence[str], values: Floats
) -> list[MethodDifference]:
    """Compare alternating methods in a number for each frame; each turn with the first method's same turn.

    Intervals come from a bootstrap of blocks of ten neighbouring turns.

    Parameters
    ----------
    methods : (n,) array
        Of each frame.
    names : sequence of str
        Of the methods that have frames, by number.
    values : (n,) array
        NaN: not known of that frame.
    """
    by_turn = [_by_turn(methods, method, values) for method in np.unique(methods)]
    first = by_turn[0]
    compared = []
    for index, (name, means) in enumerate(zip(names, by_turn, strict=True)):
        length = min(len(means), len(first))
        difference = None if index == 0 else _mean(means[:length] - first[:length], len(by_turn) - 1)
        compared.append(MethodDifference(name, _mean(means), difference))
    return compared


def _by_turn(methods: NDArray[np.int64], method: int, values: Floats) -> Floats:
    """Return the mean of each turn of a method: of frames of its, one after the other; NaN without any."""
    number = np.cumsum(np.concatenate([[0], np.diff(methods) != 0]))[methods == method]
    method_values = values[methods == method]
    _, turn = np.unique(number, return_inverse=True)
    kept = np.isfinite(method_values)
    count = np.bincount(turn, weights=kept)
    sums = np.bincount(turn, weights=np.where(kept, method_values, 0.0))
    return np.asarray(np.divide(sums, count, out=np.full(len(count), np.nan), where=count > 0))


def _mean(values: Floats, comparisons: int = 1) -> Estimate:
    kept = values[np.isfinite(values)]
    return mean_by_blocks(kept, _TURNS_TOGETHER, comparisons=comparisons) if kept.size else UNKNOWN


def change_rows(telemetry: Telemetry) -> Sequence[tuple[int, float, str, str]]:
    """Return frame, seconds from the first frame, what and where of every change; NaN before the first."""
    rows = []
    start = telemetry.last_row_time_ns[0]
    for change in telemetry.changes:
        index = int(np.searchsorted(telemetry.frame, change["frame"]))
        inside = index < len(telemetry.frame) and change["frame"] >= telemetry.frame[0]
        seconds = float(telemetry.last_row_time_ns[index] - start) / 1e9 if inside else np.nan
        change_text = ", ".join(f"{name} = {_shortened(value)}" for name, value in change["changes"].items())
        where = change["where"]
        shown = "all" if where is None else where if isinstance(where, str) else ", ".join(map(str, where))
        rows.append((int(change["frame"]), seconds, change_text, shown))
    return rows


def _shortened(value: object) -> str:
    """Return a value as text of limited length."""
    text = str(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ..."
