"""Is the learnt filter ever worse than the integrator that ran, when a recording is not what it seems?

The loop of `guard`. Its own integrator knows references, bias and sign, as a telescope's does; the recording
and the filter see what is recorded. `python -m benchmarks.loops.guard_recordings [FLUX_E [NAME]]` prints rows
as they are measured.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.loops.guard import (
    CENTROID_GAIN,
    FAULT_FLUXES_E,
    FAULT_GAIN,
    FAULTS,
    FRAMES,
    LEARNING_FRAMES,
    LEARNING_SEED,
    LOST,
    SEEDS,
    SETTLED,
    Control,
    Damage,
    Integrator,
    Run,
    drive,
    geometry,
    open_loop,
    recording_of,
    strehl_ratios,
)
from benchmarks.measuring import Row, Table
from faintspot.base.errors import InputError
from faintspot.loop.control.identification.predictive_control import PredictiveControl, learn
from faintspot.loop.control.identification.recording import Recording

Floats = NDArray[np.float64]

_CELL, _HOT_PX, _REFERENCES_PX = 14, 0.8, 0.4
_BIAS_V, _PER_VOLT, _HIGHEST_V = 50.0, 8.0, 100.0
_FIRST_ZERO, _ZEROS, _SECOND = 500, 60, 250


def nearly_constant(value: float, noise_px: float) -> Damage:
    """Return what replaces the slopes of a sub-aperture by a value with little noise."""

    def damage(slopes: Floats, frame: int, random: Floats) -> None:
        slopes[:, _CELL] = value + noise_px * random

    return damage


def rows_of_zeros(slopes: Floats, frame: int, random: Floats) -> None:
    """Replace all slopes of 60 frames by 0."""
    if _FIRST_ZERO <= frame < _FIRST_ZERO + _ZEROS:
        slopes[:] = 0.0


def tip_and_tilt(loop: Recording) -> Recording:
    """Return the mean slopes of a recording, and of its commands."""
    slopes, moved = (
        values.reshape(len(values), 2, -1).mean(axis=2)
        for values in (loop.slopes, loop.commands @ loop.interaction_matrix.T)
    )
    return Recording(slopes, moved, np.eye(2), None, loop.frame_rate_hz)


@dataclass(frozen=True)
class Case:
    """Difference between what a recording holds and what the loop is."""

    name: str
    damage: Damage = FAULTS["none"]
    """What sensor and recording do to slopes."""
    is_recorded: bool = True
    """Whether the damage is in the recording, too."""
    is_scored: bool = True
    """Whether the damage is in the scored frames, too."""
    references_px: float = 0.0
    """Rms of reference positions that are not subtracted."""
    volts: tuple[float, float] = (1.0, 0.0)
    """Unit of the commands in that of the mirror, negative where it subtracts them, and their bias."""
    is_held: bool = False
    """Whether the controller is told that the mirror holds the bias."""
    is_swapped: bool = False
    """Whether the commands are those of another recording."""
    is_of_tip_and_tilt: bool = False
    """Whether mean slopes alone are recorded; such a recording is to be refused."""
    matrix: tuple[float, float] = (1.0, 1.0)
    """Factors of the matrix' rows of x and y."""

    @property
    def references(self) -> Floats:
        """Reference positions, (2 n,)."""
        rows = len(geometry().interaction)
        return self.references_px * np.random.default_rng(5).standard_normal(rows)

    def seen(self, is_damaged: bool) -> Damage:
        """Return what makes of true slopes those that are recorded."""
        references, damage = self.references.reshape(2, -1), self.damage if is_damaged else FAULTS["none"]

        def change(slopes: Floats, frame: int, random: Floats) -> None:
            slopes += references
            damage(slopes, frame, random)

        return change

    def moved(self, command: Floats) -> Floats:
        """Return what the mirror does, given a command as recorded."""
        unit, bias = self.volts
        return (np.clip(command, 0.0, _HIGHEST_V) if bias else command) / unit - bias / unit

    def integrator(self) -> Control:
        """Return the integrator of the loop."""
        law, (unit, bias), references = Integrator(FAULT_GAIN), self.volts, self.references
        return lambda slopes: bias + unit * law(slopes - references)

    def recording(self, flux_e: float) -> Recording:
        """Return the recording to learn from."""
        seen, runs = self.seen(self.is_recorded), list[Run]()
        for seed in (LEARNING_SEED, LEARNING_SEED + 1):
            air = open_loop(FAULT_GAIN, seed, LEARNING_FRAMES)
            runs.append(drive(self.integrator(), air, flux_e, seed, CENTROID_GAIN, seen, moved=self.moved))
            if not self.is_swapped:
                break
        slopes, commands = runs[0].slopes, runs[-1].commands
        if self.is_of_tip_and_tilt:
            return tip_and_tilt(recording_of(slopes, commands))
        factors = np.repeat(self.matrix, len(geometry().cells))[:, None] / self.volts[0]
        return replace(recording_of(slopes, commands), interaction_matrix=factors * geometry().interaction)


