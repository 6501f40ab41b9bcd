"""Is a loop with the learnt filter ever worse than its integrator, whatever centroid gain the filter assumes?

7 x 7 sub-apertures and 52 actuators in frozen von Karman turbulence of plane waves, with noise. The filter
assumes a centroid gain that is wrong by a factor: when it learns from a recording of the integrator, or as
the gain changes after learning. Then both drive the loop through the same turbulence with the same noise;
their residuals count from 1 s on. The same with sub-apertures that are dead, stuck, noisy or die on the way,
with and without an actuator that does not move: there Strehl ratios count.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring import Row, Table
from faintspot.base.statistics import paired_mean
from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.learnt_loop import ObservedLoop, control_from_observed
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import open_loop_of
from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn
from faintspot.loop.control.identification.preparation import prepared
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.reconstructor import make_reconstructor
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M, SPECTRUM

Floats = NDArray[np.float64]
Control = Callable[[Floats], Floats]
Damage = Callable[[Floats, int, Floats], None]
"""Changes the slopes of a frame, (2, n), given its number and random numbers."""

RATE_HZ, DELAY, LEAK, CENTROID_GAIN = 250.0, 2, 0.01, 0.6
FLUXES_E = 20.0, 60.0, 200.0, 1000.0
_SIDE_M, _PIXEL_ARCSEC, _R0_M, _OUTER_SCALE_M, _WAVES = 0.6, 0.2, 0.2, 25.0, 1200
FAULT_FLUXES_E = 20.0, 200.0
FACTORS = 0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0
"""Assumed centroid gain in the true one."""
WINDS = {
    0.3: ((6.0, 20.0, 0.45), (9.0, 80.0, 0.25), (14.0, 150.0, 0.15), (22.0, 250.0, 0.15)),
    0.6: ((12.0, 45.0, 0.7), (25.0, 190.0, 0.3)),
    1.0: ((8.0, 300.0, 1.0),),
}
"""Speed [m/s], direction [degrees] and share of the layers, by loop gain."""
SEEDS = 21, 22, 23
"""Of the scored turbulence; the guard's limits were chosen on 1, 2 and 3."""
LEARNING_FRAMES, FRAMES, SETTLED = 2000, 1000, 250
LEARNING_SEED, _STABLE = 1000, 0.8
"""Seed of the recordings; largest product of loop gain and centroid gain that is tried."""


_RAD = _PIXEL_ARCSEC * ARCSEC * _SIDE_M * 2 * np.pi / 1.65e-6
"""Phase at 1.65 um of a slope of one pixel over a sub-aperture."""
LOST = 0.02  # of Strehl ratio, at most
_STILL_ACTUATOR, FAULT_GAIN, _DIES_AT = 20, 0.3, 400


def constant(*cells: int, value: float = 0.0, start: int = 0) -> Damage:
    """Return what writes a constant into slopes of sub-apertures."""

    def damage(slopes: Floats, frame: int, random: Floats) -> None:
        if frame >= start:
            slopes[:, cells] = value

    return damage


def noisy(cell: int, noise_px: float, start: int = 0) -> Damage:
    """Return what adds noise to a sub-aperture."""

    def damage(slopes: Floats, frame: int, random: Floats) -> None:
        if frame >= start:
            slopes[:, cell] += noise_px * random

    return damage


FAULTS: dict[str, Damage] = {
    "none": constant(start=0),
    "one at 0": constant(14),
    "one at the edge at 0": constant(0),
    "two at 0": constant(3, 20),
    "one at .33": constant(14, value=0.33),
    "one of 1 px of noise": noisy(14, 1.0),
    "one of 5 px": noisy(14, 5.0),
}
LATER_FAULTS: dict[str, Damage] = {
    "one dies": constant(14, start=_DIES_AT),
    "one sticks at .33": constant(14, value=0.33, start=_DIES_AT),
    "one becomes noisy, 1 px": noisy(14, 1.0, _DIES_AT),
    "5 px": noisy(14, 5.0, _DIES_AT),
}
"""Faults that begin in the scored frames; the filter has learnt without."""


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
    low, high = np.log(0.02 / _OUTER_SCALE_M), np.log(4.0 / _SIDE_M)
    for speed, degrees, share in winds:
        size, angle = np.exp(rng.uniform(low, high, _WAVES)), rng.uniform(0, 2 * np.pi, _WAVES)
        wave = size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        power = SPECTRUM * _R0_M ** (-5 / 3) * (size**2 + _OUTER_SCALE_M**-2) ** (-11 / 6)
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


