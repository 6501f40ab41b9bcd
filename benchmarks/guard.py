"""Is a loop with the learnt filter ever worse than its integrator, whatever gain the filter believes in?

7 x 7 sub-apertures and 52 actuators in frozen von Karman turbulence of plane waves, with noise. The filter
learns from a recording of the integrator with a centroid gain that is wrong by a factor. Then both drive the
loop through the same turbulence with the same noise; what they leave counts from 1 s on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Row, Table
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.identification.open_loop import measured_delay
from faintspot.loop.control.identification.predictive_control import PredictiveControl, _learnt as learn_with
from faintspot.loop.control.identification.recording import Recording, prepared
from faintspot.loop.control.phase import residual_phase
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.turbulence.slope_covariance import ARCSEC, SlopeTurbulence
from faintspot.slopes.spots.von_karman import R0_WAVELENGTH_M, SPECTRUM

Floats = NDArray[np.float64]
Control = Callable[[Floats], Floats]

RATE_HZ, DELAY, LEAK, CENTROID_GAIN = 250.0, 2, 0.01, 0.6
FLUXES_E = 20.0, 60.0, 200.0, 1000.0
LOOP_GAINS = 0.3, 0.6, 1.0
FACTORS = 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0
"""Gain of the model in that of the loop."""
SEEDS = 11, 12, 13
"""Of the scored turbulence; the guard's limits were chosen on 1, 2 and 3."""
_LEARNING_SEED = 1000
LEARNING_FRAMES, FRAMES, SETTLED = 2000, 1000, 250
_SIDE_M, _PIXEL_ARCSEC, _WAVES = 0.6, 0.2, 1200
_WINDS_M_PER_S = (
    ((6.0, 20.0, 0.45), (9.0, 80.0, 0.25), (14.0, 150.0, 0.15), (22.0, 250.0, 0.15)),
    ((12.0, 45.0, 0.7), (25.0, 190.0, 0.3)),
    ((8.0, 300.0, 1.0),),
)
"""Speed, direction in degrees, and share of the layers in one realisation after the other."""


class Geometry(NamedTuple):
    """Sensor and mirror."""

    cells: NDArray[np.int64]
    interaction: Floats
    """Slopes, px, for a unit of the commands, which are the wavefront at corners."""
    phase: Floats
    """From slopes to amplitudes of the phase."""


@cache
def geometry() -> Geometry:
    """Return 36 sub-apertures of a round pupil with a hole, and the corners that they touch."""
    rows, columns = np.mgrid[:7, :7]
    edge = np.minimum(rows, 6 - rows) + np.minimum(columns, 6 - columns)
    cells = np.argwhere((edge >= 2) & (edge < 6))
    corners = np.unique((cells[:, None] + np.argwhere(np.ones((2, 2)))).reshape(-1, 2), axis=0)
    apart = corners - cells[:, None]
    inside = ((apart == 0) | (apart == 1)).all(axis=2)
    interaction = np.vstack([inside * (apart[..., axis] - 0.5) for axis in (1, 0)])
    phase = residual_phase(make_reconstructor(interaction).clean, interaction, cells)
    return Geometry(cells, interaction, phase)


def turbulence(winds: tuple[tuple[float, float, float], ...], seed: int, frames: int) -> Floats:
    """Return slopes, px, of frozen layers, each a sum of plane waves, (frames, 2 n)."""
    rng = np.random.default_rng(seed)
    positions, time = geometry().cells[:, ::-1] * _SIDE_M, np.arange(frames) / RATE_HZ
    total = np.zeros((frames, 2, len(positions)))
    low, high = np.log(0.02 / 25.0), np.log(4.0 / _SIDE_M)
    for speed, degrees, share in winds:
        size, angle = np.exp(rng.uniform(low, high, _WAVES)), rng.uniform(0, 2 * np.pi, _WAVES)
        wave = size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        power = SPECTRUM * 0.2 ** (-5 / 3) * (size**2 + 25.0**-2) ** (-11 / 6)
        variance = share * power * 2 * np.pi * size**2 * (high - low) / _WAVES
        amplitude = np.sqrt(variance) * np.sinc(wave * _SIDE_M).prod(axis=1)
        wind = speed * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        waves = amplitude * (rng.standard_normal(_WAVES) + 1j * rng.standard_normal(_WAVES))
        moving = np.exp(-2j * np.pi * np.outer(time, wave @ wind)) * waves
        placed = np.exp(2j * np.pi * wave @ positions.T)
        for axis in (0, 1):
            total[:, axis] += ((2j * np.pi * wave[:, axis] * moving) @ placed).real
    return total.reshape(frames, -1) * (R0_WAVELENGTH_M / (2 * np.pi) / (_PIXEL_ARCSEC * ARCSEC))


def noise_px(flux_e: float) -> float:
    """Return the noise of a slope of a window with 3 e- of read noise, roughly."""
    return float(np.hypot(1 / np.sqrt(flux_e), 9 / flux_e))