CASES = (
    Case("references not subtracted", references_px=_REFERENCES_PX),
    Case("commands about a bias", volts=(_PER_VOLT, _BIAS_V)),
    Case("commands about a bias that reset() states", volts=(_PER_VOLT, _BIAS_V), is_held=True),
    Case("hot pixel in one window", nearly_constant(_HOT_PX, 0.05)),
    Case("one at 0 with noise of .001 px", nearly_constant(0.0, 0.001)),
    Case("rows of 0 for 60 frames while it runs", rows_of_zeros, is_recorded=False),
    Case("rows of 0 for 60 frames of the recording", rows_of_zeros, is_scored=False),
    Case("slopes and commands of different recordings", is_swapped=True),
    Case("tip and tilt of different recordings", is_swapped=True, is_of_tip_and_tilt=True),
    Case("commands of the other sign", volts=(-1.0, 0.0)),
    Case("matrix of the other sign along x", matrix=(-1.0, 1.0)),
)


def row(case: Case, flux_e: float) -> tuple[Row, str]:
    """Return the Strehl ratios of filter and integrator, and how it was learnt, or why not."""
    try:
        control = learn(case.recording(flux_e))
    except InputError as error:
        return Row(f"{case.name}: refused", {}, "refused", True), str(error)
    if case.is_of_tip_and_tilt:
        return Row(f"{case.name}: accepted", {}, "refused", False), control.summary()
    runs = [_scores(case, flux_e, seed, control) for seed in SEEDS]
    ours, plain, predicting = (np.array(values) for values in zip(*runs, strict=True))
    difference = ours - plain
    least = float(difference.reshape(len(SEEDS), -1, _SECOND).mean(axis=-1).min())
    values = {
        "Strehl ratio": float(ours.mean()),
        "integrator's": float(plain.mean()),
        "difference": float(difference.mean()),
        "least, in a second": least,
        "filter drives, part": float(predicting.mean()),
    }
    return Row(case.name, values, f"least >= -{LOST}", least >= -LOST), control.summary()


def _scores(case: Case, flux_e: float, seed: int, control: PredictiveControl) -> list[Floats]:
    """Return both Strehl ratios and whether the filter drives, by frame."""
    air = open_loop(FAULT_GAIN, seed, FRAMES)
    seen = case.seen(case.is_scored)
    control.reset(np.full(geometry().interaction.shape[1], case.volts[1]) if case.is_held else None)
    runs = [
        drive(law, air, flux_e, seed, CENTROID_GAIN, seen, moved=case.moved)
        for law in (control, case.integrator())
    ]
    return [values[SETTLED:] for values in (*map(strehl_ratios, runs), runs[0].predicting)]


def table(flux_e: float, name: str = "", say: Callable[[str], None] = lambda text: None) -> Table:
    """Return the rows of all cases whose name begins with `name`."""
    rows = []
    for case in CASES:
        if case.name.startswith(name):
            measured, text = row(case, flux_e)
            rows.append(measured)
            values = ", ".join(f"{key} {value:.3f}" for key, value in measured.values.items())
            say(f"{flux_e:g} e-, {measured.name}: {values} {'' if measured.met else 'FAILED'}\n    {text}")
    note = f"{len(SEEDS)} realisations of 3 s from 1 s on; Strehl ratio at 1.65 um of the fitted wavefront"
    title = f"Recordings unlike their loop, {flux_e:g} e-"
    return Table(f"guard-recordings-{flux_e:g}", title, rows, [note])


if __name__ == "__main__":
    for flux_e in [float(sys.argv[1])] if len(sys.argv) > 1 else FAULT_FLUXES_E:
        table(flux_e, "".join(sys.argv[2:3]), lambda text: print(text, flush=True))
