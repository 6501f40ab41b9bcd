"""Interaction matrix and reference slopes from pokes of the mirror, with errors; their files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.files import derived, save_arrays, write_atomically
from faintspot.base.flags import UNMEASURED, SubapertureFlag
from faintspot.loop.control.configuration import INTERACTION, REFERENCE, save_control
from faintspot.slopes.sensor.layout import Layout

FEWEST_ROUNDS = 4
"""Number of rounds needed to estimate errors from the scatter."""
_ANSWERS = 1 / 3  # largest relative error of an actuator that counts as responding
_HOPELESS_ROUNDS = 8  # after which half of the actuators must have shown something
_CHECKED = 8  # actuators that are poked by half as much, too
_NOT_LINEAR = 0.1
_NOT_SETTLED = 0.05
_MEAN = 0
_FEWEST_MEASURED = 2
_MOST_INVALID, _MOST_AT_LIMIT = 0.2, 0.02


class PokedMirror(Protocol):
    """Mirror and sensor that can be poked and read."""

    commands: int

    def slopes(self, command: Floats) -> tuple[Floats, NDArray[np.uint8]]:
        """Return slopes (frames, 2 n) [px] and flags (frames, n) of two or more consecutive frames.

        The command is to act in all of them.
        """


@dataclass(frozen=True, eq=False)
class MirrorCalibration:
    """Result of a calibration by pokes."""

    interaction: Floats
    """(2 n, commands): px per unit of each command; 0 for actuators without response."""
    interaction_error: Floats
    """(2 n, commands): standard errors."""
    reference: Floats
    """(2 n,): measured slopes of the flat mirror [px]."""
    reference_error: Floats
    amplitude: float
    rounds: int
    relative_error: Floats
    """(commands,): relative error of each actuator's slopes."""
    linearity: float
    """Response to pokes of half the amplitude, relative to a linear response."""

    @property
    def answers(self) -> NDArray[np.bool_]:
        """(commands,): whether each actuator's response exceeds the noise."""
        return self.relative_error < _ANSWERS


def calibrate_mirror(
    mirror: PokedMirror,
    amplitude: float,
    relative_error: float = 0.05,
    most_rounds: int = 100,
    progress: Callable[[int, float], None] | None = None,
) -> MirrorCalibration:
    """Poke every actuator up and down repeatedly until the errors are small enough.

    Errors are those of the mean of all rounds, from their scatter, which includes noise and turbulence. The
    order of up and down alternates between rounds, so that drifts average out.

    Parameters
    ----------
    mirror : PokedMirror
    amplitude : float
        Of a poke, in the mirror's unit.
    relative_error : float
        That half of the actuators must reach.
    most_rounds : int
        After which it is given up.
    progress : callable, optional
        Called after every round with its number and the relative error.

    Raises
    ------
    InputError
        For numbers out of range; when the mirror does not answer, the error is not reached, too many slopes
        are not valid, and when pokes saturate.
    """
    amplitude = number_between("amplitude", amplitude, 0, low_open=True)
    limit = number_between("relative_error", relative_error, 0, 1, low_open=True)
    most = int(number_between("most_rounds", most_rounds, FEWEST_ROUNDS, 100_000, integer=True))
    everyone = np.arange(mirror.commands)
    pokes = _Pokes(mirror, everyone, amplitude)
    while True:
        pokes.round()
        error = np.inf
        if pokes.rounds >= FEWEST_ROUNDS:
            error = float(np.median(pokes.relative_error))
        if progress is not None:
            progress(pokes.rounds, error)
        if error <= limit:
            break
        pokes.refuse_hopeless(error, last=pokes.rounds >= most)
        if pokes.rounds >= most:
            raise InputError(
                f"relative_error = {limit:g}: after {most} rounds it is still {error:.2g}; poke more, give "
                "more flux, or allow more rounds"
            )
    pokes.refuse_saturated()
    pokes.refuse_unsettled()
    interaction, interaction_error = pokes.columns
    relative = pokes.relative_error
    linearity = _linearity(mirror, pokes, interaction, relative)
    reference, reference_error = pokes.middle
    interaction[:, relative >= _ANSWERS] = 0.0
    return MirrorCalibration(
        interaction,
        interaction_error,
        reference,
        reference_error,
        amplitude,
        pokes.rounds,
        relative,
        linearity,
    )


def centroid_gain(calibration: MirrorCalibration, former: Floats) -> tuple[float, float]:
    """Return the scale of the slopes relative to a former interaction matrix, and its error.

    Of a matrix in true pixels it is the estimator's centroid gain.

    Parameters
    ----------
    calibration : MirrorCalibration
    former : (2 n, commands) array
    """
    power = np.square(former).sum(axis=0) * calibration.answers
    responses = (calibration.interaction * former).sum(axis=0)
    gain = responses.sum() / power.sum()
    scatter = np.square(responses - gain * power).sum() / power.sum() ** 2
    return float(gain), float(np.sqrt(scatter))


