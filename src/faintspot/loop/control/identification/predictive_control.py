"""Predictive control of any loop: learnt from a recording, then a command for every frame of slopes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import real_array
from faintspot.base.errors import InputError
from faintspot.base.files import read_arrays
from faintspot.loop.control.base import CommandDelayLine
from faintspot.loop.control.identification.layers import Identification, Identified
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.model import Kalman, state_space, write_matrices
from faintspot.loop.control.identification.open_loop import (
    Measured,
    OpenLoop,
    Wind,
    measured_delay,
    open_loop_of,
    site_of_loop,
    winds_of,
    with_axes_of,
)
from faintspot.loop.control.identification.recording import Prepared, Recording, prepared
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor

Floats = NDArray[np.float64]

_LEAK = 0.01
_MEASURED_FRAMES = 60  # that the integrator drives the mirror first, so that its residual is measured
_MOST_SIGMAS = 5.0  # of the commands that the turbulence asks for
_MOST_OFF = 1.5  # ratio of the recorded gain and the advised one, above which the fallback has the latter
_EASED_FRAMES = 100  # in which it gets there
_MARGIN = 0.55  # of the largest stable loop gain, for the largest centroid gain that is likely
_ABSURD = 1e3  # of the rms of recorded slopes: no such slope is measured
_CONTENTS = "a predictive controller"


@dataclass(frozen=True, eq=False)
class LoopOfControl:
    """Loop of a controller, with conversions from the user's unit and sign."""

    interaction: Floats
    """(2 n, commands): in slopes divided by the rms of the recording's and by their centroid gain."""
    standard_error: Floats
    """(2 n,): of such slopes; infinite where the recording has none, which are left out."""
    scale: Floats
    """(2 n,): such slopes in a unit of the user's."""
    sign: float
    """-1 where the user's commands are subtracted from the turbulence."""
    delay: Floats
    """(6,): delay in frames, centroid gain, and that of x relative to y, each with its standard error."""
    winds: Floats
    """(layers, 6): speed, direction and share, each with its standard error."""
    largest_command: float
    integrator_gain: float
    sent_after_frames: int
    recorded_gain: float = math.nan
    """Gain of the recorded integrator on the controller's slopes, if the fallback has another one."""
    length_unit: str = "m"
    """Unit of length of the winds."""

    def plant(self) -> LoopPlant:
        """Return the loop for which controllers are made."""
        frames = max(1, round(float(self.delay[0])))
        reconstructor = make_reconstructor(self.interaction, measured=np.isfinite(self.standard_error))
        # The integrator is that of the recording, whatever gain of x relative to y was found.
        gains = np.exp(np.log(np.abs(self.scale)).mean()) / np.abs(self.scale)
        reconstructor = replace(reconstructor, matrix=reconstructor.matrix * gains)
        return LoopPlant(self.interaction, reconstructor, frames, _LEAK)


