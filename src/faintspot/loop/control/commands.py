"""Delay line of mirror commands."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class CommandDelayLine:
    """Delay line between controllers and mirror; all controllers of a mirror share it.

    Its memory is made once: what `acting` and `latest` return is good until the next command is sent.

    Parameters
    ----------
    commands : int
        Number of actuators.
    delay_frames : int
        The command computed from frame k acts first during frame k + delay_frames.
    largest : float
        Stroke: no command is sent that is larger. What is cut off is forgotten, so that nothing winds up.
    """

    def __init__(self, commands: int, delay_frames: int, largest: float = math.inf) -> None:
        self.delay_frames, self.largest = delay_frames, largest
        self.rows = np.zeros((delay_frames + 1, commands))
        """(delay_frames + 1, commands): the latest commands."""
        self.next_row = 0
        """Row for the next command; the oldest other row acts."""
        self._rows = list(self.rows)

    @property
    def acting(self) -> Floats:
        """Commands that the mirror holds during this frame."""
        return self._rows[(self.next_row + 1) % len(self._rows)]

    @property
    def around(self) -> tuple[Floats, Floats, Floats]:
        """Commands of the last frame, of this one and of the next, for a delay of at least 2 frames."""
        before, acting, after = (self._rows[(self.next_row + step) % len(self._rows)] for step in range(3))
        return before, acting, after

    @property
    def latest(self) -> Floats:
        """Last computed command, which may not act yet."""
        return self._rows[self.next_row - 1]

    @property
    def spare(self) -> Floats:
        """Row into which the next command may be written before `sent`.

        Until then it holds what the mirror held during the last frame.
        """
        return self._rows[self.next_row]

    def put(self, command: Floats) -> None:
        """Send a command, clipped to the stroke, and advance by one frame.

        Raises
        ------
        ArithmeticError
            See `sent`.
        """
        total = float(command.sum())
        np.clip(command, -self.largest, self.largest, out=self.spare)
        self.sent(total)

    def sent(self, total: float) -> None:
        """Send the command in `spare`, which is within the stroke, and advance by one frame.

        Parameters
        ----------
        total : float
            Sum of the command before it was clipped, which turns an infinite command into a finite one.

        Raises
        ------
        ArithmeticError
            When the sum is not finite. The latest command stays the latest.
        """
        if not math.isfinite(total):
            raise ArithmeticError("its commands were not finite")
        self.next_row = (self.next_row + 1) % len(self._rows)

    def copy_from(self, other: CommandDelayLine, *, without_latest: bool = False) -> None:
        """Take the commands of a line of the same length, perhaps as they were before its latest."""
        self.rows[:] = other.rows
        self.next_row = (other.next_row - without_latest) % len(self._rows)

    def hold(self, command: Floats) -> None:
        """Restart with a mirror that holds a command, and no delayed commands."""
        for row in self._rows:
            np.clip(command, -self.largest, self.largest, out=row)