def drive(
    control: Control,
    open_loop: Floats,
    flux_e: float,
    seed: int,
    centroid_gain: float = CENTROID_GAIN,
    damage: Damage = FAULTS["none"],
    still: tuple[int, ...] = (),
    moved: Control = lambda command: command,
) -> Run:
    """Drive the loop through open-loop slopes; actuators that are still do not move.

    `moved` is what the mirror does, given a command.
    """
    mirror, phase = geometry().interaction.copy(), geometry().phase
    mirror[:, still] = 0.0
    random = np.random.default_rng([seed, 2]).standard_normal((len(open_loop), 2))
    noise = noise_px(flux_e) * np.random.default_rng([seed, 1]).standard_normal(open_loop.shape)
    waiting = deque(np.zeros((DELAY, mirror.shape[1])))
    true, slopes = np.empty_like(open_loop), np.empty_like(open_loop)
    commands, predicting = np.empty((len(open_loop), mirror.shape[1])), np.zeros(len(open_loop))
    for frame, turbulent in enumerate(open_loop):
        true[frame] = turbulent + mirror @ waiting.popleft()
        slopes[frame] = centroid_gain * true[frame] + noise[frame]
        damage(slopes[frame].reshape(2, -1), frame, random[frame])
        predicting[frame] = getattr(control, "is_predicting", False)
        commands[frame] = control(slopes[frame])
        waiting.append(moved(commands[frame]))
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
def open_loop(loop_gain: float, seed: int, frames: int) -> Floats:
    """Return turbulence with the winds of a loop gain."""
    return turbulence(WINDS[loop_gain], seed, frames)


@cache
def left_by_integrator(flux_e: float, loop_gain: float, seed: int, centroid_gain: float) -> float:
    """Return the phase variance that the integrator leaves from 1 s on."""
    air = open_loop(loop_gain, seed, FRAMES)
    run = drive(Integrator(loop_gain), air, flux_e, seed, centroid_gain)
    return float(run.residual[SETTLED:].mean())


@cache
def recorded(
    flux_e: float, loop_gain: float, damage: Damage = FAULTS["none"], still: tuple[int, ...] = ()
) -> Recording:
    """Return the recording of an integrator, from which the filter learns."""
    air = open_loop(loop_gain, LEARNING_SEED, LEARNING_FRAMES)
    run = drive(Integrator(loop_gain), air, flux_e, LEARNING_SEED, CENTROID_GAIN, damage, still)
    return recording_of(run.slopes, run.commands)


def recording_of(slopes: Floats, commands: Floats) -> Recording:
    """Return a recording without the frames in which the integrator settles."""
    rows, where = slice(100, None), (geometry().interaction, geometry().cells, RATE_HZ)
    loop = Recording(slopes[rows], commands[rows], *where)
    return replace(loop, subaperture_m=_SIDE_M, pixel_scale_arcsec=_PIXEL_ARCSEC)


def learnt(
    flux_e: float, loop_gain: float, factor: float, start: Identified | None = None
) -> PredictiveControl:
    """Return the filter that assumes a wrong centroid gain."""
    delay = LoopDelay(float(DELAY), 0.06, factor * CENTROID_GAIN, 0.04)
    ready = prepared(recorded(flux_e, loop_gain))
    return PredictiveControl(
        *control_from_observed(ObservedLoop(ready, delay, open_loop_of(ready.recording, delay)), start)
    )


def run() -> list[Table]:
    """Score all assumed gains and loop gains at all fluxes, faults, and recordings unlike their loop."""
    from benchmarks.loops.guard_recordings import table  # which drives this module's loop

    return [
        *(_table(flux_e) for flux_e in FLUXES_E),
        *(_fault_table(flux_e) for flux_e in FAULT_FLUXES_E),
        *(table(flux_e) for flux_e in FAULT_FLUXES_E),
    ]


