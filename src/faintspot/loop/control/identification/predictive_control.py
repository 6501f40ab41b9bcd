"""Predictive control of any loop: learnt from a recording, then a command for every frame of slopes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import one_of, real_array
from faintspot.base.errors import InputError
from faintspot.loop.control.base import SETTLE_FRAMES, CommandDelayLine
from faintspot.loop.control.beside_the_loop import (
    FRAMES,
    STANDARD_ERRORS,
    BesideTheLoop,
    RecentFrames,
    error_of_mean,
    replayed_slopes,
)
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.learning import JUDGED_PART
from faintspot.loop.control.identification.learnt_loop import (
    ObservedLoop,
    control_from_observed,
    control_from_recording,
    control_with_new_winds,
)
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.modal_delay import LEAST_MEASURED
from faintspot.loop.control.identification.modal_model import LoopOfControl
from faintspot.loop.control.identification.model import Kalman, state_space, write_matrices
from faintspot.loop.control.identification.open_loop import Measured, Wind, open_loop_of
from faintspot.loop.control.identification.recording import OFFSETS, Recording

Singles = NDArray[np.float32]

_MEASURED_FRAMES = 60  # that the integrator drives the mirror first, so that its residual is measured
_EASED_FRAMES = 100  # in which the fallback's gain goes from the recorded one to its own
_ABSURD = 1e3  # of the rms of recorded slopes: no such slope is measured
_CONTENTS = "a predictive controller"
_RELEARNT_FROM = 520  # frames since the integrator took over, from which is learnt in the background
_PLAIN_AT_FIRST = 200  # frames in which it may drive because the filter has just begun
_RELEARNT_EVERY = 5000  # frames, while the filter drives


class PredictiveControl:
    """Predictive Kalman filter beside an integrator, of which the better one drives the mirror.

    `control(slopes)` returns the command to send, in the unit and with the sign of the recording. It must be
    called with every frame, in order. Made by `learn`; not by hand.
    """

    def __init__(self, loop: LoopOfControl, model: Kalman) -> None:
        self._loop, self._plant = loop, loop.plant()
        self.model = model
        """Model of the filter and of its fallback."""
        self._relearn = ""
        self.relearnt = ""
        """Result of the latest learning from the running loop, in one line."""
        self._recent = RecentFrames(len(loop.scale), loop.interaction.shape[1])
        self._beside: BesideTheLoop[tuple[PredictiveControl | None, str]] | None = None
        self.reset()

    @classmethod
    def of(cls, observed: ObservedLoop) -> PredictiveControl:
        """Learn a controller from a recording whose delay and open-loop slopes are known."""
        return cls(*control_from_observed(observed))

    @property
    def delay_frames(self) -> Measured:
        """Frames from the slopes to the first frame in which their command acts, whole ones used."""
        return Measured("delay", "frames", float(self._loop.delay[0]), float(self._loop.delay[1]))

    @property
    def centroid_gain(self) -> Measured:
        """Gain of the slopes in the running loop, relative to the interaction matrix."""
        return Measured("centroid gain", "", float(self._loop.delay[2]), float(self._loop.delay[3]))

    @property
    def gain_of_x_to_y(self) -> Measured:
        """Centroid gain of x relative to y; used where it differs from 1 by more than 3 standard errors."""
        return Measured(
            "centroid gain of x relative to y", "", float(self._loop.delay[4]), float(self._loop.delay[5])
        )

    @property
    def winds(self) -> tuple[Wind, ...]:
        """Layers that were found, the strongest first; none if the filter knows no winds."""
        recorded = self._loop.recorded
        return tuple(Wind.of(row, f"{recorded.site.length_unit}/s") for row in self._loop.winds)

    @property
    def integrator_gain(self) -> float:
        """Best stable loop gain of an integrator on slopes as measured, by replay of the recording."""
        return self._loop.integrator_gain

    @property
    def relearn(self) -> str:
        """When to learn again: "background", from the running loop in a process beside it; or "", never."""
        return self._relearn

    @relearn.setter
    def relearn(self, when: str) -> None:
        self._relearn = one_of("relearn", when, ["", "background"])

    @property
    def is_predicting(self) -> bool:
        """Whether the filter drives the mirror; else the integrator does."""
        return self._controller.chosen == 0

    @property
    def left_out(self) -> NDArray[np.int64]:
        """Numbers of sub-apertures not in use: without slopes in the recording, or measuring nothing now.

        Without cells, numbers of slopes that the recording has none of.
        """
        if self._loop.analysis.size:
            return np.flatnonzero(np.isinf(self._loop.standard_error))
        learnt = np.isinf(self._loop.standard_error).reshape(2, -1).any(axis=0)
        return np.flatnonzero(learnt | self._controller.is_stuck)

    def reset(self, command: ArrayLike | None = None) -> None:
        """Start again, without the memory of earlier frames.

        Parameters
        ----------
        command : (commands,) array, optional
            What the mirror holds. Default: the recording's mean, or stated, `flat_command`.
        """
        plant, limit = self._plant, self._loop.largest_command
        self._line = CommandDelayLine(plant.interaction.shape[1], plant.delay_frames, limit)
        self._controller = self.model.guarded(plant, self._line, plain_frames=_MEASURED_FRAMES)
        self._eased = 0 if self._loop.recorded_gain > 0 else _EASED_FRAMES
        if command is not None:
            self._line.hold(self._loop.held(np.asarray(command, np.float64)))
            self._controller.begin()
        self._recent.clear()
        self._waited = self._since_loss = 0

    def prepare(self) -> None:
        """Compute what does not need the next slopes, so that the next call is shorter.

        Call it once a command was sent. Without it the next call does this first; commands are the same.
        """
        self._controller.complete()

    def __call__(self, slopes: ArrayLike, standard_errors: ArrayLike | None = None) -> Floats:
        """Return the command to send after a frame.

        Parameters
        ----------
        slopes : (2 n,) array
            Residual slopes as in the recording. Not measured: NaN, infinite, or over 1000 times the rms of
            those; and a row of zeros.
        standard_errors : (2 n,) array, optional
            Standard errors of the slopes; not measured unless positive. Default: the noise of the recording.

        Raises
        ------
        InputError
            When an array has another shape.
        """
        if self._relearn:
            self._learn_beside()
        loop = self._loop
        errors = loop.standard_error
        with np.errstate(over="ignore"):
            row = self._row("slopes", slopes)
            scaled = loop.scaled_slopes(row if row.any() else np.full_like(row, np.nan))
        if standard_errors is not None:
            stated = self._row("standard_errors", standard_errors) * loop.scale
            errors = np.where((stated > 0) & np.isfinite(errors), stated, np.inf)
        measured = np.abs(scaled) < _ABSURD
        if not measured.all():  # NaN among them
            scaled, errors = np.where(measured, scaled, 0.0), np.where(measured, errors, np.inf)
        if self._eased < _EASED_FRAMES:
            self._eased += 1
            part, plain = self._eased / _EASED_FRAMES, self.model.plain_gain
            self._controller.set_plain_gain(loop.recorded_gain ** (1 - part) * plain**part)
        self._controller.update(*self._controlled(scaled, errors))
        command = loop.sent(self._line.latest)
        if errors is not loop.standard_error:  # else only what is never measured is missing
            scaled = np.where(np.isfinite(errors), scaled, np.nan)
        self._recent.add(scaled, command)
        return command

    def _controlled(self, slopes: Floats, errors: Floats) -> tuple[Floats, Floats]:
        """Return the slopes, or modes, of the controller, and their standard errors.

        Those of modes are infinite in a frame with too few slopes.
        """
        loop = self._loop
        if not loop.analysis.size:
            return slopes, errors
        noise, used = np.sqrt(self.model.arrays["variance_px2"]), np.isfinite(loop.standard_error)
        is_known = np.isfinite(errors).sum() >= LEAST_MEASURED * used.sum()
        return loop.analysis @ slopes, noise if is_known else np.full_like(noise, np.inf)

    def _learn_beside(self) -> None:
        """Begin to learn in another process when it is time to, and take what was learnt when it ends."""
        self._waited += 1
        has_lost = not self.is_predicting and self._waited > _PLAIN_AT_FIRST
        self._since_loss += has_lost or self._since_loss > 0
        if self._beside is not None:
            if self._beside.is_running:
                return
            better, self.relearnt = self._beside.result() or (None, "learning again: the process failed")
            self._beside, self._waited, self._since_loss = None, 0, 0
            if better is not None:
                self._take(better)
            return
        frames = self._since_loss or self._waited
        if self._since_loss >= _RELEARNT_FROM or self._waited >= _RELEARNT_EVERY:
            self._beside = BesideTheLoop(self._learnt_from, *self._latest(frames))

    def _learnt_from(self, slopes: Singles, commands: Singles) -> tuple[PredictiveControl | None, str]:
        """Return `better_of` frames of the running loop; none if nothing can be learnt from them."""
        try:
            return self.better_of(self.recording_of(slopes, commands))
        except InputError as error:
            return None, f"not learnt again: {error}"

    def __reduce__(self) -> tuple[type[PredictiveControl], tuple[LoopOfControl, Kalman]]:
        """Return how to make it in another process, without its memory of frames."""
        return PredictiveControl, (self._loop, self.model)

    def _latest(self, frames: int) -> tuple[Singles, Singles]:
        """Return slopes and commands of the latest frames, in the user's units; NaN where not measured."""
        loop = self._loop
        slopes, commands = self._recent.latest(frames)
        scale: Singles = np.where(np.isfinite(loop.standard_error), loop.scale, np.nan).astype(np.float32)
        return (slopes / scale + loop.recorded.reference_slopes).astype(np.float32), commands

    def recording_of(self, slopes: ArrayLike, commands: ArrayLike) -> Recording:
        """Return frames of this controller's loop, (frames, m) and (frames, commands), as a recording."""
        system = {**vars(self._loop.recorded), "delay_frames": float(self._plant.delay_frames)}
        return Recording(slopes, commands, **{**system, "sent_after_frames": 0})

    def better_of(self, recording: Recording) -> tuple[PredictiveControl | None, str]:
        """Learn from the first part of a recording, and compare with this controller on the rest, by replay.

        Returns
        -------
        PredictiveControl or None
            The new controller if it leaves less by two standard errors.
        str
            Result in one line.

        Raises
        ------
        InputError
            When nothing can be learnt from the recording.
        """
        frames = len(recording.slopes)
        first = frames - round(JUDGED_PART * frames)
        part = recording.part(slice(0, first))
        new = (
            learn(part)
            if self._loop.analysis.size
            else PredictiveControl(*control_with_new_winds(part, self._loop))
        )
        loop, begin = new._loop, max(0, first - SETTLE_FRAMES)
        rest, delay = recording.part(slice(begin, None)), new._plant.delay_frames
        matrix = loop.slopes_of_commands
        slopes, commands = loop.scaled_slopes(rest.slopes), loop.held(rest.commands)
        rest = replace(rest, slopes=slopes, commands=commands, interaction_matrix=matrix)
        seen = open_loop_of(rest, LoopDelay(float(delay), 0.0, 1.0, 0.0)).telemetry
        left = [
            replayed_slopes(control._in_loop_of(loop), seen, matrix, delay)[first - begin :]
            for control in (new, PredictiveControl(self._loop, self.model))
        ]
        ratio, error = left[0].mean() / left[1].mean(), error_of_mean(left[1] - left[0]) / left[1].mean()
        new.reset()
        text = f"{new.model.description}; residual {ratio:.2f} +- {error:.2f} of the running filter's"
        is_better = 1 - ratio > STANDARD_ERRORS * error
        return (new if is_better else None), f"{text}, {'taken' if is_better else 'not taken'}"

    def _in_loop_of(self, loop: LoopOfControl) -> Callable[[Floats], Floats]:
        """Return this controller for the slopes and commands of a description of the same loop."""
        return lambda slopes: loop.held(self(slopes / loop.scale + loop.recorded.reference_slopes))

    def _take(self, better: PredictiveControl) -> None:
        """Continue with another controller from the mirror's command."""
        latest = self._loop.sent(self._line.latest)
        self._loop, self._plant, self.model = better._loop, better._plant, better.model
        self._line, self._controller, self._eased = better._line, better._controller, _EASED_FRAMES
        self._line.hold(self._loop.held(latest))
        self._controller.begin()
        self._recent.clear()
        self._waited = self._since_loss = 0

    def _row(self, name: str, values: ArrayLike) -> Floats:
        """Return values of all slopes as numbers.

        Raises
        ------
        InputError
            When they have another shape.
        """
        try:
            hides = np.ma.isMaskedArray(values) or np.iscomplexobj(values)
            row = np.asarray(real_array(name, values) if hides else values, np.float64)
        except (TypeError, ValueError):
            row = real_array(name, values).astype(np.float64)
        if row.shape != self._loop.scale.shape:
            raise InputError(f"expected shape {self._loop.scale.shape}, got {row.shape}", name=name)
        return row

    def learn_again(self, recording: Recording | None = None) -> PredictiveControl:
        """Learn from another recording of the same loop, from the turbulence known so far; return itself.

        The recording may be of any controller. The mirror's command continues from the latest.

        Parameters
        ----------
        recording : Recording, optional
            Default: the latest frames of the running loop, up to 2000, of which a part is kept back: what
            is learnt is only taken if it leaves less there.

        Raises
        ------
        InputError
            As `learn`; then nothing changes.
        """
        if recording is None:
            better, self.relearnt = self.better_of(self.recording_of(*self._latest(FRAMES)))
            if better is not None:
                self._take(better)
            return self
        if recording.sent_after_frames is None:
            recording = replace(recording, sent_after_frames=self._loop.recorded.sent_after_frames)
        again = learn(recording, self.model.identified)
        self._take(again)
        self._eased = again._eased
        return self

    def save(self, path: str | Path) -> None:
        """Write the controller to a NumPy file (.npz).

        Raises
        ------
        InputError
            When it cannot be written.
        """
        self.model.save(path, self._loop.arrays())

    @classmethod
    def load(cls, path: str | Path) -> PredictiveControl:
        """Read a controller.

        Raises
        ------
        InputError
            When the file cannot be read, or has numbers out of range.
        """
        try:
            loop = LoopOfControl.read(path, _CONTENTS)
            return cls(loop, Kalman.load(path, loop.plant()))
        except (ValueError, TypeError, IndexError):
            raise InputError(f"{path}: expected {_CONTENTS}, got arrays of another shape") from None

    def export(self, path: str | Path) -> None:
        """Write the filter as plain matrices, at the noise of the recording and without the guard.

        Of more than 300 slopes those of the state are sparse.

        The names are those of `state_space`, with `delay_frames` and `largest_command`; slopes and commands
        are in the unit and of the sign of the recording, less `reference_slopes` and `flat_command`.

        Parameters
        ----------
        path : path
            Its ending says the format: .npz, .mat or .fits.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        plant, loop = self._plant, self._loop
        scale = loop.analysis * loop.scale if loop.analysis.size else loop.scale
        matrices = state_space(self.model, plant, scale, loop.sign)
        matrices |= {name: getattr(loop.recorded, name) for name in OFFSETS}
        matrices |= {"delay_frames": np.array(plant.delay_frames), "largest_command": loop.largest_command}
        write_matrices(path, matrices)

    def summary(self) -> str:
        """Return a summary of one line."""
        gain, delay = self.centroid_gain, self.delay_frames
        left, plain = self.model.left
        kind = "slopes" if self._loop.analysis.size else "sub-apertures"
        parts = [
            f"delay {delay.value:.2f} +- {delay.error:.2f} frames, centroid gain {gain.value:.3f} +- "
            f"{gain.error:.3f}",
            self.model.description,  # not in files
            f"residual, noise included, {left / plain:.2f} of an integrator's",
            f"{self._loop.law} ran" if self._loop.law else "",
            f"{kind} {', '.join(map(str, self.left_out))} left out" if len(self.left_out) else "",
        ]
        return "; ".join(part for part in parts if part)


def learn(recording: Recording, start: Identified | None = None) -> PredictiveControl:
    """Learn a predictive controller from the recording of a closed loop.

    Delay, centroid gain, noise, winds and vibrations are estimated from slopes and commands alone.

    Parameters
    ----------
    recording : Recording
    start : Identified, optional
        Turbulence known so far, from which the search for winds starts.

    Raises
    ------
    InputError
        When it cannot be learnt from the recording; the reason is one line.

    Examples
    --------
    A loop of 3 x 3 sub-apertures and the 16 actuators at their corners, under waves that the wind carries:

    >>> import numpy as np
    >>> from faintspot.loop.control import Recording, learn
    >>> rng = np.random.default_rng(1)
    >>> corners, cells = np.argwhere(np.ones((4, 4))), np.argwhere(np.ones((3, 3)))
    >>> apart = corners - cells[:, None]
    >>> inside = ((apart == 0) | (apart == 1)).all(axis=2)
    >>> matrix = np.vstack([inside * (apart[..., axis] - 0.5) for axis in (1, 0)])
    >>> waves, moved = rng.standard_normal((40, 2)), 0.05 * np.arange(800)[:, None, None]
    >>> heights = np.cos((corners - moved) @ waves.T + 6 * rng.random(40)) @ (1 / np.hypot(*waves.T))
    >>> turbulence = heights @ matrix.T + 0.2 * rng.standard_normal((800, 18))
    >>> slopes, commands = np.zeros((800, 18)), np.zeros((800, 16))
    >>> for k in range(2, 800):
    ...     slopes[k] = turbulence[k] + matrix @ commands[k - 2]
    ...     commands[k] = 0.99 * commands[k - 1] - 0.3 * np.linalg.pinv(matrix) @ slopes[k]
    >>> recording = Recording(slopes, commands, matrix, cells, frame_rate_hz=250)
    >>> control = learn(recording)
    >>> control(slopes[0]).shape
    (16,)
    """
    return PredictiveControl(*control_from_recording(recording, start))
