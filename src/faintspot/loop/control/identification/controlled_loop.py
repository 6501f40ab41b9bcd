"""Loop for which a controller was learnt, and its measured properties."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.modal_delay import law_of
from faintspot.loop.control.identification.modal_loop import modes_of
from faintspot.loop.control.identification.open_loop import OpenLoop, of_modes, open_loop_of
from faintspot.loop.control.identification.recording import Prepared, Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor

Floats = NDArray[np.float64]

_LEAK = 0.01


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
    law: str = ""
    """Name of the law by which the recorded loop ran."""
    analysis: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    """(modes, m): matrix from such slopes to modes, of which `interaction` then has a row each; or empty."""
    recorded: Recording | None = None
    """A frame of the recorded loop, in the user's units: what learning again must know."""

    @property
    def slopes_of_commands(self) -> Floats:
        """(m, commands): the user's matrix in such slopes.

        Raises
        ------
        InputError
            When the file of the controller has no recorded loop.
        """
        if self.recorded is None:
            raise InputError("controller: expected the recorded loop in its file; learn from a recording")
        scale = float(np.exp(np.log(np.abs(self.scale)).mean())) * float(self.delay[2])
        return np.asarray(scale * self.recorded.interaction_matrix)

    def plant(self) -> LoopPlant:
        """Return the loop for which controllers are made."""
        frames = max(1, round(float(self.delay[0])))
        if self.analysis.size:
            return LoopPlant(self.interaction, make_reconstructor(self.interaction), frames, _LEAK)
        reconstructor = make_reconstructor(self.interaction, measured=np.isfinite(self.standard_error))
        # The integrator is that of the recording, whatever gain of x relative to y was found.
        gains = np.exp(np.log(np.abs(self.scale)).mean()) / np.abs(self.scale)
        reconstructor = replace(reconstructor, matrix=reconstructor.matrix * gains)
        return LoopPlant(self.interaction, reconstructor, frames, _LEAK)


@dataclass(frozen=True, eq=False)
class LoopInModes:
    """Loop in the modes of its interaction matrix; delay and centroid gain are known."""

    described: LoopOfControl
    seen: OpenLoop
    rate_hz: float

    @classmethod
    def of(cls, ready: Prepared, delay: LoopDelay) -> Self:
        """Return the modes of a recorded loop."""
        loop = ready.recording
        gains = np.full(loop.slopes.shape[1], delay.gain)
        if loop.cells is not None:
            gains = delay.gains(len(loop.cells))
        modes = modes_of(replace(loop, slopes=loop.slopes / gains))
        in_modes, sent, run = of_modes(modes.recording)
        described = LoopOfControl(
            modes.recording.interaction_matrix,
            np.where(np.isfinite(loop.slopes).any(axis=0), 1.0, np.inf),
            1 / (loop.unit * gains),
            ready.sign,
            delay.row(),
            np.zeros((0, 6)),
            math.inf,
            math.nan,
            ready.sent_after_frames,
            law=law_of(delay.gain * in_modes, sent, run),
            analysis=modes.analysis,
            recorded=loop.part(slice(0, 1)).scaled(1 / loop.unit),
        )
        return cls(described, open_loop_of(modes.recording, replace(delay, gain=1.0)), loop.frame_rate_hz)
