"""Data that the page shows: the newest frame, and a few numbers of each frame of the last minute."""

from collections import defaultdict, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.flags import INVALID, SubapertureFlag, are_valid
from faintspot.engine.settings.interleaving import methods_after, short_names
from faintspot.io.telemetry import all_left_out
from faintspot.loop.telemetry.turns import MethodDifference, compared_methods
from faintspot.slopes.sensor.layout import Layout

STRIP_S = 30.0
"""Time span of the strip charts [s]."""
FRAMES_S = 60.0
"""Time span of percentiles, the histogram and the comparison of methods [s]."""
_MOST_FRAMES = 1 << 17  # limit for very fast cameras
_MOST_CHANGES = 20  # kept for display
_MEAN_FRAMES = 500  # time constant of a sub-aperture's mean slope, about which the rms is taken
_FEWEST_FRAMES = 10  # needed for a mean
_STRIP = ("time_s", "method", "latency_us", "longest_us", "rms_px", "flux_e", "lost", "strehl", "rms_nm")
"""Row of the strip charts: frames of one method in one read of the telemetry."""
_FRAME = ("time_s", "method", "latency_us", "rms_px", "flux_e", "valid", "strehl")
"""Row of the last frames."""
_MEAN_PICTURES = 20  # time constant of the mean images from which the star's flux is taken
_BIN_EDGES_US = 2.0 ** (np.arange(0, 20 * 4 + 1) / 4)  # 1 us to 1 s, four bins in a factor of 2
_COMPARED = {
    "rms of slopes (px)": ("rms_px", 1.0),
    "flux kept (e-)": ("flux_e", 1.0),
    "valid (%)": ("valid", 100.0),
    "latency (µs)": ("latency_us", 1.0),
    "Strehl ratio": ("strehl", 1.0),
}


@dataclass(frozen=True)
class Picture:
    """A frame and its denoised images, with the record of that frame if still available."""

    frame: int
    raw: NDArray[np.float32]
    """(h, w), ADU."""
    denoised: NDArray[np.float32]
    """(n, ny, nx), electrons."""


@dataclass(frozen=True)
class Batch:
    """Data that arrived since the last read."""

    records: NDArray[np.void]
    """Records, as in `faintspot.engine.telemetry.ring.record_type`."""
    missed: int = 0
    """Number of records for which the page was too slow."""
    picture: Picture | None = None
    """The newest picture."""
    truth: tuple[int, float, float] | None = None
    """Truth of the newest frame that has one: frame, Strehl ratio, rms wavefront error [nm]."""
    commands: Floats | None = None
    """The newest commands, in the engine's unit."""
    changes: list[dict[str, Any]] = field(default_factory=list)
    """Changes of settings."""
    anew: bool = False
    """Whether earlier data belong to another engine."""


class BatchSource(Protocol):
    """Interface of a source of batches."""

    layout: Layout | None
    """Layout of the sensor; None until it is known."""
    methods: list[str]
    """Names of the interleaved configurations."""

    def read(self) -> Batch | None:
        """Return the data since the last call; None if there is no source."""
        ...

    def state(self) -> dict[str, Any]:
        """Return the state of the source as plain values for the page."""
        ...


