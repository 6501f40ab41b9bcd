"""From telemetry to advice, from advice to what is tried, and the journal of both."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.advice.centroid_gain import electrons_of
from faintspot.advice.known import Known, of_air, of_images
from faintspot.advice.proposals import Progress, Proposal, Sensor, new_estimators, new_gain, new_light
from faintspot.advice.residual import residual_wavefront, wavefront_modes
from faintspot.advice.seen import seen_in_telemetry
from faintspot.advice.trial import Loop, Verdict, try_on
from faintspot.base.errors import InputError
from faintspot.base.files import derived, parse_json, write_atomically
from faintspot.control.configuration import load_control
from faintspot.control.learnt import INTEGRATOR
from faintspot.experiments.statistics import Estimate, mean_by_blocks
from faintspot.io.telemetry import Telemetry
from faintspot.pipeline import configuration
from faintspot.pipeline.settings import Settings

Floats = NDArray[np.float64]
JOURNAL = ".advice.json"
"""After the configuration's name."""
_MOST_ENTRIES = 1000
_BLOCK_FRAMES = 50


@dataclass(eq=False)
class Advice:
    """What telemetry tells, what may be better, and what has become of it."""

    frames: int
    known: list[Known]
    proposals: list[Proposal]
    verdicts: list[Verdict] = field(default_factory=list)
    """Of the proposals, in their order, as far as they were tried."""

    def entry(self, name: str, unit: str) -> dict[str, Any]:
        """Return it as plain values, for the journal."""
        entry: dict[str, Any] = {
            "unix_time_s": time.time(),
            "name": name,
            "frames": self.frames,
            "known": [
                {"name": each.name, "value": _plain(each.value), "error": _plain(each.error)}
                | {"unit": each.unit, "remark": each.remark}
                for each in self.known
            ],
            "proposals": [{"change": each.text, "promise": each.promise} for each in self.proposals],
        }
        for proposal, verdict in zip(entry["proposals"], self.verdicts, strict=False):
            difference = verdict.difference
            proposal["tried"] = {
                "leaves_more": _plain(difference.value),
                "error": _plain(difference.standard_error),
                "interval": [_plain(difference.low), _plain(difference.high)],
                "of": _plain(verdict.left),
                "unit": f"({unit})^2",
                "kept": verdict.kept,
                "words": verdict.in_words(unit),
            }
        return entry


def loop_of(path: str | Path, name: str) -> tuple[Loop, Settings]:
    """Return the loop that a configuration describes, and the settings in the file.

    Raises
    ------
    InputError
        When it has no [control], or cannot be read.
    """
    control = load_control(path)
    if control is None:
        raise InputError(f"{path}: expected a table [control], as of `faintspot realtime calibrate`")
    layout, settings, calibration, psf, score = configuration.load_all(path)
    control.check_fits(len(layout))
    modes, unit = wavefront_modes(layout)
    sensor = Sensor(layout, calibration, psf, score, control.reference)
    return Loop(name, control, sensor, modes, unit), settings


def advise(
    loop: Loop,
    telemetry: Telemetry,
    settings: Settings,
    gain: float | None,
    progress: Progress | None = None,
) -> Advice:
    """Say what telemetry of a closed loop tells, and what may be better.

    Parameters
    ----------
    loop : Loop
    telemetry : faintspot.io.Telemetry
        Of one arm.
    settings : Settings
        With which it was measured.
    gain : float, optional
        The loop gain; None where the controller has none.
    progress : callable, optional
        Called with the planner's finished steps and all of them.

    Raises
    ------
    InputError
        For telemetry that tells nothing of a closed loop.
    """
    arms = np.unique(telemetry.arm)
    if not len(arms):
        raise InputError(f"{loop.name}: expected frames of a closed loop, none came")
    if len(arms) != 1:
        raise InputError(f"telemetry: expected one state of the settings, found {len(arms)} in turn")
    sensor, layout = loop.sensor, loop.sensor.layout
    prior = loop.prior_px(settings)
    seen = seen_in_telemetry(telemetry, loop.control, [prior] * (int(arms[0]) + 1))
    frames = electrons_of(telemetry.raw, sensor.calibration)
    shifted = loop.centroid_gain(settings, frames)
    known, psf = of_images(frames, layout, sensor.calibration)
    gain_known = Known("centroid gain", "", remark="too few images")
    if shifted is not None:
        remark = "over the one that the control divides by"
        gain_known = Known("centroid gain", "", shifted.value, shifted.standard_error, remark)
    gains = [shifted.value if shifted is not None and shifted.value > 0 else 1.0] * (int(arms[0]) + 1)
    left = residual_wavefront(seen, loop.modes, gains)
    known += [gain_known, *of_air(seen, layout, gains), _residual(left, loop.unit)]
    light = known[0]
    proposals: list[Proposal | None] = []
    if math.isfinite(light.value):
        proposals.append(new_light(settings, light.value, light.error))
    if gain is not None and loop.control.options.controller == INTEGRATOR:
        proposals.append(new_gain(seen, loop.control.plant, loop.modes, gain, loop.unit, gains[0]))
    if math.isfinite(light.value):
        residual, _ = seen.weighted(gains)
        rms = float(np.sqrt(np.median(np.square(residual).mean(axis=1))))
        answers = gains[0] * loop.control.options.centroid_gain
        proposals += new_estimators(settings, sensor, frames, light.value, psf, rms, answers, progress)
    return Advice(len(seen), known, [each for each in proposals if each is not None])


def apply(
    loop: Loop, advice: Advice, seconds: float, stop: threading.Event, say: Callable[[str], None]
) -> None:
    """Try the proposals on the running loop, one after the other; each builds on those that were kept.

    Raises
    ------
    InputError
        When the engine ends or is not as it is expected.
    """
    for proposal in advice.proposals:
        if stop.is_set():
            return
        say(f"trying {proposal.text} for at most {seconds:g} s")
        verdict = try_on(loop, proposal, seconds, stop)
        advice.verdicts.append(verdict)
        say(f"  {verdict.in_words(loop.unit)}")


def write_journal(path: str | Path, entry: dict[str, Any]) -> Path:
    """Add an entry to the journal beside a configuration; return the journal's place.

    Raises
    ------
    InputError
        When it cannot be written, or something else is there.
    """
    place = derived(path, JOURNAL)
    entries: Any = []
    if place.exists():
        try:
            entries = parse_json(place.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            entries = None
        if not isinstance(entries, list):
            raise InputError(f"{place}: expected a journal of advice; move it away")
    text = json.dumps([*entries, entry][-_MOST_ENTRIES:], indent=1)
    write_atomically(place, text)
    return place


def _residual(left: Floats, unit: str) -> Known:
    """Return the rms of the residual wavefront."""
    values = left[np.isfinite(left)]
    name = "residual wavefront, what the modes see of it"
    if not len(values):
        return Known(name, unit, remark="too few frames")
    mean: Estimate = mean_by_blocks(values, _BLOCK_FRAMES)
    if not mean.value > 0:
        return Known(name, unit, remark="less than its error")
    rms = math.sqrt(mean.value)
    return Known(name, f"{unit} rms", rms, mean.standard_error / (2 * rms), "the noise taken off")


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