class PredictiveControl:
    """Predictive Kalman filter beside an integrator, of which the better one drives the mirror.

    `control(slopes)` returns the command to send, in the unit and with the sign of the recording. It must be
    called with every frame, in order. Made by `learn`; not by hand.
    """

    def __init__(self, loop: LoopOfControl, model: Kalman) -> None:
        self._loop, self._plant = loop, loop.plant()
        self.model = model
        """Model of the filter and of its fallback."""
        self.reset()

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
        return tuple(Wind.of(row, f"{self._loop.length_unit}/s") for row in self._loop.winds)

    @property
    def integrator_gain(self) -> float:
        """Best stable loop gain of an integrator on slopes as measured, by replay of the recording."""
        return self._loop.integrator_gain

    @property
    def is_predicting(self) -> bool:
        """Whether the filter drives the mirror; else the integrator does."""
        return self._controller.chosen == 0

    @property
    def left_out(self) -> NDArray[np.int64]:
        """Numbers of sub-apertures not in use: without slopes in the recording, or measuring nothing now."""
        learnt = np.isinf(self._loop.standard_error).reshape(2, -1).any(axis=0)
        return np.flatnonzero(learnt | self._controller.is_stuck)

    def reset(self, command: ArrayLike | None = None) -> None:
        """Start again, without the memory of earlier frames.

        Parameters
        ----------
        command : (commands,) array, optional
            What the mirror holds. Default: it is flat.
        """
        plant, limit = self._plant, self._loop.largest_command
        self._line = CommandDelayLine(plant.interaction.shape[1], plant.delay_frames, limit)
        self._controller = self.model.guarded(plant, self._line, plain_frames=_MEASURED_FRAMES)
        self._eased = 0 if self._loop.recorded_gain > 0 else _EASED_FRAMES
        if command is not None:
            self._line.hold(self._loop.sign * np.asarray(command, np.float64))
            self._controller.begin()

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
            those.
        standard_errors : (2 n,) array, optional
            Standard errors of the slopes; not measured unless positive. Default: the noise of the recording.

        Raises
        ------
        InputError
            When an array has another shape.
        """
        loop = self._loop
        scaled, errors = self._row("slopes", slopes), loop.standard_error
        if standard_errors is not None:
            stated = self._row("standard_errors", standard_errors)
            errors = np.where((stated > 0) & np.isfinite(errors), stated, np.inf)
        measured = np.abs(scaled) < _ABSURD
        if not measured.all():  # NaN among them
            scaled, errors = np.where(measured, scaled, 0.0), np.where(measured, errors, np.inf)
        if self._eased < _EASED_FRAMES:
            self._eased += 1
            part, plain = self._eased / _EASED_FRAMES, self.model.plain_gain
            self._controller.set_plain_gain(loop.recorded_gain ** (1 - part) * plain**part)
        self._controller.update(scaled, errors)
        return loop.sign * self._line.latest

    def _row(self, name: str, values: ArrayLike) -> Floats:
        """Return values of all slopes, scaled.

        Raises
        ------
        InputError
            When they have another shape.
        """
        scale = self._loop.scale
        try:
            row = np.asarray(values, np.float64)
        except (TypeError, ValueError):
            row = real_array(name, values).astype(np.float64)
        if row.shape != scale.shape:
            raise InputError(f"expected shape {scale.shape}, got {row.shape}", name=name)
        with np.errstate(over="ignore"):
            return row * scale

    def learn_again(self, recording: Recording) -> PredictiveControl:
        """Learn from another recording of the same loop, from the turbulence known so far; return itself.

        The recording may be of any controller. The mirror's command continues from the latest.

        Raises
        ------
        InputError
            As `learn`; then nothing changes.
        """
        if recording.sent_after_frames is None:
            recording = replace(recording, sent_after_frames=self._loop.sent_after_frames)
        again = learn(recording, self.model.identified)
        latest = self._loop.sign * self._line.latest
        self._loop, self._plant, self.model = again._loop, again._plant, again.model
        self.reset(latest)
        return self

    def save(self, path: str | Path) -> None:
        """Write the controller to a NumPy file (.npz).

        Raises
        ------
        InputError
            When it cannot be written.
        """
        self.model.save(path, {f"loop_{name}": np.asarray(value) for name, value in vars(self._loop).items()})

    @classmethod
    def load(cls, path: str | Path) -> PredictiveControl:
        """Read a controller.

        Raises
        ------
        InputError
            When the file cannot be read, or has numbers out of range.
        """
        names = LoopOfControl.__dataclass_fields__
        arrays = read_arrays(path, _CONTENTS, [f"loop_{name}" for name in names])
        values: Mapping[str, Any] = {name: arrays[f"loop_{name}"] for name in names}
        try:
            plain = {name: array.item() if array.ndim == 0 else array for name, array in values.items()}
            loop = LoopOfControl(**plain)
            return cls(loop, Kalman.load(path, loop.plant()))
        except (ValueError, TypeError, IndexError):
            raise InputError(f"{path}: expected {_CONTENTS}, got arrays of another shape") from None

    def export(self, path: str | Path) -> None:
        """Write the filter as plain matrices, at the noise of the recording and without the guard.

        Of more than 300 slopes those of the state are sparse.

        The names are those of `state_space`, with `delay_frames` and `largest_command`; slopes and commands
        are in the unit and of the sign of the recording.

        Parameters
        ----------
        path : path
            Its ending says the format: .npz, .mat or .fits.

        Raises
        ------
        InputError
            When the file cannot be written.
        """
        plant = self._plant
        matrices = state_space(self.model, plant, self._loop.scale, self._loop.sign)
        matrices["delay_frames"] = np.array(plant.delay_frames)
        write_matrices(path, {**matrices, "largest_command": np.array(self._loop.largest_command)})

    def summary(self) -> str:
        """Return a summary of one line."""
        gain, delay = self.centroid_gain, self.delay_frames
        left, plain = self.model.left
        parts = [
            f"delay {delay.value:.2f} +- {delay.error:.2f} frames, centroid gain {gain.value:.3f} +- "
            f"{gain.error:.3f}",
            self.model.description,  # not in files
            f"residual, noise included, {left / plain:.2f} of an integrator's",
            f"sub-apertures {', '.join(map(str, self.left_out))} left out" if len(self.left_out) else "",
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
    if recording.cells is None:
        raise InputError("cells: expected row and column of each sub-aperture, got none")
    if recording.commands is None or recording.interaction_matrix is None:
        absent = "commands" if recording.commands is None else "interaction_matrix"
        raise InputError(f"{absent}: expected an array, got none")
    ready = prepared(recording)
    loop = ready.recording
    measured, used = measured_delay(loop)
    delay = with_axes_of(loop, replace(used, delay_error=measured.delay_error))
    return learn_observed(ObservedLoop(ready, delay, open_loop_of(loop, delay)), start)


@dataclass(frozen=True, eq=False)
class ObservedLoop:
    """Recording, and what has been measured from it."""

    ready: Prepared
    delay: LoopDelay
    """Delay and centroid gain that are used, with their errors."""
    seen: OpenLoop
    identification: Identification | None = None
    """Identification of its open-loop slopes, if made already."""


def learn_observed(observed: ObservedLoop, start: Identified | None = None) -> PredictiveControl:
    """Learn as `learn` from a recording whose delay and open-loop slopes are known."""
    ready, delay, seen = observed.ready, observed.delay, observed.seen
    loop, gain, site = ready.recording, delay.gain, site_of_loop(ready.recording)
    described = LoopOfControl(
        loop.interaction_matrix,
        np.where(np.isfinite(loop.slopes).any(axis=0), np.sqrt(seen.variance), np.inf),
        1 / (loop.unit * delay.gains(len(loop.cells))),
        ready.sign,
        delay.row(),
        np.zeros((0, 6)),
        math.inf,
        math.nan,
        ready.sent_after_frames,
        length_unit=site.length_unit,
    )
    plant = described.plant()
    learnt = learn_controller(
        plant,
        seen.telemetry,
        site,
        loop.frame_rate_hz,
        start=start,
        identification=observed.identification,
    )
    advised = _advised_gain(learnt.plain_gain, delay, plant.delay_frames)
    recorded, remarks = ready.loop_gain, list(loop.remarks)
    plain = recorded if math.isfinite(recorded) else advised
    if abs(math.log(max(plain, 1e-9) / advised)) > math.log(_MOST_OFF):
        plain = advised
        described = replace(described, recorded_gain=max(recorded, 1e-9) * gain)
        remarks.append(f"fallback integrator: gain {advised:.2g}, as the recorded {recorded:.2g} leaves more")
    described = replace(
        described, largest_command=_largest_command(loop, seen, plant), integrator_gain=advised
    )
    identified = learnt.identified
    if identified is not None and identified.is_layered:
        described = replace(described, winds=np.array([wind.row() for wind in winds_of(identified)]))
    description = "; ".join([learnt.description, *remarks])
    return PredictiveControl(described, replace(learnt, plain_gain=plain * gain, description=description))


def _advised_gain(best: float, delay: LoopDelay, delay_frames: int) -> float:
    """Return the loop gain on slopes as measured: the best by replay, or less, as it must be stable.

    Parameters
    ----------
    best : float
        Of slopes divided by the centroid gain.
    delay : LoopDelay
    delay_frames : int
        Whole frames; an integrator is stable up to 2 sin(pi / (4 delay - 2)).
    """
    most = _MARGIN * 2 * math.sin(math.pi / (4 * delay_frames - 2))
    error = delay.gain_error if math.isfinite(delay.gain_error) else 0.0
    return min(best / delay.gain, most / (delay.gain + error))


def _largest_command(loop: Recording, seen: OpenLoop, plant: LoopPlant) -> float:
    """Return the stroke limit: the loop's, or 5 sigma of what the recorded wavefront asks for."""
    asked = seen.telemetry.open_loop_px @ plant.reconstructor.matrix.T
    static = np.abs(loop.commands.mean(axis=0)) * loop.interaction_matrix.any(axis=0)
    limit = float((static + _MOST_SIGMAS * asked.std(axis=0)).max())
    return limit if loop.largest_command is None else min(limit, loop.largest_command)
