"""Measurements of star, camera, turbulence and loop from telemetry of a closed loop, and their journal."""

from __future__ import annotations

import json
import math
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.files import derived, parse_json, write_atomically
from faintspot.base.statistics import Estimate, mean_by_blocks
from faintspot.base.toml_files import parse_text
from faintspot.engine.loop.control_loop import CLOSED
from faintspot.engine.requests.private_socket import socket_path
from faintspot.engine.requests.requests import LENGTHY_TIMEOUT_S, request
from faintspot.engine.telemetry.ring import TelemetryReader
from faintspot.io.telemetry.recording import Telemetry, stored_names
from faintspot.loop.control.configuration import Control, load_control, prior_std_px
from faintspot.loop.telemetry.centroid_gain import calibration_of_electrons, electrons_of, shifted_gain
from faintspot.loop.telemetry.engine_telemetry import seen_in_telemetry
from faintspot.loop.telemetry.measured import Measured, of_atmosphere, of_images
from faintspot.loop.telemetry.residual import residual_wavefront, wavefront_modes
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.pipeline.settings import Settings, option_names
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout

Floats = NDArray[np.float64]
JOURNAL = ".advice.json"
"""Ending of the journal's name, after the configuration's."""
_MOST_ENTRIES = 1000
_BLOCK_FRAMES = 50
_LOOK_S = 0.05
_MOST_IMAGES = 400


@dataclass(frozen=True, eq=False)
class Loop:
    """A loop as described by its configuration, and the engine that runs it."""

    name: str
    control: Control
    layout: Layout
    calibration: Calibration
    written: Settings
    """Settings in the configuration."""
    known: dict[str, Any]
    """PSF, score and reference slopes for `SlopePipeline`."""

    @classmethod
    def load(cls, path: str | Path, name: str) -> Loop:
        """Load a configuration.

        Raises
        ------
        InputError
            When it has no [control], or cannot be read.
        """
        control = load_control(path)
        if control is None:
            raise InputError(f"{path}: expected a table [control]; `faintspot realtime calibrate` writes one")
        layout, settings, calibration, psf, score = configuration.load_all(path)
        control.check_fits(len(layout))
        known = {"psf": psf, "score": score, "reference": control.reference}
        return cls(name, control, layout, calibration, settings, known)

    def ask(self, command: str, **fields: Any) -> dict[str, Any]:
        """Send a request to the engine."""
        return request(socket_path(self.name), command, timeout_s=LENGTHY_TIMEOUT_S, **fields)

    def running(self, seconds: float, stop: threading.Event) -> tuple[Telemetry, Settings]:
        """Record telemetry of the running engine; return it with the engine's settings.

        Raises
        ------
        InputError
            When there is no engine, methods are interleaved, the loop is not closed, or the engine ends.
        """
        if len(self.ask("status")["methods"]) > 1:
            raise InputError(
                f"{self.name}: expected no interleaving; end it with faintspot realtime interleave set"
            )
        status = self.ask("loop", action="status")["loop"]
        if status["state"] != CLOSED:
            why = status.get("opened_because") or "this engine makes no commands"
            raise InputError(f"{self.name}: expected a closed loop, it is {status['state']}: {why}")
        telemetry = _watched(self.name, seconds, stop)
        values = self.ask("get", names=None)["settings"]
        given = {name: value for name, value in values.items() if value is not None}
        return telemetry, Settings(given.pop("estimator"), **given)

    def centroid_gain(self, settings: Settings, frames_e: NDArray[np.float32]) -> Estimate | None:
        """Return the ratio of slopes to the spots' motion, after the control's own correction."""
        plain = calibration_of_electrons(self.calibration)
        pipeline = SlopePipeline(self.layout, settings, plain, threads=1, **self.known)
        found = shifted_gain(pipeline, frames_e, prior_std_px(settings, self.layout))
        divisor = self.control.options.centroid_gain
        if found is None:
            return None
        return Estimate(found.value / divisor, found.standard_error / divisor, count=found.count)


@dataclass(frozen=True, eq=False)
class Advice:
    """Measurements of a closed loop."""

    frames: int
    known: list[Measured]

    def entry(self, name: str) -> dict[str, Any]:
        """Return the advice as plain values for the journal."""
        return {
            "unix_time_s": time.time(),
            "name": name,
            "frames": self.frames,
            "known": [
                {"name": each.name, "value": _plain(each.value), "error": _plain(each.error)}
                | {"unit": each.unit, "remark": each.remark}
                for each in self.known
            ],
        }


