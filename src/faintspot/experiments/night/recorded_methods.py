"""Methods, conditions and measured Strehl ratios of a recording in which methods alternated."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.text_files import parse_text
from faintspot.io.frames import read_array
from faintspot.io.telemetry import CLOSED_LOOP, Telemetry
from faintspot.loop.control.base import CONTROLS, INTEGRATOR, KALMAN, split_control
from faintspot.loop.control.configuration import RecordedControl
from faintspot.slopes.estimators.registry import estimators
from faintspot.slopes.pipeline.settings import option_names

_NONE, _SET = "none", "set"
_TV, _STRENGTH = "tv", "noise_std"
_FLUX, _GAIN = "flux_e", "gain"
_TIMES = 3.0  # time constants of an integrator, after which 5 % of the method before are left
_FILTER_FRAMES = 100  # in which a filter that begins anew converges


@dataclass(frozen=True, eq=False)
class RecordedMethods:
    """Methods that measured frames in a closed loop; names that occur twice are one method."""

    labels: tuple[str, ...]
    settings: tuple[str, ...]
    """In words."""
    strength_e: tuple[float, ...]
    """Strength of TV [e-]; NaN for methods without one."""
    groups: tuple[int, ...]
    """Number that methods share which differ in the controller only."""
    leaning: tuple[str, ...]
    """Methods whose slopes lean on the prediction of a filter."""
    number: NDArray[np.int64]
    """Index into labels for each number in telemetry; -1: not in a closed loop."""
    reference: int
    settle_frames: tuple[int, ...]
    """Frames of each turn in which the method before still counts: for filters, which begin anew,
    100; for integrators the delay, and three times one over the smallest loop gain of the recording."""
    centroid_gain: float
    """Stated in [control]."""

    @classmethod
    def of(cls, telemetry: Telemetry, control: RecordedControl) -> RecordedMethods:
        """Return the methods of a recording."""
        names = [str(name) for name in telemetry.attributes.get("methods") or [_SET]]
        seen = np.unique(telemetry.method[telemetry.loop == CLOSED_LOOP])
        names += [f"method {number}" for number in range(len(names), int(seen.max(initial=-1)) + 1)]
        labels = tuple(dict.fromkeys(names[number] for number in seen))
        number = np.full(len(names), -1)
        number[seen] = [labels.index(names[each]) for each in seen]
        split, usual_control = map(split_control, labels), control.options.controller
        parts = [(part or _SET, kind or usual_control) for part, kind in split]
        measured = list(dict.fromkeys(part for part, _ in parts))
        usual = _estimator(str(telemetry.attributes.get("settings", "")))
        predicted = [
            label
            for label, (part, kind) in zip(labels, parts, strict=True)
            if kind == KALMAN and _takes_prior(part, usual)
        ]
        gains = [
            change["changes"][_GAIN]
            for change in telemetry.changes
            if isinstance(change.get("changes", {}).get(_GAIN), int | float)
        ]
        least_gain = max(min([control.options.gain, *gains]), 1e-3)
        of_integrator = int(control.options.delay_frames) + math.ceil(_TIMES / least_gain)
        return cls(
            labels,
            tuple(f"{_in_words(part)}; {CONTROLS[kind]}" for part, kind in parts),
            tuple(_strength(part) for part, _ in parts),
            tuple(measured.index(part) for part, _ in parts),
            tuple(predicted),
            number,
            labels.index(_NONE) if _NONE in labels else 0,
            tuple(of_integrator if kind == INTEGRATOR else _FILTER_FRAMES for _, kind in parts),
            float(control.options.centroid_gain),
        )


def conditions_of(telemetry: Telemetry) -> tuple[NDArray[np.int64], list[str]]:
    """Return the number of the conditions of each frame, (frames,), and their names.

    They change with settings that all methods share and with the loop gain, not with the flux or the methods.
    """
    names, frames, gain = ["as begun"], [], None
    known = {*option_names(), "estimator"} - {_FLUX}
    for change in telemetry.changes:
        values = change.get("changes", {})
        new = {name: value for name, value in values.items() if name in known}
        if _GAIN in values:
            if gain is not None and values[_GAIN] != gain:
                new[_GAIN] = values[_GAIN]
            gain = values[_GAIN]
        if new:
            frames.append(int(change["frame"]))
            names.append("; ".join(f"{name} = {str(value)[:40]}" for name, value in new.items()))
    order = np.argsort(frames, kind="stable")
    number = np.searchsorted(np.array(frames, np.int64)[order], telemetry.frame, side="right")
    return number.astype(np.int64), [names[0], *(names[1 + place] for place in order)]


def _estimator(settings: str) -> str:
    """Return the estimator of settings in TOML."""
    table = parse_text(settings, "settings").get("estimator", {}) if settings else {}
    return str(table.get("name", "")) if isinstance(table, dict) else ""


def _takes_prior(measured: str, usual: str) -> bool:
    """Return whether an estimator uses predicted slopes as its prior."""
    name = measured.partition("+")[0].partition(":")[0]
    kind = estimators().get(name if name in estimators() else usual)
    return kind is not None and kind.takes_prior


def _strength(measured: str) -> float:
    """Return the strength of TV that a method's name states."""
    first, *others = measured.split("+")
    name, _, value = first.partition(":")
    options = dict(part.split("=", 1) for part in [first, *others] if "=" in part)
    text = value if name == _TV else options.get(_STRENGTH, "")
    try:
        return float(text)
    except ValueError:
        return math.nan