def _fault_table(flux_e: float) -> Table:
    rows = [
        fault_row(name, damage, flux_e, still, name in LATER_FAULTS)
        for still in ((), (_STILL_ACTUATOR,))
        for name, damage in {**FAULTS, **LATER_FAULTS}.items()
    ]
    note = f"{len(SEEDS)} realisations of 3 s from 1 s on; Strehl ratio at 1.65 um of the fitted wavefront"
    return Table(f"guard-faults-{flux_e:g}", f"Faults of sensor and mirror, {flux_e:g} e-", rows, [note])


@cache
def learnt_with(flux_e: float, damage: Damage, still: tuple[int, ...]) -> PredictiveControl:
    """Return the filter learnt from a recording with a fault."""
    return learn(recorded(flux_e, FAULT_GAIN, damage, still))


def fault_row(name: str, damage: Damage, flux_e: float, still: tuple[int, ...], is_later: bool) -> Row:
    """Return the Strehl ratios of filter and integrator with a fault."""
    control = learnt_with(flux_e, FAULTS["none"] if is_later else damage, still)
    ratios, predicting = [], []
    for seed in SEEDS:
        control.reset()
        rest = open_loop(FAULT_GAIN, seed, FRAMES), flux_e, seed, CENTROID_GAIN, damage, still
        runs = drive(control, *rest), drive(Integrator(FAULT_GAIN), *rest)
        ratios.append([float(strehl_ratios(run)[SETTLED:].mean()) for run in runs])
        predicting.append(float(runs[0].predicting[SETTLED:].mean()))
    (ours, plain), differences = np.mean(ratios, axis=0), np.array([a - b for a, b in ratios])
    values = {
        "Strehl ratio": float(ours),
        "integrator's": float(plain),
        "difference": float(differences.mean()),
        "least": float(differences.min()),
        "filter drives, part": float(np.mean(predicting)),
    }
    mirror = ", an actuator that does not move" if still else ""
    return Row(f"{name}{mirror}", values, f"least >= -{LOST}", bool(differences.min() >= -LOST))


def strehl_ratios(run: Run) -> Floats:
    """Return the Strehl ratio of each frame at 1.65 um, of the fitted wavefront."""
    return np.asarray(np.exp(-(_RAD**2) * run.residual))


def _table(flux_e: float) -> Table:
    rows = []
    for loop_gain in WINDS:
        right = learnt(flux_e, loop_gain, 1.0)
        for factor in FACTORS:
            wrong = learnt(flux_e, loop_gain, factor, right.model.identified)
            rows.append(row(f"gain x {factor:g} in learning", wrong, flux_e, loop_gain, CENTROID_GAIN))
        for factor in FACTORS:
            if loop_gain * CENTROID_GAIN / factor <= _STABLE and factor != 1:
                changed = CENTROID_GAIN / factor
                rows.append(row(f"gain x {factor:g} after learning", right, flux_e, loop_gain, changed))
    note = f"{len(SEEDS)} realisations of 3 s from 1 s on; gains in the true ones"
    return Table(f"guard-{flux_e:g}", f"Guarded filter, {flux_e:g} e-", rows, [note])


def row(name: str, control: PredictiveControl, flux_e: float, loop_gain: float, centroid_gain: float) -> Row:
    """Return the scores of a filter against the integrator."""
    ratios, largest, predicting = [], [], []
    for seed in SEEDS:
        control.reset()
        run = drive(control, open_loop(loop_gain, seed, FRAMES), flux_e, seed, centroid_gain)
        plain = left_by_integrator(flux_e, loop_gain, seed, centroid_gain)
        ratios.append(float(np.sqrt(run.residual[SETTLED:].mean() / plain)))
        largest.append(float(np.abs(run.commands).max() / control._loop.largest_command))
        predicting.append(float(run.predicting[SETTLED:].mean()))
    ratio = paired_mean(np.array(ratios))
    values = {
        "rms / integrator's": ratio.value,
        "error": ratio.standard_error,
        "largest command / limit": max(largest),
        "filter drives, part": float(np.mean(predicting)),
    }
    is_met = ratio.value <= 1.0005 + ratio.standard_error and max(largest) <= 1
    return Row(f"loop gain {loop_gain:g}, {name}", values, "<= 1 + error", is_met)
