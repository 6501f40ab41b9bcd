"""Distribution of the pixels of a sub-aperture over the 32 threads of a warp."""

from __future__ import annotations

from dataclasses import dataclass

from faintspot.base.errors import InputError

WARP = 32  # threads
MOST_PIXELS = 1024  # a thread then holds 32 pixels: beyond, no GPU has the registers


@dataclass(frozen=True)
class Strips:
    """Strips of `rows` rows, one below the other; a thread has one column of one strip.

    Thread (lane) s * nx + x has column x of strip s; those from `strips` * nx on have nothing to do. The last
    strip may reach beyond the window.
    """

    ny: int
    nx: int
    rows: int
    """Pixels per thread."""
    strips: int
    last_row: int
    """Row of the last strip that is the window's last."""

    @property
    def full(self) -> bool:
        """Whether every thread has `rows` pixels."""
        return self.threads == WARP and self.last_row == self.rows - 1

    @property
    def threads(self) -> int:
        """Threads that have pixels."""
        return self.strips * self.nx


def strips_of(window: tuple[int, int]) -> Strips:
    """Share out a window (ny, nx).

    Raises
    ------
    InputError
        If it is too large for a warp.
    """
    ny, nx = window
    if nx > WARP or ny * nx > MOST_PIXELS:
        raise InputError(
            f'window of {ny} x {nx} pixels: device="cuda" takes at most {WARP} columns and {MOST_PIXELS} '
            'pixels; use smaller windows or device="cpu"'
        )
    rows = -(-ny // (WARP // nx))
    strips = -(-ny // rows)
    return Strips(ny, nx, rows, strips, ny - 1 - (strips - 1) * rows)
