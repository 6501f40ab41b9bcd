"""What the mirror holds, and what is on its way to it."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class CommandLine:
    """Commands that act some frames after they were computed; all controllers of a mirror share it.

    Parameters
    ----------
    commands : int
        Number of actuators.
    delay_frames : int
        The command computed from frame k acts first during frame k + delay_frames.
    """

    def __init__(self, commands: int, delay_frames: int) -> None:
        self.delay_frames = delay_frames
        self._latest = np.zeros(commands)
        self._underway = deque([np.zeros(commands)] * delay_frames)

    @property
    def acting(self) -> Floats:
        """What the mirror holds during this frame."""
        return self._underway[0]

    @property
    def latest(self) -> Floats:
        """The last command computed, which still may be on its way."""
        return self._latest

    def put(self, command: Floats) -> None:
        """Send a command, which the caller does not change any more, and go on to the next frame."""
        self._latest = command
        self._underway.append(command)
        self._underway.popleft()
