from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.slopes.camera.frame_checks import LargestValues


def spots(seed: int, peak: float = 9000.0) -> NDArray[np.float64]:
    """Five frames of 36 spots whose peaks are from 0.3 of the largest, and noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:72, :72]
    mean = np.zeros((72, 72))
    for row in range(6):
        for column in range(6):
            away = (x - 12 * column - 6 - rng.uniform(-1, 1)) ** 2 + (y - 12 * row - 6) ** 2
            mean += rng.uniform(0.3, 1.0) * peak * np.exp(-away / 4.5)
    return np.asarray(rng.poisson(mean, (5, 72, 72)) + rng.normal(100.0, 4.0, (5, 72, 72)))


def level_of(*blocks: NDArray[Any]) -> float | None:
    values = LargestValues()
    for block in blocks:
        values.add(block)
    return values.saturation_adu


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("kind", ["u2", "f4", "i4"])
def test_clipped_frames_show_their_level(bits: int, step: int, kind: str) -> None:
    """Aligned right or left, whatever type holds them."""
    largest = 2**bits - 1
    clipped = np.rint(np.clip(spots(bits, 2.5 * largest), 0, largest)) * step
    assert level_of(clipped.astype(kind)) == largest * step


def test_the_limit_of_the_type_is_known_anyway() -> None:
    assert level_of(np.clip(8 * spots(1), 0, 65535).astype(np.uint16)) is None


@pytest.mark.parametrize("peak", [20.0, 200.0, 3000.0, 9000.0])
@pytest.mark.parametrize("kind", ["u2", "f4"])
def test_other_frames_have_none(peak: float, kind: str) -> None:
    for seed in range(5):
        frames = spots(seed, peak)
        frames[:, 7, 9] = 30000.0  # a hot pixel
        assert level_of(np.rint(frames).astype(kind)) is None


def test_a_largest_value_that_comes_later_replaces_others() -> None:
    low, high = spots(1, 2000.0).astype(np.uint16), np.clip(spots(2), 0, 4095).astype(np.uint16)
    assert level_of(low, high) == 4095
    assert level_of(high, low) == 4095


@pytest.mark.parametrize("frame", [np.zeros((1, 8, 8)), np.full((1, 8, 8), np.nan), np.eye(8)[None] * 7])
def test_frames_without_spots(frame: NDArray[np.float64]) -> None:
    assert level_of(frame) is None


def test_noise_free_frames_of_equal_spots() -> None:
    """All spots have the same largest value, and the same ones below it."""
    y, x = np.mgrid[:12, :12]
    spot = 1000.0 * np.exp(-((x - 5.5) ** 2 + (y - 5.5) ** 2) / 4.5)
    assert level_of(np.tile(spot, (3, 6, 6))) is None