class PageState:
    """Statistics of the frames of one engine.

    Parameters
    ----------
    methods : list of str
        Names of the interleaved configurations; none or one without interleaving.
    """

    def __init__(self, methods: list[str]) -> None:
        self.methods = list(methods)
        self.newest: NDArray[np.void] | None = None
        """Record of the newest frame."""
        self.changes: list[dict[str, Any]] = []
        self.seen = self.lost = self.missed = 0
        """Numbers of frames, of missing frame numbers, and of records for which the page was too slow."""
        self.commands: Floats | None = None
        self._images: Floats | None = None  # mean of the sub-apertures' images, electrons
        self._pictures = 0
        self._strip: deque[tuple[float, ...]] = deque()
        self._frames: deque[Floats] = deque()
        self._first_method = 0  # number of the first method of the present interleaving
        self._means: dict[int, Floats] = {}  # mean slopes by method, and their numbers of frames
        self._frames_of: defaultdict[int, int] = defaultdict(int)
        # The last ones: a frame's truth may be known before its record.
        self._truths: deque[tuple[int, float, float]] = deque(maxlen=4)
        self._last: NDArray[np.void] | None = None  # records of the previous read

    def add(self, batch: Batch) -> None:
        """Add the data of a batch."""
        self.changes = (self.changes + batch.changes)[-_MOST_CHANGES:]
        self.methods, self._first_method = methods_after(self.methods, batch.changes, self._first_method)
        self.missed += batch.missed
        if batch.commands is not None:
            self.commands = batch.commands
        if batch.truth is not None:
            self._truths.append(batch.truth)
        if batch.picture is not None:
            self._take_images(batch.picture.denoised)
        records = batch.records
        if not len(records):
            return
        rows = self._rows(records)
        for frame, strehl, _ in self._truths:  # known for a few frames only
            rows[records["frame"] == frame, _FRAME.index("strehl")] = strehl
        lost = self._lost_in(records)
        self.seen, self.lost = self.seen + len(records), self.lost + lost
        self.newest, self._last = records[-1].copy(), records
        self._frames.append(rows)
        self._strip.extend(self._strip_rows(rows, lost, batch))
        self._forget(rows[-1, 0])

    @property
    def star_flux_e(self) -> Floats | None:
        """Flux of the star in each sub-aperture, (n,); None without images.

        The sum of the mean image above the median of its edge, which no estimator changes: denoising keeps
        the sum.
        """
        if self._images is None:
            return None
        edge = np.ones(self._images.shape[1:], np.bool_)
        edge[1:-1, 1:-1] = False
        background = np.median(self._images[:, edge], axis=1)
        return np.asarray(self._images.sum(axis=(1, 2)) - edge.size * background, np.float64)

    def _take_images(self, images: NDArray[np.float32]) -> None:
        """Add images to their running mean."""
        new = np.nan_to_num(images, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float64)
        self._pictures += 1
        if self._images is None or self._images.shape != new.shape:
            self._images, self._pictures = new, 1
            return
        self._images += (new - self._images) / min(self._pictures, _MEAN_PICTURES)

    def record_of(self, frame: int) -> NDArray[np.void] | None:
        """Return the record of a frame from the last read; None if it is older."""
        if self._last is None:
            return None
        indices = np.flatnonzero(self._last["frame"] == frame)
        return self._last[indices[-1]] if len(indices) else None

    # Messages to the page ------------------------------------------------------------------------------

    def now(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Return values and arrays of the newest frame and of the strip charts."""
        newest = self.newest
        strip = np.array(self._strip, np.float64).reshape(-1, len(_STRIP))
        if len(strip):
            strip[:, 0] -= strip[-1, 0]
        shown = np.unique(strip[:, _STRIP.index("method")]).astype(int).tolist()
        star = self.star_flux_e
        values: dict[str, object] = {
            "flux_of": "kept by the method" if star is None else "of the star",
            "strip": _STRIP,
            "strip_s": STRIP_S,
            "strip_methods": {number: self._method_name(number) for number in shown},
            "seen": self.seen,
            "lost": self.lost,
            "missed": self.missed,
        }
        arrays: dict[str, NDArray[Any]] = {"strip": strip.astype(np.float32)}
        if newest is not None:
            values |= {"frame": int(newest["frame"]), "method": self._method_name(int(newest["method"]))}
            arrays |= {name: newest[name] for name in ("x", "y", "flux", "flags")}
            if star is not None:
                arrays["flux"] = star.astype(np.float32)
        if self.commands is not None:
            arrays["commands"] = self.commands.astype(np.float32)
        return values, arrays

    def figures(self) -> dict[str, Any]:
        """Return rate, percentiles, histogram and changes; takes milliseconds."""
        frames = self._all_frames()
        if not len(frames):
            return {"frames": 0}
        latency = frames[:, _FRAME.index("latency_us")]
        counts, _ = np.histogram(np.clip(latency, _BIN_EDGES_US[0], _BIN_EDGES_US[-1]), _BIN_EDGES_US)
        used = np.flatnonzero(counts)
        shown = slice(max(used[0] - 1, 0), used[-1] + 2)
        seconds = frames[-1, 0] - frames[0, 0]
        return {
            "frames": len(frames),
            "seconds": seconds,
            "rate_hz": (len(frames) - 1) / seconds if seconds > 0 else None,
            "percentiles_us": dict(
                zip(("50", "99", "99.9"), np.percentile(latency, (50, 99, 99.9)), strict=True)
            ),
            "longest_us": latency.max(),
            "histogram": {"from_us": _BIN_EDGES_US[:-1][shown], "counts": counts[shown]},
            "changes": self.changes,
        }

    def methods_compared(self) -> list[dict[str, Any]]:
        """Return the figures of the present methods, with errors; empty if there is only one.

        Takes some 50 ms, most of it for the bootstrap of the errors.
        """
        frames = self._all_frames()
        frames = frames[frames[:, _FRAME.index("method")] >= self._first_method]
        method = frames[:, _FRAME.index("method")].astype(np.int64)
        present = np.unique(method)
        if len(present) < 2:
            return []
        names = [self._method_name(number) for number in present]
        rows: list[dict[str, Any]] = [
            {"method": name, "frames": int(np.sum(method == number)), "figures": {}}
            for name, number in zip(names, present, strict=True)
        ]
        for title, (column, factor) in _COMPARED.items():
            values = factor * frames[:, _FRAME.index(column)]
            if np.isfinite(values).any():
                for row, compared in zip(rows, compared_methods(method, names, values), strict=True):
                    row["figures"][title] = _in_plain(compared)
        return rows

    # One read -----------------------------------------------------------------------------------------

    def _rows(self, records: NDArray[np.void]) -> Floats:
        """Return a row of `_FRAME` for each record."""
        valid = are_valid(records["flags"])
        count = valid.sum(axis=1)
        n_valid = np.where(count > 0, count, np.nan)
        rows = np.full((len(records), len(_FRAME)), np.nan)
        columns: Mapping[str, Any] = {
            "time_s": records["last_row_time_ns"] / 1e9,
            "method": records["method"],
            "latency_us": (records["published_time_ns"] - records["last_row_time_ns"]) / 1e3,
            "rms_px": self._rms(records, valid, n_valid),
            "flux_e": np.where(valid, records["flux"], 0.0).sum(axis=1) / n_valid,
            "valid": valid.mean(axis=1),
        }
        for name, values in columns.items():
            rows[:, _FRAME.index(name)] = values
        return rows

    def _rms(self, records: NDArray[np.void], valid: NDArray[np.bool_], n_valid: Floats) -> Floats:
        """Return the rms of each frame's slopes about the sub-apertures' running means for its method."""
        squares = np.full(len(records), np.nan)
        for method in np.unique(records["method"]):
            rows = records["method"] == method
            self._frames_of[int(method)] += rows.sum()
            used = valid[rows]
            slopes = np.stack([records["x"][rows], records["y"][rows]]).astype(np.float64)
            mean = np.where(used, slopes, 0.0).sum(axis=1) / np.maximum(used.sum(axis=0), 1)
            before = self._means.get(int(method), mean)
            weight = min(1.0, rows.sum() / _MEAN_FRAMES)
            self._means[int(method)] = before + weight * (mean - before)
            if self._frames_of[int(method)] < _FEWEST_FRAMES:
                continue
            deviation = np.where(used, slopes - self._means[int(method)][:, None], 0.0)
            squares[rows] = np.sum(deviation**2, axis=(0, 2))
        return np.asarray(np.sqrt(squares / (2 * n_valid)))

    def _lost_in(self, records: NDArray[np.void]) -> int:
        """Return the number of missing frame numbers; 0 if the camera restarted its numbering."""
        frames = records["frame"]
        if self.newest is not None:
            frames = np.concatenate([[self.newest["frame"]], frames])
        return int(np.maximum(all_left_out(frames), 0).sum())

    def _strip_rows(self, rows: Floats, lost: int, batch: Batch) -> list[tuple[float, ...]]:
        star, method = self.star_flux_e, rows[:, _FRAME.index("method")]
        star_e = None if star is None else _mean(star[are_valid(batch.records["flags"][-1])])
        truth = self._truths[-1][1:] if self._truths else (np.nan, np.nan)
        strip = []
        for number in np.unique(method):
            own = rows[method == number]
            latency, rms, kept = (own[:, _FRAME.index(name)] for name in ("latency_us", "rms_px", "flux_e"))
            times = own[-1, 0], number, float(np.median(latency)), float(latency.max())
            lost_then = float(lost + batch.missed) if own[-1, 0] == rows[-1, 0] else 0.0
            strip.append((*times, _mean(rms), _mean(kept) if star_e is None else star_e, lost_then, *truth))
        return sorted(strip)

    def _forget(self, now_s: float) -> None:
        """Discard old data."""
        while self._strip and not now_s - STRIP_S <= self._strip[0][0] <= now_s:
            self._strip.popleft()
        most = sum(len(rows) for rows in self._frames)
        while self._frames and (self._frames[0][-1, 0] < now_s - FRAMES_S or most > _MOST_FRAMES):
            most -= len(self._frames.popleft())

    def _all_frames(self) -> Floats:
        return np.concatenate([np.empty((0, len(_FRAME))), *self._frames])

    def _method_name(self, method: int) -> str:
        return short_names(self.methods)[method] if method < len(self.methods) else f"method {method}"


def flag_names() -> list[dict[str, Any]]:
    """Return the possible flags of a sub-aperture, for the page's legend."""
    return [
        {"bit": int(flag), "name": str(flag.name).lower().replace("_", " "), "invalid": bool(flag & INVALID)}
        for flag in SubapertureFlag
    ]


def _in_plain(compared: MethodDifference) -> dict[str, Any]:
    """Return a figure with half its confidence interval, and its difference from the first method's."""
    mean, difference = compared.mean, compared.difference
    row: dict[str, object] = {"mean": mean.value, "half": (mean.high - mean.low) / 2}
    if difference is not None:
        row |= {"difference": difference.value, "difference_half": (difference.high - difference.low) / 2}
        row["decided"] = difference.decided
    return row


def _mean(values: Floats) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if len(kept) else np.nan
