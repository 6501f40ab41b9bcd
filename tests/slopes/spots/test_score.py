"""The trained score: what it accepts, how it is stored, and what its passes compute."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.refusals import assert_each_refused, refused

from faintspot.base.errors import InputError
from faintspot.slopes.spots.score import TrainedScore, smoothed_peak


def random_score(**changes: Any) -> TrainedScore:
    rng = np.random.default_rng(3)
    values: dict[str, Any] = {
        "tables": 0.05 * rng.standard_normal((2, 3, 2, 2, 41, 37)),
        "flux_e": [10.0, 30.0, 100.0],
        "standard_error_px": rng.uniform(0.1, 0.3, (2, 3, 2)),
        "index": [0, 1, 1, 0, 1],
    }
    return TrainedScore(**(values | changes))


def naive_position(
    score: TrainedScore,
    kind: int,
    level: int,
    image: NDArray[np.float64],
    flux: float,
    start: Any,
    half: float,
) -> NDArray[np.float64]:
    """One spot, pixel by pixel."""
    position = np.array(start, float)
    ny, nx = image.shape
    rows, columns = score.tables.shape[-2:]
    for tables in score.tables[kind, level]:
        q = np.round(position * score.steps_per_px) / score.steps_per_px
        total = np.zeros(2)
        for i in range(ny):
            for j in range(nx):
                row = (i - (ny - 1) / 2 - q[1]) * score.steps_per_px + (rows - 1) / 2
                column = (j - (nx - 1) / 2 - q[0]) * score.steps_per_px + (columns - 1) / 2
                if 0 <= row < rows and 0 <= column < columns:
                    total += tables[:, int(row), int(column)] * image[i, j]
        position = np.clip(q + total / flux, -half, half)
    return position


@pytest.mark.parametrize("shape", [(8, 8), (7, 10)])
def test_equals_the_sum_over_pixels(shape: tuple[int, int]) -> None:
    score = random_score()
    rng = np.random.default_rng(1)
    images = rng.poisson(1.0, (4, 5, *shape)).astype(float)
    flux = np.array([9.0, 25.0, 70.0, 500.0])
    start = rng.uniform(-2, 2, (5, 2))
    found = score.apply(images, flux[:, None], start, search_range_px=3.0)
    for frame, level in enumerate([0, 1, 2, 2]):
        for number, kind in enumerate([0, 1, 1, 0, 1]):
            expected = naive_position(
                score, kind, level, images[frame, number], flux[frame], start[number], 3.0
            )
            np.testing.assert_allclose(found[frame, number], expected, atol=1e-12)


@given(
    x=st.floats(-20, 20),
    y=st.floats(-20, 20),
    half=st.floats(0.1, 9),
    home=st.floats(-2, 2),
    seed=st.integers(0, 99),
)
def test_stays_within_the_search_range(x: float, y: float, half: float, home: float, seed: int) -> None:
    images = 1e4 * np.random.default_rng(seed).standard_normal((5, 8, 8))
    found = random_score().apply(images, 10.0, [x, y], reference=home, search_range_px=half)
    assert np.all(np.abs(found - home) <= half * (1 + 1e-12))


def test_no_expected_flux_leaves_the_start() -> None:
    images = np.ones((5, 8, 8))
    np.testing.assert_array_equal(random_score().apply(images, 0.0, [0.3, -1.1])[2], [0.3, -1.1])
    np.testing.assert_array_equal(random_score().apply(images, -5.0, reference=[0.1, 0.2])[2], [0.1, 0.2])


def test_dark_images_stay_at_the_rounded_start() -> None:
    found = random_score().apply(np.zeros((5, 8, 8)), 10.0, [0.3, -1.1])
    np.testing.assert_array_equal(found[0], [0.25, -1.0])


def test_starts_at_the_peak() -> None:
    images = np.zeros((5, 8, 8))
    images[:, 2, 5] = 1.0
    score = random_score(tables=np.zeros((2, 3, 2, 2, 41, 37)), start="peak")
    np.testing.assert_array_equal(score.apply(images, 10.0), np.tile([1.5, -1.5], (5, 1)))


def test_peak_is_sought_within_the_range() -> None:
    image = np.zeros((1, 9, 9))
    image[0, 0, 0], image[0, 4, 5] = 100.0, 10.0
    np.testing.assert_array_equal(smoothed_peak(image, 0.5, np.zeros((1, 2)), 2.0), [[1.0, 0.0]])
    np.testing.assert_array_equal(smoothed_peak(image, 0.0, np.zeros((1, 2)), 4.0), [[-4.0, -4.0]])


def test_class_nearest_in_log_flux() -> None:
    # Borders at sqrt(10 * 30) = 17.3 and sqrt(30 * 100) = 54.8.
    np.testing.assert_array_equal(
        random_score().flux_class([-1, 5, 17, 18, 54, 55, 1e6]), [0, 0, 0, 1, 1, 2, 2]
    )


def test_standard_error_is_interpolated_in_log_flux() -> None:
    score = random_score()
    between = score.standard_error(np.sqrt(300.0))
    np.testing.assert_allclose(between, score.standard_error_px[score.index, :2].mean(axis=1))
    np.testing.assert_allclose(score.standard_error(1e9), score.standard_error_px[score.index, 2])
    assert random_score(index=None).standard_error(50.0).shape == (2, 2)


@pytest.mark.parametrize("index", [None, [0, 1, 1]])
def test_file_round_trip(tmp_path: Path, index: Any) -> None:
    score = random_score(index=index, start="peak", smoothing_px=0.9)
    score.save(tmp_path / "score.npz")
    assert TrainedScore.load(tmp_path / "score.npz") == score
    assert score != random_score(index=index)
    assert score != 1


def test_bad_files(tmp_path: Path) -> None:
    path = tmp_path / "score.npz"
    with pytest.raises(InputError, match="no such file"):
        TrainedScore.load(path)
    path.write_bytes(b"PK\x03\x04 not a score")
    with pytest.raises(InputError, match="expected a trained score"):
        TrainedScore.load(path)
    np.savez(path, tables=np.zeros(3))
    with pytest.raises(InputError, match="flux_e is missing"):
        TrainedScore.load(path)
    with path.open("wb") as file:
        np.savez(
            file, tables=np.zeros(3), flux_e=1, standard_error_px=1, steps_per_px=4, start="x", smoothing_px=1
        )
    with pytest.raises(InputError, match=r"score\.npz: score\.tables"):
        TrainedScore.load(path)
    with pytest.raises(InputError, match="cannot be written"):
        random_score().save(tmp_path / "absent" / "score.npz")


def test_bad_values() -> None:
    shape = (2, 3, 2, 2, 3, 3)
    assert_each_refused(
        random_score,
        tables=[np.zeros((2, 3, 2, 2, 40, 37)), np.full(shape, np.nan), np.full(shape, -1e38)],
        standard_error_px=[np.full((2, 3, 2), 1e39), np.ones((2, 3))],
        flux_e=[[10.0, 30.0], [10.0, 30.0, 20.0], [0.0, 30.0, 40.0]],
        steps_per_px=[3],
        start=["middle"],
        smoothing_px=[-1.0],
        index=[[0, 2], [[0]]],
    )


def test_bad_arguments() -> None:
    assert_each_refused(
        partial(random_score().apply, images=np.ones((5, 8, 8)), flux_e=10.0),
        images=[np.ones((8, 8))],
        flux_e=[[1.0, 2.0]],
        start=[np.zeros((4, 2)), [np.nan, 0.0]],
        search_range_px=[0.0],
    )
    with refused("expected 5 sub-apertures"):
        random_score().apply(np.ones((4, 8, 8)), 10.0)
