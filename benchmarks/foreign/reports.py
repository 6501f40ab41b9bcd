"""What `faintspot telemetry` says of the recording that the filter learns from, beside the loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.statistics import paired_mean
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.models import LoopPlant
from faintspot.loop.control.identification.models.modal import Modal
from faintspot.loop.control.identification.open_loop import measured_delay, open_loop_of, site_of_loop
from faintspot.loop.control.identification.recording import Recording, prepared
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.telemetry.choices import AS_RUN, FILTER, MODES
from faintspot.loop.telemetry.report import report_of_loop

_LEAK = 0.01


def modal_matrix(recording: Recording) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the matrix (commands, 2 n) of an integrator with a learnt gain for each mode."""
    loop = prepared(recording).recording
    delay = measured_delay(loop)[1]
    reconstructor = make_reconstructor(loop.interaction_matrix)
    plant = LoopPlant(loop.interaction_matrix, reconstructor, max(1, round(delay.delay_frames)), _LEAK)
    slopes = open_loop_of(loop, delay).telemetry
    model = learn_controller(Modal, plant, slopes, site_of_loop(loop), loop.frame_rate_hz)
    modes = reconstructor.modes * model.arrays["gains"]
    return np.asarray(modes @ reconstructor.modes.T @ reconstructor.matrix / delay.gain / loop.unit)


def reported(recording: Recording, scores: dict[str, list[float]], r0_m: float) -> dict[str, Any]:
    """Return the recommended control, what it saves, whether it is the best in the loop, and r0.

    Parameters
    ----------
    recording : Recording
    scores : dict
        Strehl ratios of the integrator, of modal gains and of the filter.
    r0_m : float
        True value.
    """
    report = report_of_loop(recording)
    known = {value.name: value for value in report.parts["turbulence"].values}
    choices = [choice for choice in report.choices if choice.name != AS_RUN]
    best = max(choices, key=lambda choice: np.nan_to_num(choice.less.value, nan=-np.inf))
    kind = best.name if best.name in (FILTER, MODES) else "integrator"
    r0 = known.get("r0 at 500 nm")
    vibrations = report.parts["vibrations"].values
    return {
        "advice": report.advice,
        "missing": {name: part.missing for name, part in report.parts.items() if part.missing},
        "best": kind,
        "saves": [best.less.value, *best.less.interval],
        "is_best": kind == max(scores, key=lambda name: np.mean(scores[name])),
        "ahead_in_loop": {
            name: paired_mean(np.array(scores[kind]) - np.array(values)).value
            for name, values in scores.items()
        },
        "r0": [r0.value, r0.error, r0_m] if r0 is not None else None,
        "turbulence": {name: [value.value, value.error] for name, value in known.items()},
        "vibrations": [[value.name, value.value, value.error] for value in vibrations],
    }
