"""Controllers replayed on a recorded tip-tilt loop of a telescope.

They learn on its first half, within which gains and the options of pyRTC's predictor (`pip install pyrtcao`,
GPL-3) are tuned, and are scored on the second; the learnt control runs as in a loop, with its guard. The
recording (telemetry/keck_tt of the public repository aditya-sengupta/tip-tilt-control) lies in the folder
keck_tt of FAINTSPOT_SHARED.
"""

import importlib.util
import os
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

import faintspot as fs
from benchmarks.loops.prediction import Make, rivals
from benchmarks.measuring import Row, Table
from faintspot.base.statistics import mean_by_blocks
from faintspot.loop.control.base import OpenLoopTelemetry, replayed_frames
from faintspot.loop.control.identification.learning import GAINS
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import open_loop_of
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import ARCSEC

Floats = NDArray[np.float64]

RATE_HZ, DIAMETER_M, LEAK = 1000.0, 10.0, 0.01
DELAYS = 2, 1, 3
"""The recording does not tell which: its commands are small and slow."""
TUNED_FRAMES, SETTLE, BLOCK = 4000, 100, 1000
_NM = ARCSEC * DIAMETER_M / 4 * 1e9
"""Rms of the wavefront of a tilt of 1 arcsec."""


def recording() -> Recording:
    """Return centroids and commands, which are subtracted from the turbulence."""
    folder = Path(os.environ.get("FAINTSPOT_SHARED", "")) / "keck_tt"
    slopes, commands = (
        np.load(folder / f"{name}_n0088.npy").astype(np.float64) for name in ("Centroid", "Commands")
    )
    return Recording(slopes, -commands, np.eye(2), None, RATE_HZ, slope_unit="arcsec")


def run() -> list[Table]:
    """Score the loop as it ran, a tuned integrator, least squares and the learnt control."""
    return [_replayed(delay) for delay in DELAYS]


def _replayed(delay: int) -> Table:
    """Score them with open-loop slopes and mirrors of one delay."""
    loop = recording()
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
    left = {"as it ran": np.square(seen.residual[half:]).sum(axis=1)}
    for name, make in makes.items():
        left[name] = replayed_frames(make, second, np.eye(2), phase, delay)
    control = fs.control.learn(
        Recording(loop.slopes[:half], loop.commands[:half], np.eye(2), None, RATE_HZ, delay_frames=delay)
    )
    left["learnt, guarded"], predicting = _driven(control, second, delay)
    power = welch(loop.slopes, nperseg=4096, axis=0)
    noise = float(power[1][power[0] > 0.3].mean(axis=0).sum()) / 2
    rows = []
    for name, values in left.items():
        mean = mean_by_blocks(values[SETTLE:], BLOCK)
        less = mean_by_blocks((values - left["integrator"])[SETTLE:], BLOCK)
        columns = {
            "rms (mas)": 1e3 * mean.value**0.5,
            "error": 1e3 * mean.standard_error / (2 * mean.value**0.5),
            "without noise (nm)": _NM * max(mean.value - noise, 0.0) ** 0.5,
            "variance minus the integrator's": less.value / mean.value,
            "its error": less.standard_error / mean.value,
        }
        rows.append(Row(name, columns))
    note = f"noise of {1e3 * noise**0.5:.3g} mas included in mas; delay of {delay} frames assumed"
    title = f"A recorded tip-tilt loop, replayed with a delay of {delay} frames"
    notes = [note, control.summary(), f"the filter drives in {predicting:.0%} of the frames"]
    return Table(f"recorded-tip-tilt-{delay}", title, rows, notes)


def _driven(
    control: fs.control.PredictiveControl, open_loop: OpenLoopTelemetry, delay: int
) -> tuple[Floats, float]:
    """Return the squared residual that a control leaves, and the part of frames that its filter drives."""
    sent, squares, predicting = [np.zeros(2)] * delay, [], 0
    for slopes in open_loop.open_loop_px:
        residual = slopes + sent.pop(0)
        squares.append(float(residual @ residual))
        sent.append(control(residual))
        predicting += control.is_predicting
    return np.array(squares), predicting / len(squares)
