"""Interface of a loop that another package simulates, and the integrator."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Control = Callable[[Floats], Floats]
"""From the slopes of a frame to the command to send."""

SETTLE_FRAMES = 150
LEAK = 0.01
IMAGING_M = 1.65e-6


@dataclass(frozen=True)
class Observed:
    """Run of a loop."""

    strehl: Floats
    """(frames,): Strehl ratio in the H band; or one value, of a long exposure after the settling frames."""
    slopes: Floats
    """(frames, 2 n)"""
    commands: Floats
    """(frames, commands): sent after each frame."""
    predicting: Floats
    """(frames,): 1 where the filter of a guarded control drives the mirror."""

    @property
    def score(self) -> float:
        """Mean Strehl ratio after the settling frames."""
        return float(self.strehl[SETTLE_FRAMES if len(self.strehl) > 1 else 0 :].mean())


class ForeignLoop(ABC):
    """Loop of another package.

    Attributes
    ----------
    name : str
        Identifies the loop among those of a run.
    cells : (n, 2) array
        Row and column of each sub-aperture.
    interaction : (2 n, commands) array
        Slopes for a unit of each command, in the unit of the package, as calibrated by the user.
    sign : float
        -1 where the mirror subtracts the commands.
    rate_hz : float
        Frames per second.
    subaperture_m : float
        Side of a sub-aperture.
    unit_arcsec : float
        Angle of a unit of the slopes, as calibrated.
    r0_m : float
        Fried parameter at 500 nm, as given to the package.
    delay_frames : int
        The command computed from frame k acts first during frame k + delay.
    winds : list of (speed, direction)
        As given to the package.
    is_changing : bool
        Whether the winds change, in loops that can.
    is_slow : bool
        Whether pyRTC and brighter stars are left out, and fewer gains tried.
    is_modal : bool
        Whether faintspot is not told the cells, as of sensors that have none.
    own : dict
        Reconstructors (commands, 2 n) that the package makes of the interaction matrix, if not the inverse.
    """

    name: str
    cells: NDArray[np.int64]
    interaction: Floats
    sign, is_changing, is_slow, is_modal = 1.0, False, False, False
    rate_hz: float
    subaperture_m: float
    unit_arcsec: float
    r0_m: float
    delay_frames: int
    winds: list[tuple[float, float]]
    own: dict[str, Floats]

    @abstractmethod
    def run(self, control: Control, seed: int, frames: int, *, turned: bool = False) -> Observed:
        """Run the loop from a flat mirror; if `turned`, the turbulence is then played backwards."""

    def true_gain(self, control: Control, seed: int, frames: int) -> float:
        """Return the centroid gain in the running loop, from true wavefronts; NaN if not known."""
        return float("nan")


class SteppedLoop(ForeignLoop):
    """Loop of a package that simulates a frame when asked.

    Parameters
    ----------
    folder : Path
        Keeps the wavefronts of each seed.
    atmosphere : str
        Name of the turbulence; loops that share it share its wavefronts.
    """

    def __init__(self, folder: Path, atmosphere: str) -> None:
        self._folder, self._atmosphere = folder, atmosphere

    @abstractmethod
    def simulated(self, seed: int, frames: int) -> NDArray[np.float32]:
        """Return the optical path difference of the turbulence, m, in every frame."""

    @abstractmethod
    def begin(self, seed: int) -> None:
        """Start the noise of a run."""

    @abstractmethod
    def frame(self, path_m: NDArray[np.float32], command: Floats) -> tuple[Floats, float]:
        """Return slopes and Strehl ratio of a frame."""

    def paths_m(self, seed: int, frames: int) -> Any:
        """Return the turbulence of a seed, simulated once."""
        file = self._folder / f"{self._atmosphere}-{seed}-{frames}.npy"
        if not file.exists():
            unfinished = file.with_suffix(".part.npy")
            np.save(unfinished, self.simulated(seed, frames))
            unfinished.replace(file)
        return np.load(file, mmap_mode="r")

    def run(self, control: Control, seed: int, frames: int, *, turned: bool = False) -> Observed:
        """See `ForeignLoop`."""
        self.begin(seed)
        paths_m = self.paths_m(seed, frames)
        order = [*range(frames), *(reversed(range(frames)) if turned else ())]
        waiting = deque(np.zeros((self.delay_frames, self.interaction.shape[1])))
        strehl: list[float] = []
        slopes: list[Floats] = []
        commands: list[Floats] = []
        predicting: list[float] = []
        for number in order:
            measured, ratio = self.frame(paths_m[number], waiting.popleft())
            predicting.append(float(getattr(control, "is_predicting", False)))
            command = np.array(control(measured))
            waiting.append(command)
            strehl.append(ratio)
            slopes.append(measured)
            commands.append(command)
        return Observed(np.array(strehl), np.array(slopes), np.array(commands), np.array(predicting))


class Integrator:
    """Integrator with a leak."""

    def __init__(self, loop: ForeignLoop, reconstructor: Floats, gain: float) -> None:
        self._step = loop.sign * gain * reconstructor
        self._command = np.zeros(len(reconstructor))

    def __call__(self, slopes: Floats) -> Floats:
        """Return the command to send."""
        self._command = (1 - LEAK) * self._command - self._step @ slopes
        return self._command
