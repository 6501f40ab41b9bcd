import threading
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.host import (
    WIDTHS,
    aligned_zeros,
    flush_subnormals,
    lanes_for,
    restore_control,
)


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
def test_other_simd_widths_are_refused(width: Any) -> None:
    with refused("SIMD width", "4, 8 or 16"):
        lanes_for(np.float32, width)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_scratch_memory_is_aligned(dtype: Any) -> None:
    for size in (1, 7, 1000):
        array = aligned_zeros(size, dtype)
        assert array.ctypes.data % 64 == 0
        assert array.shape == (size,)
        assert not array.any()


TINY = np.float32(1e-39)


@compiled
def _halves(numbers: Any, found: Any) -> None:
    """Halve numbers as before, with subnormal numbers flushed, and as before again."""
    for i in range(3):
        control = flush_subnormals() if i == 1 else 0
        for k in range(len(numbers)):
            found[i, k] = numbers[k] * np.float32(0.5)
        if i == 1:
            restore_control(control)


def test_subnormal_numbers_are_flushed_and_no_others() -> None:
    numbers = np.array([TINY, 1.5e-38, -TINY, 1.0, np.inf], np.float32)  # the second: its half is subnormal
    found = np.empty((3, 5), np.float32)
    _halves(numbers, found)
    np.testing.assert_array_equal(found[1], [0, 0, 0, 0.5, np.inf])
    for outside in (found[0], found[2]):
        np.testing.assert_array_equal(outside, numbers / 2)
        assert np.all(outside != 0)


@pytest.mark.parametrize("estimator", ["centroid", "thresholded"])
def test_measuring_leaves_the_thread_as_it_was(estimator: str) -> None:
    options = {"threshold_e": 0.5} if estimator == "thresholded" else {}
    layout = fs.Layout.grid((4, 4), pixels=8)
    pipeline = fs.SlopePipeline(layout, fs.Settings(estimator, **options))
    kept = []

    def measure() -> None:
        pipeline(np.ones(layout.frame_shape, np.float32))
        kept.append(np.multiply(np.array([TINY]), np.float32(0.5))[0] > 0)

    thread = threading.Thread(target=measure)
    thread.start()
    thread.join()
    measure()
    assert kept == [True, True]