class Run(NamedTuple):
    """Loop that was driven through turbulence."""

    slopes: Floats
    commands: Floats
    residual: Floats
    """(frames,): phase variance of what is left, without noise."""
    predicting: Floats


def drive(control: Control, open_loop: Floats, flux_e: float, seed: int) -> Run:
    """Drive the loop through open-loop slopes."""
    interaction, phase = geometry().interaction, geometry().phase
    noise = noise_px(flux_e) * np.random.default_rng([seed, 1]).standard_normal(open_loop.shape)
    waiting = deque(np.zeros((DELAY, interaction.shape[1])))
    true, commands = np.empty_like(open_loop), np.empty((len(open_loop), interaction.shape[1]))
    predicting = np.zeros(len(open_loop))
    slopes = np.empty_like(open_loop)
    for frame, turbulent in enumerate(open_loop):
        true[frame] = turbulent + interaction @ waiting.popleft()
        slopes[frame] = CENTROID_GAIN * true[frame] + noise[frame]
        predicting[frame] = getattr(control, "is_predicting", False)
        commands[frame] = control(slopes[frame])
        waiting.append(commands[frame])
    return Run(slopes, commands, np.square(true @ phase.T).sum(axis=1), predicting)


class Integrator:
    """Integrator with a leak."""

    def __init__(self, gain: float) -> None:
        self._step = gain * make_reconstructor(geometry().interaction).matrix
        self._command = np.zeros(len(self._step))

    def __call__(self, slopes: Floats) -> Floats:
        """Return the command to send."""
        self._command = (1 - LEAK) * self._command - self._step @ slopes
        return self._command


@cache
def open_loop(realisation: int, seed: int, frames: int) -> Floats:
    """Return turbulence with the winds of a realisation."""
    return turbulence(_WINDS_M_PER_S[realisation % len(_WINDS_M_PER_S)], seed, frames)


@cache
def recorded(flux_e: float, loop_gain: float, realisation: int) -> Recording:
    """Return the recording of an integrator, from which the filter learns."""
    seed = _LEARNING_SEED + realisation
    run = drive(Integrator(loop_gain), open_loop(realisation, seed, LEARNING_FRAMES), flux_e, seed)
    rows = slice(100, None)
    known = {"subaperture_m": _SIDE_M, "pixel_scale_arcsec": _PIXEL_ARCSEC}
    where = geometry().interaction, geometry().cells, RATE_HZ
    return Recording(run.slopes[rows], run.commands[rows], *where, **known)


def learnt(flux_e: float, loop_gain: float, realisation: int, factor: float) -> PredictiveControl:
    """Return the filter that believes in a wrong centroid gain."""
    ready = prepared(recorded(flux_e, loop_gain, realisation))
    _, delay = measured_delay(ready.recording)
    return learn_with(ready, replace(delay, gain=factor * CENTROID_GAIN))


@dataclass
class Scored:
    """One guarded filter against the integrator."""

    ratio: float
    """Of the rms from 1 s on."""
    largest: float
    """Largest command in the limit."""
    predicting: float
    """Part of the frames from 1 s on that the filter drives the mirror."""


def scored(flux_e: float, loop_gain: float, realisation: int, factor: float, seed: int) -> Scored:
    """Drive the same turbulence with both."""
    control = learnt(flux_e, loop_gain, realisation, factor)
    air = open_loop(realisation, seed, FRAMES)
    guarded, plain = (drive(one, air, flux_e, seed) for one in (control, Integrator(loop_gain)))
    left = [float(run.residual[SETTLED:].mean()) for run in (guarded, plain)]
    return Scored(
        float(np.sqrt(left[0] / left[1])),
        float(np.abs(guarded.commands).max() / control.largest_command),
        float(guarded.predicting[SETTLED:].mean()),
    )


def run() -> list[Table]:
    """Score all gains of the model and of the loop at all fluxes."""
    return [
        Table(
            f"guard-{flux_e:g}",
            f"Guarded filter in the integrator, {flux_e:g} e-",
            [_row(flux_e, loop_gain, factor) for loop_gain in LOOP_GAINS for factor in FACTORS],
            [f"{len(SEEDS)} realisations with winds of their own, 3 s each, from 1 s on"],
        )
        for flux_e in FLUXES_E
    ]


def _row(flux_e: float, loop_gain: float, factor: float) -> Row:
    scores = [
        scored(flux_e, loop_gain, realisation, factor, seed) for realisation, seed in enumerate(SEEDS)
    ]
    mean = paired_mean(np.array([score.ratio for score in scores]))
    values = {
        "rms / integrator's": mean.value,
        "error": mean.standard_error,
        "worst": max(score.ratio for score in scores),
        "largest command / limit": max(score.largest for score in scores),
        "filter drives": float(np.mean([score.predicting for score in scores])),
    }
    is_met = mean.value <= 1 + mean.standard_error and values["largest command / limit"] <= 1
    return Row(f"loop gain {loop_gain:g}, model's gain x {factor:g}", values, "<= 1 + error", is_met)
