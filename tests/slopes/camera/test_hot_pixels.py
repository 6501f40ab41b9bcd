import numpy as np
import pytest
from tests.simulated import frames_of

import faintspot as fs
from faintspot.slopes.camera.frame_checks import find_hot_pixels
from faintspot.slopes.simulate import Detector


def test_hot_pixels_among_spots_are_found_and_spots_are_not() -> None:
    layout = fs.Layout.grid((6, 6), pixels=16)
    hot = [(5, 5, 200.0), (34, 46, 400.0), (95, 0, 150.0), (60, 23, 300.0)]
    frames, _ = frames_of(
        layout,
        1,
        flux_e=3000.0,
        detector=Detector(read_noise_e=3.0, hot_pixels=hot),
        rng=np.random.default_rng(4),
    )
    found = {(int(row), int(column)) for row, column in find_hot_pixels(frames[0])}
    assert found == {(row, column) for row, column, _ in hot}


@pytest.mark.parametrize("step", [(0, 1), (1, 0), (1, 1), (1, -1)])
@pytest.mark.parametrize("second", [0.2, 1.0])
def test_pairs_of_hot_pixels_are_found(step: tuple[int, int], second: float) -> None:
    image = np.random.default_rng(2).normal(100, 3, (30, 30))
    pair = np.array([[12, 17], [12 + step[0], 17 + step[1]]])
    image[tuple(pair.T)] += [900.0, 900.0 * second]
    found = find_hot_pixels(image)
    assert sorted(map(tuple, found.tolist())) == sorted(map(tuple, pair.tolist()))


@pytest.mark.parametrize("size", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("profile", ["diffraction", "gaussian"])
def test_no_noiseless_spot_is_a_hot_pixel(profile: str, size: float) -> None:
    positions = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    for image in fs.slopes.simulate.spots(positions, profile=profile, size=size):
        assert len(find_hot_pixels(image)) == 0


def test_known_bad_pixels_are_left_out_and_the_frame_is_not_changed() -> None:
    frame = np.random.default_rng(1).normal(0, 1, (30, 30))
    frame[3, 4], frame[10, 10] = np.nan, 100.0
    before = frame.copy()
    assert find_hot_pixels(frame).tolist() == [[10, 10]]
    np.testing.assert_array_equal(frame, before)
    assert len(find_hot_pixels(np.full((5, 5), np.nan))) == 0


@pytest.mark.parametrize(
    ("frame", "threshold", "named"),
    [(np.zeros(3), 8, "frame"), (np.zeros((2, 3, 3)), 8, "frame"), (np.zeros((3, 3)), 0, "threshold")],
)
def test_bad_input(frame: object, threshold: float, named: str) -> None:
    with pytest.raises(fs.InputError, match=named):
        find_hot_pixels(frame, threshold=threshold)  # type: ignore[arg-type]