def _linearity(mirror: PokedMirror, pokes: _Pokes, interaction: Floats, relative_error: Floats) -> float:
    """Check the linearity with pokes of half the amplitude for the strongest actuators."""
    strongest = np.argsort(np.abs(interaction).max(axis=0))[::-1][:_CHECKED]
    half = _Pokes(mirror, strongest, 0.5 * pokes.amplitude)
    for _ in range(max(FEWEST_ROUNDS, pokes.rounds)):
        half.round()
    full, (columns, errors) = interaction[:, strongest], half.columns
    power = np.square(full).sum()
    share = float((columns * full).sum() / power)
    # Of the whole pokes, and of the half ones.
    error = np.hypot(
        np.sqrt(np.square(np.where(full, errors * full, 0.0)).sum()) / power,
        float(relative_error[strongest].mean()) / np.sqrt(_CHECKED),
    )
    if abs(share - 1) > _NOT_LINEAR + 3 * error:
        raise InputError(
            f"amplitude = {pokes.amplitude:g}: pokes of half as much move the slopes {0.5 * share:.2f} times "
            "as far, 0.50 expected: mirror or sensor saturate; choose a smaller one"
        )
    return share


class _Pokes:
    """Pokes of some actuators and their responses, round by round."""

    def __init__(self, mirror: PokedMirror, actuators: NDArray[np.int64], amplitude: float) -> None:
        self._mirror, self._actuators, self.amplitude = mirror, actuators, amplitude
        self._differences: list[Floats] = []
        self._means: list[Floats] = []
        self._ends: Floats | float = 0.0
        """Sums of the differences of only the first and only the last frame of each poke."""
        self._counts = np.zeros(3)
        """Numbers of all slopes, of invalid ones, and of those at the limit of the search range."""

    @property
    def rounds(self) -> int:
        """Number of rounds."""
        return len(self._differences)

    def round(self) -> None:
        """Poke all actuators up and down, or down and up."""
        signs = (1.0, -1.0) if self.rounds % 2 == 0 else (-1.0, 1.0)
        differences, means = [], []
        for actuator in self._actuators:
            answers = {sign: self._poked(actuator, sign * self.amplitude) for sign in signs}
            differences.append((answers[1.0] - answers[-1.0]) / (2 * self.amplitude))
            means.append(0.5 * (answers[1.0] + answers[-1.0])[_MEAN])
        stack = np.stack(differences, axis=-1)
        self._differences.append(stack[_MEAN])
        ends = stack[_MEAN + 1 :]
        self._ends += np.where(np.isfinite(ends).all(axis=0), ends, 0.0)
        self._means.append(_mean(means)[0])

    @property
    def columns(self) -> tuple[Floats, Floats]:
        """Slopes per unit of each command, (2 n, actuators), and their standard errors."""
        return _mean(self._differences)

    @property
    def middle(self) -> tuple[Floats, Floats]:
        """Mean slopes of up and down, (2 n,), and their standard errors."""
        return _mean(self._means)

    @property
    def relative_error(self) -> Floats:
        """(actuators,): relative error, root sum of squares over the slopes."""
        columns, errors = self.columns
        noise = np.square(np.where(np.isfinite(errors), errors, 0.0)).sum(axis=0)
        signal = np.square(columns).sum(axis=0) - noise  # noise has added its square, too
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(signal > 0, np.sqrt(noise / signal), np.inf)

    def refuse_hopeless(self, error: float, *, last: bool) -> None:
        """Raise InputError if half of the actuators have no response or many slopes are invalid."""
        if self.rounds < _HOPELESS_ROUNDS and not last:
            return
        total, invalid, _ = self._counts
        if invalid > _MOST_INVALID * total:
            raise InputError(
                f"{100 * invalid / total:.0f} % of the slopes are not valid, expected at most "
                f"{100 * _MOST_INVALID:g} %: the sensor needs more flux"
            )
        if error > 1:
            noise = float(np.median(self.columns[1])) * self.amplitude
            raise InputError(
                f"the mirror does not answer: pokes of {self.amplitude:g} move slopes by no more than their "
                f"error of {noise:.2g} px; does it follow the commands, and are they large enough?"
            )

    def refuse_saturated(self) -> None:
        """Raise InputError if pokes moved spots to the limit of their search range or window."""
        total, _, at_limit = self._counts
        if at_limit > _MOST_AT_LIMIT * total:
            raise InputError(
                f"amplitude = {self.amplitude:g}: pokes move {100 * at_limit / total:.0f} % of the spots to "
                "the end of their search range or the edge of their window; choose a smaller one"
            )

    def refuse_unsettled(self) -> None:
        """Raise InputError if the first and the last frame of a poke differ."""
        columns, errors = self.columns
        first, last = np.asarray(self._ends) / self.rounds
        signal = (last * columns).sum()
        noise = 2 * np.sqrt(np.square(np.where(columns, errors * columns, 0.0)).sum())
        share = (first * columns).sum() / signal
        if abs(share - 1) > _NOT_SETTLED + 3 * noise / signal:
            raise InputError(
                f"pokes act {share:.2f} times as much in the first of the frames that are averaged as in the "
                "last one: allow more frames until they act (settle_frames)"
            )

    def _poked(self, actuator: int, amount: float) -> Floats:
        """Return mean slopes with one actuator poked, those of the first and of the last frame, (3, 2 n).

        What was not measured is NaN.
        """
        command = np.zeros(self._mirror.commands)
        command[actuator] = amount
        slopes, flags = self._mirror.slopes(command)
        valid = (flags & np.uint8(UNMEASURED)) == 0
        at_limit = (flags & np.uint8(SubapertureFlag.AT_SEARCH_LIMIT)) != 0
        self._counts += valid.size, valid.size - np.count_nonzero(valid), np.count_nonzero(at_limit)
        weight = np.tile(valid, 2)
        with np.errstate(invalid="ignore"):
            mean = (weight * slopes).sum(axis=0) / weight.sum(axis=0)
        return np.stack([mean, *np.where(weight, slopes, np.nan)[[0, -1]]])


