"""The yardstick for denoisers and centroids: its judge is right, and a tiny run goes through."""

import numpy as np
import pytest

import faintspot as fs
from faintspot.slopes.simulate import Detector
from faintspot.slopes.spots.shapes import spots as images_of

pytest.importorskip("optax")
pytest.importorskip("skimage")

from benchmarks.yardstick import judge, spots
from benchmarks.yardstick.candidates import _tiled, _untiled


@pytest.fixture(scope="module")
def ours() -> spots.UnitSpots:
    return spots.ours(200, 1)


def test_the_bound_is_that_of_the_package(ours: spots.UnitSpots) -> None:
    # The package counts the electrons of a centred spot, and averages standard errors, not their squares.
    centred = images_of(np.zeros((1, 2)), shape=(16, 16)).sum()
    share = centred / images_of(ours.position, shape=(16, 16)).sum(axis=(1, 2)).mean()
    camera = Detector(read_noise_e=3.0)
    expected = fs.cramer_rao(300.0 * share, detector=camera, positions=ours.position).mean()
    assert ours.bound_px(300.0, 3.0) == pytest.approx(expected, rel=0.01)


def test_gain_and_reference_positions_are_no_errors(ours: spots.UnitSpots) -> None:
    gain, errors = judge.errors_of(0.7 * ours.position + [0.3, -0.2], ours)
    assert gain == pytest.approx(0.7)
    assert np.abs(errors).max() < 1e-9


def test_errors_of_few_frames_are_not_too_small() -> None:
    rng = np.random.default_rng(1)
    lenslet = np.tile(np.arange(1000), 3)
    truth = rng.uniform(-1, 1, (3000, 2))
    few = spots.UnitSpots(np.zeros((3000, 1, 1)), truth, lenslet, np.zeros(0), np.zeros(0))
    _, errors = judge.errors_of(truth + 0.1 * rng.standard_normal(truth.shape), few, 1.0)
    assert np.sqrt(np.square(errors).mean()) == pytest.approx(0.1, rel=0.05)  # 2 % is one standard error


def test_images_survive_being_a_frame(ours: spots.UnitSpots) -> None:
    images = ours.noisy(100.0, 1.0, 1)[:7, :5, :4]
    np.testing.assert_array_equal(_untiled(_tiled(images), images), images)


@pytest.mark.slow
def test_a_tiny_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(judge, "_TRAIN", (1, 64))
    monkeypatch.setattr(judge, "_SCORE", (2, 64))
    monkeypatch.setattr(judge, "_FEW_FAMILIES", ())
    means, cells, times = judge.run(("ours",), ((300, 3),), steps=3)
    efficiency = {row.name: row.values["ours"] for row in means.rows}
    assert 0.5 < efficiency["ml"] < 1.5  # the error of 64 spots is a fifth
    assert efficiency["window"] < efficiency["weighted"]
    assert {"tv", "wavelets", "network, position"} <= set(efficiency)
    assert [row.name for row in cells.rows] == [row.name for row in times.rows]
