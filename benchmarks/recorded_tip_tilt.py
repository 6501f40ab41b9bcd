"""Controllers replayed on a recorded tip-tilt loop of a telescope.

They learn on its first half, within which gains and the options of pyRTC's predictor (`pip install pyrtcao`,
GPL-3) are tuned, and are scored on the second. The recording (telemetry/keck_tt of the public repository
aditya-sengupta/tip-tilt-control) lies in the folder keck_tt of FAINTSPOT_SHARED.
"""

from __future__ import annotations

import importlib.util
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measuring import Row, Table
from benchmarks.prediction import Make, rivals
from faintspot.base.statistics import mean_by_blocks
from faintspot.loop.control.identification.learning import GAINS, learn_controller
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import open_loop_of, site_of_loop
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.control.replay import replayed_frames

RATE_HZ, DIAMETER_M, LEAK = 1000.0, 10.0, 0.01
DELAYS = 2, 1, 3
"""The recording does not tell which: its commands are small and slow."""
TUNED_FRAMES, SETTLE, BLOCK = 4000, 100, 1000


def recording() -> Recording:
    """Return centroids and commands, which are subtracted from the turbulence."""
    folder = Path(os.environ.get("FAINTSPOT_SHARED", "")) / "keck_tt"
    slopes, commands = (
        np.load(folder / f"{name}_n0088.npy").astype(np.float64) for name in ("Centroid", "Commands")
    )
    known: dict[str, Any] = {"subaperture_m": DIAMETER_M, "pixel_scale_arcsec": 1.0, "slope_unit": "arcsec"}
    return Recording(slopes, -commands, np.eye(2), np.zeros((1, 2)), RATE_HZ, **known)


def run() -> list[Table]:
    """Score the loop as it ran, a tuned integrator, least squares and the learnt filter."""
    return [_replayed(delay) for delay in DELAYS]


def _replayed(delay: int) -> Table:
    """Score them with open-loop slopes and mirrors of one delay."""
    loop = recording()
    site = site_of_loop(loop)
    seen = open_loop_of(loop, LoopDelay(delay, 0.0, 1.0, 0.0))
    half = len(seen.telemetry) // 2
    first, second = seen.telemetry.part(0, half), seen.telemetry.part(half, len(seen.telemetry))
    tuning = first.part(half - TUNED_FRAMES, half)
    plant, phase = LoopPlant(np.eye(2), make_reconstructor(np.eye(2)), delay, LEAK), np.eye(2)

    def best(candidates: list[Make]) -> Make:
        return min(candidates, key=lambda each: plant.residual(each, tuning, phase))

    makes: dict[str, Make] = {"integrator": best([partial(plant.integrator, gain) for gain in GAINS])}
    if importlib.util.find_spec("pyrtc"):
        earlier = first.part(0, half - TUNED_FRAMES)
        makes["least_squares"] = best(list(rivals("least_squares", plant, earlier)))
    learnt = learn_controller(plant, first, site, RATE_HZ)
    makes["learnt"] = partial(learnt.controller, plant)
    makes["learnt, guarded"] = partial(learnt.guarded, plant)
    left = {"as it ran": np.square(seen.residual[half:]).sum(axis=1)}
    for name, make in makes.items():
        left[name] = replayed_frames(make, second, np.eye(2), phase, delay)
    rows = []
    for name, values in left.items():
        mean = mean_by_blocks(values[SETTLE:], BLOCK)
        less = mean_by_blocks((values - left["integrator"])[SETTLE:], BLOCK)
        columns = {
            "rms (mas)": 1e3 * mean.value**0.5,
            "error": 1e3 * mean.standard_error / (2 * mean.value**0.5),
            "variance minus the integrator's": less.value / mean.value,
            "its error": less.standard_error / mean.value,
        }
        rows.append(Row(name, columns))
    noise = 1e3 * float(np.sqrt(seen.variance.sum()))
    note = f"noise of {noise:.3g} mas included; delay of {delay} frames assumed"
    title = f"A recorded tip-tilt loop, replayed with a delay of {delay} frames"
    return Table(f"recorded-tip-tilt-{delay}", title, rows, [note, learnt.description])
