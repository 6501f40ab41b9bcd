"""Slopes and images of a simulated loop, in the form that advice uses for a running one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintspot.advice.centroid_gain import electrons_of
from faintspot.advice.loop_telemetry import LoopTelemetry, without_priors
from faintspot.ao_loop.arms import Arm
from faintspot.ao_loop.camera import camera_calibration
from faintspot.ao_loop.configuration import LoopConfiguration
from faintspot.ao_loop.control import prior_std_px
from faintspot.ao_loop.record import LoopRecord
from faintspot.ao_loop.telescope_model import TelescopeModel


def seen_in_record(record: LoopRecord, arms: Sequence[Arm]) -> LoopTelemetry:
    """Return the slopes of a simulated loop after settling, divided by the centroid gain as in the loop."""
    held = record.commands.astype(np.float64) @ record.interaction_matrix.T
    later, arm = record.delay_frames - 1, record.arm.astype(np.int64)
    expected = np.zeros_like(held)
    expected[: len(held) - later] = held[: len(held) - later] - held[later:]
    predicts = np.array([each.predict_prior for each in arms])[arm]
    expected[~predicts] = 0.0
    divisor = np.where(record.corrected, record.centroid_gain, 1.0)[arm][:, None]
    priors = [prior_std_px(each, held.shape[1]) for each in arms]
    slopes, error = (each / divisor for each in (record.slopes_px, record.standard_error_px))
    alone = without_priors(slopes.astype(np.float64), error.astype(np.float64), expected, arm, priors)
    turn = np.concatenate([[0], np.cumsum(np.diff(arm) != 0)])
    seen = LoopTelemetry(arm, turn, *alone, held, record.frame_rate_hz)
    return seen.chosen(record.scored & (np.arange(record.frames) < record.frames - later))


def frames_of_record(record: LoopRecord, numbers: Sequence[int]) -> NDArray[np.float32]:
    """Return frames of a run, (images, h, w) electrons, simulated again from the mirror's commands."""
    configuration = LoopConfiguration.from_text(record.configuration)
    telescope_model = TelescopeModel(configuration, record.seed, record.realisation)
    frames = []
    for number in numbers:
        time_s = (number + 0.5) / record.frame_rate_hz
        _, seen = telescope_model.wavefronts(time_s, record.commands[number].astype(np.float64))
        frames.append(telescope_model.frame(number, seen))
    return electrons_of(np.stack(frames), camera_calibration(configuration))