def advise(loop: Loop, telemetry: Telemetry, settings: Settings) -> Advice:
    """Measure flux, noise, spots, centroid gain, turbulence and residual wavefront error from telemetry.

    Parameters
    ----------
    loop : Loop
    telemetry : faintspot.io.Telemetry
        Telemetry of a closed loop with constant settings.
    settings : Settings
        Settings in use.

    Raises
    ------
    InputError
        When the telemetry has no frames of a closed loop, or several interleaved methods.
    """
    methods = np.unique(telemetry.method)
    if not len(methods):
        raise InputError(f"{loop.name}: expected frames of a closed loop, got none")
    if len(methods) != 1:
        raise InputError(f"telemetry: expected a single method, found {len(methods)} interleaved")
    layout = loop.layout
    seen = seen_in_telemetry(telemetry, loop.control, prior_std_px(settings, layout))
    frames = electrons_of(telemetry.raw, loop.calibration)
    shifted = loop.centroid_gain(settings, frames)
    known = of_images(frames, layout, loop.calibration)
    gain_known = Measured("centroid gain", "", remark="too few images")
    if shifted is not None:
        remark = "relative to the gain that the control corrects"
        gain_known = Measured("centroid gain", "", shifted.value, shifted.standard_error, remark)
    gain = shifted.value if shifted is not None and shifted.value > 0 else 1.0
    modes, unit = wavefront_modes(layout)
    left = residual_wavefront(seen, modes, gain)
    return Advice(len(seen), [*known, gain_known, *of_atmosphere(seen, layout, gain), _residual(left, unit)])


def recorded_settings(telemetry: Telemetry, gain: float) -> tuple[Telemetry, Settings]:
    """Return a recording without a closed loop before its last change, and its last settings.

    Parameters
    ----------
    telemetry : faintspot.io.Telemetry
    gain : float
        Initial loop gain.
    """
    document = parse_text(telemetry.attributes["settings"], "settings of the recording")
    settings, first = Settings.from_tables("settings of the recording", document), -1
    for change in telemetry.changes:
        values = change["changes"]
        if values.get("gain") not in (None, gain):
            gain, first = values["gain"], max(first, change["frame"])
        if values and set(values) <= set(option_names()):
            settings = settings.replace(where=change["where"], **values)
            first = max(first, change["frame"])
    return replace(telemetry, loop=np.where(telemetry.frame > first, telemetry.loop, 0)), settings


def write_journal(path: str | Path, entry: dict[str, Any]) -> Path:
    """Add an entry to the journal beside a configuration; return the journal's path.

    Raises
    ------
    InputError
        When it cannot be written, or the path is something else.
    """
    place = derived(path, JOURNAL)
    entries: Any = []
    if place.exists():
        try:
            entries = parse_json(place.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            entries = None
        if not isinstance(entries, list):
            raise InputError(f"{place}: expected a journal of advice, found another file; move it away")
    text = json.dumps([*entries, entry][-_MOST_ENTRIES:], indent=1)
    write_atomically(place, text)
    return place


def _watched(name: str, seconds: float, stop: threading.Event) -> Telemetry:
    """Return telemetry of an engine from now on, for `seconds` or until `stop` is set."""
    reader = TelemetryReader.attach(name)
    try:
        cursors = [reader.records.written, reader.images.written]
        records: list[NDArray[Any]] = [np.empty(0, reader.records.kind)]
        images: list[NDArray[Any]] = [np.empty(0, reader.images.kind)]
        end, going_on = time.monotonic() + seconds, True
        while going_on:
            going_on = not stop.wait(_LOOK_S) and time.monotonic() < end
            some, cursors[0], _ = reader.records.since(cursors[0])
            records.append(some)
            if sum(map(len, images)) < _MOST_IMAGES:
                some, cursors[1], _ = reader.images.since(cursors[1])
                images.append(some)
            if reader.stale and not stop.is_set():
                raise InputError(f"{name}: the engine has ended")
        arrays = {
            field: np.concatenate([each[field] for each in parts])
            for parts in (records, images)
            for field in stored_names(parts[0].dtype)
        }
        return Telemetry(**arrays, changes=[], attributes=dict(reader.description))
    finally:
        reader.close()


def _residual(left: Floats, unit: str) -> Measured:
    """Return the rms of the residual wavefront error."""
    values = left[np.isfinite(left)]
    name = "residual wavefront error in the fitted modes"
    if not len(values):
        return Measured(name, unit, remark="too few frames")
    mean: Estimate = mean_by_blocks(values, _BLOCK_FRAMES)
    if not mean.value > 0:
        return Measured(name, unit, remark="less than its error")
    rms = math.sqrt(mean.value)
    return Measured(name, f"{unit} rms", rms, mean.standard_error / (2 * rms), "with the noise subtracted")


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
