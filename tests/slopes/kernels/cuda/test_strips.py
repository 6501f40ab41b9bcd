from __future__ import annotations

import numpy as np
import pytest

import faintspot as fs
from faintspot.slopes.kernels.cuda.strips import WARP, Strips, strips_of

WINDOWS = [(ny, nx) for ny in range(1, 33) for nx in range(1, 33)]


def holds_zero(strips: Strips, lane: int, row: int, axis: str) -> bool:
    """Whether the dual field of a thread's row is zero along an axis: outside, or at the far edge."""
    strip, x = divmod(lane, strips.nx)
    y = strip * strips.rows + row
    outside = lane >= strips.threads or y >= strips.ny
    return outside or (x == strips.nx - 1 if axis == "x" else y == strips.ny - 1)


def test_every_pixel_has_one_thread() -> None:
    for ny, nx in WINDOWS:
        strips = strips_of((ny, nx))
        owners = np.zeros((ny, nx), int)
        for lane in range(strips.threads):
            strip, x = divmod(lane, nx)
            for y in range(strip * strips.rows, min((strip + 1) * strips.rows, ny)):
                owners[y, x] += 1
        assert strips.threads <= WARP
        assert np.all(owners == 1)
        assert (strips.strips - 1) * strips.rows + strips.last_row == ny - 1
        assert 0 <= strips.last_row < strips.rows


def test_beyond_the_edge_a_thread_answers_that_holds_zero() -> None:
    """What the left column and the top row, and threads without a pixel, get from their neighbours."""
    for window in WINDOWS:
        strips = strips_of(window)
        for lane in range(WARP):
            idle = lane >= strips.threads
            if idle or lane % strips.nx == 0:
                assert all(holds_zero(strips, (lane - 1) % WARP, r, "x") for r in range(strips.rows))
            if idle or lane < strips.nx:
                assert holds_zero(strips, (lane - strips.nx) % WARP, strips.rows - 1, "y")


@pytest.mark.parametrize("window", [(8, 33), (40, 32)])
def test_too_large_a_window_is_refused(window: tuple[int, int]) -> None:
    with pytest.raises(fs.InputError, match=f'window of {window[0]} x {window[1]} pixels: device="cuda"'):
        strips_of(window)