def _in_words(measured: str) -> str:
    if measured == _SET:
        return "settings of the engine"
    if measured == _NONE:
        return "settings of the engine, without denoising"
    return measured.replace("+", ", ")


_COLUMNS = (2, 3)


@dataclass(frozen=True, eq=False)
class MeasuredStrehl:
    """Strehl ratios of exposures, in the order of time."""

    time_s: Floats
    """Unix time of the middle of each exposure."""
    strehl: Floats
    exposure_s: Floats

    def of_interval(self, begin_s: float, end_s: float) -> Floats:
        """Return the Strehl ratios of the exposures that lie within an interval of Unix time."""
        first, last = np.searchsorted(self.time_s, [begin_s, end_s])
        near = slice(int(first), int(last))
        half = self.exposure_s[near] / 2
        within = (self.time_s[near] - half >= begin_s) & (self.time_s[near] + half <= end_s)
        return np.asarray(self.strehl[near][within])


def read_strehl(path: str | Path) -> MeasuredStrehl:
    """Read a table: Unix time of the middle [s], Strehl ratio, and perhaps the duration [s] of exposures.

    A first line of names is skipped.

    Raises
    ------
    InputError
        When the file cannot be read, or values are missing or out of range.
    """
    table = read_array(path).astype(np.float64)
    if table.ndim != 2 or table.shape[1] not in _COLUMNS:
        raise InputError(
            f"{path}: expected the columns time_s, strehl and perhaps exposure_s, got shape {table.shape}"
        )
    wrong = np.flatnonzero(~np.isfinite(table).all(axis=1) | (table[:, 1] < 0) | (table[:, 1] > 1))
    if len(wrong):
        raise InputError(
            f"{path}: expected finite times and Strehl ratios from 0 to 1, got "
            f"{', '.join(f'{value:g}' for value in table[wrong[0]])}"
        )
    table = table[np.argsort(table[:, 0], kind="stable")]
    exposure_s = table[:, 2] if table.shape[1] == _COLUMNS[1] else np.zeros(len(table))
    if (exposure_s < 0).any():
        raise InputError(f"{path}: exposure_s: expected 0 or more, got {exposure_s.min():g}")
    return MeasuredStrehl(table[:, 0], table[:, 1], exposure_s)
