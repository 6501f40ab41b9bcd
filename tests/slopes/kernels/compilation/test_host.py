from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

from faintspot.slopes.kernels.compilation.host import WIDTHS, aligned_zeros, lanes_for


def test_float64_has_half_the_lanes() -> None:
    for width in WIDTHS:
        assert lanes_for(np.float32, width).width == width
        assert lanes_for(np.float64, width).width == width // 2
    assert lanes_for("float32", 8) is lanes_for(np.float32, 8)


def test_width_of_the_machine_and_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FAINTSPOT_SIMD_WIDTH", raising=False)
    assert lanes_for(np.float32).width in WIDTHS
    for width in WIDTHS:
        monkeypatch.setenv("FAINTSPOT_SIMD_WIDTH", str(width))
        assert lanes_for(np.float32).width == width
    assert lanes_for(np.float32, 4).width == 4  # the argument comes first


@pytest.mark.parametrize("width", [0, 2, 5, 32, "wide", 8.5])
def test_other_widths(width: Any) -> None:
    with refused("SIMD width", "4, 8 or 16"):
        lanes_for(np.float32, width)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scratch_memory_is_aligned(dtype: Any) -> None:
    for size in (1, 7, 1000):
        array = aligned_zeros(size, dtype)
        assert array.ctypes.data % 64 == 0
        assert array.shape == (size,)
        assert not array.any()
