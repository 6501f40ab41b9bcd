"""Frames whose bytes were read in another order are recognised, right ones of any camera never refused."""

import numpy as np
import pytest

from faintspot.slopes.camera.frame_checks import misread

ROW, COLUMN = np.mgrid[:120, :120]


@pytest.mark.parametrize("peak", [300, 3000])
@pytest.mark.parametrize("offset", [300, 5000])
@pytest.mark.parametrize("std_px", [0.7, 1.6])
def test_order_of_bytes(peak: int, offset: int, std_px: float) -> None:
    """Right in 8 to 16 bits, aligned left or right; wrong where the bytes of 16 bits are taken apart."""
    spots = np.exp(-0.5 * (((ROW - 7.3) % 20 - 5) ** 2 + ((COLUMN - 9.1) % 20 - 5) ** 2) / std_px**2)
    noise = np.random.default_rng(1).normal(offset, 3.0, spots.shape)
    right = (peak * spots + noise).round().clip(0, 65535).astype(np.uint16)
    eight = (right // 8).clip(0, 255)
    for frame in (
        right,
        right.clip(0, 4095) * 16,
        right.clip(0, 1023) * 64,
        eight * 256,
        eight.astype(np.uint8),
    ):
        assert not misread(frame.astype(np.uint16) if frame.dtype != np.uint8 else frame)
    assert not misread(right.astype(np.float32))
    assert misread(right.view(np.uint8))
    if np.ptp(right >> 8):  # else its bytes swapped are the same picture, 256 times as bright
        assert misread(right.byteswap())
