"""What `faintspot telemetry` says of the recording that the filter learns from, beside the loop."""

from typing import Any

import numpy as np

from faintspot.base.statistics import paired_mean
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.telemetry.choices import AS_RUN, FILTER
from faintspot.loop.telemetry.report import report_of_loop


def reported(recording: Recording, scores: dict[str, list[float]], r0_m: float) -> dict[str, Any]:
    """Return the recommended control, what it saves, whether it is the best in the loop, and r0.

    Parameters
    ----------
    recording : Recording
    scores : dict
        Strehl ratios of the integrator and of the filter.
    r0_m : float
        True value.
    """
    report = report_of_loop(recording)
    known = {value.name: value for value in report.parts["turbulence"].values}
    choices = [choice for choice in report.choices if choice.name != AS_RUN]
    best = max(choices, key=lambda choice: np.nan_to_num(choice.less.value, nan=-np.inf))
    kind = FILTER if best.name == FILTER else "integrator"
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
