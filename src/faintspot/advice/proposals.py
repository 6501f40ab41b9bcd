"""What may be better than the settings of a running loop, and what it would gain."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.advice.centroid_gain import calibration_of_electrons, shifted_gain
from faintspot.advice.seen import Seen
from faintspot.base.errors import InputError
from faintspot.control.learnt import Plant
from faintspot.control.telemetry import Telemetry, replayed
from faintspot.estimators.base import Need
from faintspot.estimators.window import Window
from faintspot.experiments.question import Question
from faintspot.experiments.statistics import Estimate, paired_mean
from faintspot.experiments.tuning import tune
from faintspot.pipeline.settings import Settings
from faintspot.pipeline.slope_pipeline import SlopePipeline
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.spots.psf import PSF
from faintspot.spots.score import Score

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

GAINS = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
"""Loop gains that are tried on telemetry."""
_PARTS = 5  # of telemetry, whose scatter says an error
_FEWEST_OF_PART = 100  # frames
_SETTLE = 30  # of them, in which the loop closes
_LIGHT_TOLERANCE = 0.1  # of the light, within which it need not be told anew
_SPOTS, _FLUX_STEPS = 1024, 1  # of the planner's simulation
_RANGES_PX = (1.0, 4.0)  # of spots in a closed loop


@dataclass(frozen=True)
class Proposal:
    """A change of settings, or of the loop gain."""

    changes: dict[str, Any]
    """New settings by name; empty where the gain is changed."""
    gain: float | None
    """New loop gain; None: as it is."""
    promise: str
    """What it would gain, in words, with errors."""

    @property
    def text(self) -> str:
        """As `faintspot realtime interleave` takes it; of a gain in words."""
        if self.gain is not None:
            return f"gain {self.gain:g}"
        return "+".join(f"{name}={_written(value)}" for name, value in self.changes.items())


@dataclass(frozen=True, eq=False)
class Sensor:
    """What is known of the sensor that is not settings."""

    layout: Layout
    calibration: Calibration
    psf: PSF | None
    score: Score | None
    reference: Floats | None
    """(2 n,) slopes that are subtracted."""

    def pipeline(self, settings: Settings) -> SlopePipeline:
        """Return the pipeline with some settings, for frames in electrons."""
        plain = calibration_of_electrons(self.calibration)
        return SlopePipeline(
            self.layout, settings, plain, self.reference, psf=self.psf, score=self.score, threads=1
        )


def new_light(settings: Settings, light: float, error: float) -> Proposal | None:
    """Propose to tell the estimator the light that was measured, where it is another than it was told."""
    if not settings.estimator.uses_light or not light > 0:
        return None
    told = settings.flux_e
    if told is not None:
        before = float(np.mean(told))
        if abs(light - before) < max(_LIGHT_TOLERANCE * before, 3 * error):
            return None
    return Proposal({"flux_e": float(f"{light:.3g}")}, None, f"the light is {light:.3g} +- {error:.2g} e-")


def new_gain(
    seen: Seen, plant: Plant, modes: Floats, gain: float, unit: str, centroid_gain: float = 1.0
) -> Proposal | None:
    """Propose the loop gain that would have left least of what was seen, if it is another one.

    The recorded open-loop slopes, noise included, are sent through an integrator of every gain; what is left
    is larger by the same noise for all of them.

    Parameters
    ----------
    seen : Seen
        Of one arm.
    plant : Plant
    modes : (k, m) array
    gain : float
        Of the loop that was seen.
    unit : str
        Of the modes.
    centroid_gain : float
        By which slopes grow with the spots' motion.
    """
    parts = _parts_without_gaps(seen, centroid_gain)
    if len(parts) < 2:
        return None
    tried = sorted({*GAINS, gain})
    left = np.array(
        [[_left(plant, each * centroid_gain, part, modes) for part in parts] for each in tried]
    )  # (gains, parts)
    best = int(np.argmin(left.mean(axis=1)))
    present = tried.index(gain)
    if best == present:
        return None
    gained = paired_mean(left[present] - left[best])
    if not gained.value > gained.standard_error:
        return None
    return Proposal(
        {},
        tried[best],
        f"would have left {gained.value:.3g} +- {gained.standard_error:.2g} ({unit})^2 less of what was seen",
    )


def _left(plant: Plant, gain: float, part: Telemetry, modes: Floats) -> float:
    """Return the mean square wavefront that an integrator would have left."""
    make = partial(plant.integrator, gain)
    return len(modes) * replayed(make, part, plant.interaction, modes, plant.delay_frames, _SETTLE)


def _parts_without_gaps(seen: Seen, centroid_gain: float) -> list[Telemetry]:
    """Return stretches of equal length, each from one turn, in true pixels."""
    lengths = np.bincount(seen.turn - seen.turn.min())
    length = max(_FEWEST_OF_PART, int(lengths.max()) // _PARTS)
    parts = []
    for turn in np.unique(seen.turn):
        rows = np.flatnonzero(seen.turn == turn)
        for start in range(0, len(rows) - length + 1, length):
            part = rows[start : start + length]
            air = seen.slopes_px[part] / centroid_gain - seen.held_px[part]
            parts.append(Telemetry(air, seen.variance_px2[part] / centroid_gain**2, seen.trust[part]))
    return parts


def new_estimators(
    settings: Settings,
    sensor: Sensor,
    frames_e: NDArray[np.float32],
    light: float,
    psf: PSF | None,
    residual_px: float,
    centroid_gain: float = 1.0,
    progress: Progress | None = None,
) -> list[Proposal]:
    """Propose the fixed window, and the estimator that the planner finds best for this light.

    Parameters
    ----------
    settings : Settings
        That run.
    sensor : Sensor
    frames_e : (images, h, w) array
        For the window's centroid gain.
    light : float
        Electrons of a sub-aperture in a frame.
    psf : PSF, optional
        Learnt from the images; else the sensor's.
    residual_px : float
        Rms of the slopes that the loop leaves, which says how far spots are from their reference.
    centroid_gain : float
        By which the slopes of the estimator that runs grow with the spots' motion; a window is told a gain of
        its own that makes its slopes as large, so that the loop's gain stays what it is.
    progress : callable, optional
        As of `faintspot.experiments.tune`.

    Returns
    -------
    list of Proposal
        With what the planner promises: slope errors in its simulated spots.
    """
    seen_psf = sensor.psf if psf is None else psf
    calibration = sensor.calibration
    if seen_psf is None or calibration.read_noise_e is None:
        return []
    question = Question(
        read_noise_e=calibration.read_noise_e,
        em_gain=calibration.em_gain,
        background_e=calibration.background_e,
        layout=sensor.layout,
        psf=seen_psf,
        flux_e=light,
        search_range_px=float(np.clip(2 * residual_px, *_RANGES_PX)),
    )
    answer = tune(question, realisations=_SPOTS, steps=_FLUX_STEPS, progress=progress)
    present = settings.estimator.name
    before = next((each for each in answer.results if each.arm.name == present), None)
    proposals = []
    for name in dict.fromkeys((Window.name, *answer.equal[:1])):
        if name == present:
            continue
        found = answer[name]
        changes = {"estimator": name, **found.settings.estimator.chosen()}
        changes = {key: value for key, value in changes.items() if value is not None}
        if found.settings.estimator.uses_light:
            changes["flux_e"] = float(f"{light:.3g}")
        fitting = _with_gain(settings, changes, sensor, frames_e, centroid_gain)
        if fitting is None:
            continue
        rms = found.statistics.corrected_rms
        promise = f"slope error {_plus_minus(rms)} px in simulated spots"
        if before is not None:
            promise += f", {present} at its best {_plus_minus(before.statistics.corrected_rms)}"
        proposals.append(Proposal(fitting, None, promise))
    return proposals


def _with_gain(
    settings: Settings,
    changes: dict[str, Any],
    sensor: Sensor,
    frames_e: NDArray[np.float32],
    centroid_gain: float,
) -> dict[str, Any] | None:
    """Tell a window its centroid gain on the spots that were recorded; None: it does not fit the sensor."""
    try:
        candidate = settings.replace(**changes)
        if Need.SCORE in candidate.estimator.needs and sensor.score is None:
            return None
        if not isinstance(candidate.estimator, Window):
            sensor.pipeline(candidate)
            return changes
        gain = shifted_gain(sensor.pipeline(candidate.replace(centroid_gain=1.0)), frames_e)
    except InputError:
        return None
    if gain is None or not gain.value > 0.01:
        return changes
    return {**changes, "centroid_gain": float(f"{gain.value / centroid_gain:.3g}")}


def _plus_minus(value: Estimate) -> str:
    if not math.isfinite(value.value):
        return "unbounded"
    return f"{value.value:.3f} +- {value.standard_error:.3f}"


def _written(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, np.ndarray | list | tuple):
        return ",".join(_written(each) for each in np.asarray(value).tolist())
    return str(value)
