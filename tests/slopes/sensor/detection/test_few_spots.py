"""Arrays of at most 4 x 4 lenslets, in random frames and with hints."""

import numpy as np
import pytest
from benchmarks.frames.simulated_arrays import gaussians
from benchmarks.frames.small_arrays import small_array, verdict
from numpy.typing import NDArray

from faintspot.slopes.sensor.detection.lenslets import find_lenslets


@pytest.mark.parametrize("index", [1, 3, 13])
def test_arrays_are_right_or_named_as_doubtful(index: int) -> None:
    assert verdict(small_array(1, index))[0] in ("right", "doubted", "hinted")


@pytest.mark.slow
def test_few_of_random_arrays_are_lost_and_none_is_wrong() -> None:
    """Of 1,000, 8 are refused without the right hint."""
    verdicts = [verdict(small_array(1, index))[0] for index in range(20, 50)]
    assert verdicts.count("lost") <= 1
    assert "WRONG" not in verdicts


def four_spots(part: float, ghosts: int = 4) -> NDArray[np.float64]:
    """Return four spots turned by 40 degrees, with ghosts of so many of them and this part of their flux."""
    at = 90 + 100j + 24 * np.exp(0.7j) * np.array([0, 1, 1j, 1 + 1j])
    image = gaussians(
        (220, 240), np.append(at, at[:ghosts] + 70 - 45j), [600] * 4 + [600 * part] * ghosts, 3.0
    )
    return np.asarray(image + np.random.default_rng(1).normal(0, 4, image.shape))


def test_ghosts_of_four_spots_are_not_theirs() -> None:
    grid = find_lenslets(four_spots(0.15))
    assert (len(grid.cells), len(grid.elsewhere), grid.doubt) == (4, 4, "")
    assert grid.pitch_px == pytest.approx(24.0, abs=0.1)


def test_another_bright_spot_needs_a_hint() -> None:
    image = four_spots(0.7, 1)
    assert "--grid" in find_lenslets(image).doubt
    grid = find_lenslets(image, grid=(2, 2), roi=(0, 70, 150, 200))
    assert (len(grid.cells), grid.doubt) == (4, "")


def test_a_stated_angle_excludes_other_arrays() -> None:
    turned = np.degrees(0.7)
    assert find_lenslets(four_spots(0.0), grid=(2, 2), angle_deg=turned).angle_deg == pytest.approx(
        turned, abs=1
    )