def _mean(rounds: list[Floats]) -> tuple[Floats, Floats]:
    """Return the mean over rounds, and its standard error from their scatter; NaN: not measured.

    What was not measured twice is 0 with an infinite error.
    """
    stack = np.stack(rounds)
    measured = np.isfinite(stack)
    count = measured.sum(axis=0)
    mean = np.where(measured, stack, 0.0).sum(axis=0) / np.maximum(count, 1)
    squares = np.square(np.where(measured, stack - mean, 0.0)).sum(axis=0)
    error = np.sqrt(squares / np.maximum(count * (count - 1), 1))
    enough = count >= _FEWEST_MEASURED
    return np.where(enough, mean, 0.0), np.where(enough, error, np.inf)


def save_calibration(path: str | Path, calibration: MirrorCalibration, reference: Floats) -> Path:
    """Write a calibration beside a configuration file, as NAME.control.npz, and name it in [control].

    Parameters
    ----------
    path : path
        faintspot.toml.
    calibration : MirrorCalibration
    reference : (2 n,) array
        Reference slopes, px: those found, on top of what was subtracted already.

    Returns
    -------
    Path
        Of the arrays: interaction_matrix, reference_slopes, and their standard errors.

    Raises
    ------
    InputError
        When a file cannot be written.
    """
    store = derived(path, ".control.npz")
    arrays = {
        INTERACTION: calibration.interaction,
        "interaction_error": calibration.interaction_error,
        REFERENCE: reference,
        "reference_error": calibration.reference_error,
    }
    save_arrays(store, arrays)
    names = {name: f"{store.name}:{name}" for name in (INTERACTION, REFERENCE)}
    save_control(path, **names, centroid_gain=1.0)
    return store


def save_picture(path: str | Path, calibration: MirrorCalibration, reference: Floats, layout: Layout) -> None:
    """Draw a calibration as a PNG picture: matrix, response of each actuator, reference slopes.

    Raises
    ------
    MissingExtraError
        Without matplotlib.
    InputError
        When the file cannot be written.
    """
    from faintspot.base.report.plots import GREY, METHOD_COLOURS, WIDTH, new_figure, png, styled

    @styled
    def drawn() -> bytes:
        figure = new_figure(WIDTH, 4.4)
        matrix, answers, spots = figure.subplots(1, 3, width_ratios=[1.2, 1, 1])
        moved = calibration.interaction * calibration.amplitude
        largest = float(np.abs(moved).max())
        shown = matrix.imshow(
            moved, aspect="auto", cmap="RdBu_r", vmin=-largest, vmax=largest, origin="upper"
        )
        figure.colorbar(shown, ax=matrix, label=f"px for {calibration.amplitude:g}")
        matrix.set(title="Interaction matrix", xlabel="command", ylabel="slope: all x, then all y")
        size, error = (
            np.sqrt(np.square(slopes).mean(axis=0)) * calibration.amplitude
            for slopes in (calibration.interaction, calibration.interaction_error)
        )
        actuators = np.arange(len(size))
        answers.plot(actuators, size, "o", ms=4, color=METHOD_COLOURS[1], label="slopes")
        answers.plot(actuators, error, "_", ms=6, color=METHOD_COLOURS[0], label="their standard error")
        for actuator in actuators[~calibration.answers]:
            answers.axvline(actuator, color=GREY, lw=1, ls=":")
        answers.set(title="How far each actuator answers", xlabel="command", ylabel="rms slope of a poke, px")
        answers.set_ylim(bottom=0)
        answers.legend(loc="best")
        x, y = layout.corners[:, ::-1].T + (np.array(layout.window[::-1])[:, None] - 1) / 2 + layout.offsets.T
        spots.plot(x, y, "+", ms=4, color=GREY)
        spots.quiver(x, y, *reference.reshape(2, -1), angles="xy", color=METHOD_COLOURS[1])
        rms = float(np.sqrt(np.square(reference).mean()))
        spots.set(title=f"Reference slopes, {rms:.2g} px rms", xlabel="column, px", ylabel="row, px")
        spots.set_aspect("equal")
        spots.margins(0.1)
        return png(figure)

    write_atomically(path, drawn())
