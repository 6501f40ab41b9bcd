"""What the methods do to the images, against the public functions and SciPy."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import faintspot as fs
from faintspot.experiments import StudySpecification, Sweep
from faintspot.experiments.methods import keeps_every_k, knows_the_spot, label_of, style_of
from faintspot.experiments.study.cell import realisations
from faintspot.experiments.study.cell_methods import CellMethods, position_table
from faintspot.slopes.estimators import Estimator
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.registry import estimator_named

FLOOR = 1e-4


@pytest.fixture(scope="module")
def simulated() -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    detector = fs.slopes.simulate.Detector(read_noise_e=1.0)
    return fs.slopes.simulate.subapertures(
        60, shape=(10, 10), flux_e=100.0, detector=detector, rng=np.random.default_rng(3)
    )


@pytest.mark.parametrize(
    ("method", "options"),
    [("brightest", {}), ("tv", {"noise_std": 1.4}), ("smoothed", {"smoothing_px": 0.8})],
)
def test_methods_are_what_they_say(
    simulated: tuple[NDArray[np.float32], NDArray[np.float64]], method: str, options: dict[str, float]
) -> None:
    images, _ = simulated
    prepared = {
        "tv": lambda: fs.tv_denoise(images, 1.4),
        "smoothed": lambda: np.stack([gaussian_filter(i, 0.8, mode="constant") for i in images]),
    }.get(method, lambda: images)()
    estimator: Any = estimator_named(method)(**options)
    positions, valid = position_table(estimator, images)
    assert positions.shape == (60, 99, 2)
    assert valid[:, 6:].all()  # denoised pixels often tie, so that few kept pixels may leave nothing
    for k in (1, 7, 30, 99):
        kept = fs.brightest_pixels(prepared.astype(np.float64), keep=k)
        found = valid[:, k - 1]
        expected = fs.centre_of_gravity(kept)[found]
        np.testing.assert_allclose(positions[found, k - 1], expected, rtol=0, atol=1e-5)  # of float32


@given(
    seed=st.integers(0, 2**32 - 1),
    side=st.sampled_from([4, 5, 8, 16]),
    levels=st.sampled_from([0, 1, 3, 100]),
    offset=st.sampled_from([0.0, -3.0, 5.0]),
)
def test_every_k_is_the_definition(seed: int, side: int, levels: int, offset: float) -> None:
    rng = np.random.default_rng(seed)
    images = rng.normal(size=(3, side, side)) * 10.0 ** rng.integers(-3, 4)
    if levels:  # ties
        images = np.rint(images / np.abs(images).max() * levels)
    single = (images + offset).astype(np.float32)
    positions, valid = position_table(BrightestPixels(flux_floor=FLOOR), single)
    for k in range(1, side**2):
        left = fs.brightest_pixels(single.astype(np.float64), keep=k)
        total, largest = left.sum(axis=(1, 2)), np.abs(single).max(axis=(1, 2))
        expected = np.where((total > FLOOR * largest)[:, None], fs.centre_of_gravity(left), 0.0)
        # Round-off of double precision, magnified where low flux is left above the floor.
        clear = np.abs(total - FLOOR * largest) > 1e-9 * largest
        np.testing.assert_array_equal(valid[clear, k - 1], (total > FLOOR * largest)[clear])
        np.testing.assert_allclose(positions[clear, k - 1], expected[clear], rtol=0, atol=1e-8)


def test_flat_and_extreme_images() -> None:
    tiny = np.zeros((1, 4, 4), np.float32)
    tiny[0, 1, 2] = 1e-30
    for image in (np.zeros((1, 4, 4), np.float32), np.full((1, 4, 4), 7.1, np.float32)):
        positions, valid = position_table(BrightestPixels(), image)
        assert not valid.any()
        assert not positions.any()
    positions, valid = position_table(BrightestPixels(), tiny)
    assert valid.all()
    np.testing.assert_allclose(positions[0], np.broadcast_to([0.5, -0.5], (15, 2)))


def test_without_flux_the_position_is_the_centre() -> None:
    flat = np.full((1, 10, 10), 0.1, np.float32)
    positions, valid = position_table(TotalVariation(noise_std=1.4), flat)
    assert not valid.any()
    assert not positions.any()
    specification = StudySpecification("s", [Sweep("a", pixels=10)], estimators=["thresholded"])
    methods = CellMethods(specification.cells()[0], specification)
    slopes = methods.measure("thresholded", (("threshold_e", 5.0),), flat)
    assert not slopes.valid.any()
    assert slopes.x[0] == slopes.y[0] == 0.0


def test_positions_become_the_search_range(
    simulated: tuple[NDArray[np.float32], NDArray[np.float64]],
) -> None:
    free, valid = position_table(BrightestPixels(), simulated[0])
    held, also_valid = position_table(BrightestPixels(), simulated[0], 0.3)
    assert np.abs(free).max() > 1.0
    np.testing.assert_array_equal(held, np.clip(free, -0.3, 0.3))
    np.testing.assert_array_equal(valid, also_valid)


def test_methods_of_other_installations_have_a_name_and_a_style() -> None:
    assert label_of("of another installation") == "of another installation"
    assert style_of("of another installation") == Estimator.style
    assert [method for method in ("brightest", "weighted", "ml", "nobody's") if knows_the_spot(method)] == [
        "weighted",
        "ml",
    ]
    assert [keeps_every_k(estimator_named(method)) for method in ("tv", "thresholded")] == [True, False]


def test_candidates_in_a_cell() -> None:
    specification = StudySpecification(
        "x",
        [Sweep("a", pixels=16, d_over_r0=[0, 2])],
        estimators=["brightest", "tv", "ml", "weighted"],
        options={"noise_std": [0.5, 1.0], "blur_px": [0.0, 1.0], "model_error": [0.2]},
    )
    still, speckled = (CellMethods(cell, specification) for cell in specification.cells())
    assert still.candidates("brightest") == [()]
    assert still.candidates("tv") == [(("noise_std", 0.5),), (("noise_std", 1.0),)]
    assert still.estimator("tv", (("noise_std", 0.5),)).noise_std == 0.5 * still.cell.pixel_noise_e  # type: ignore[attr-defined]
    assert still.candidates("ml") == [(("blur_px", 0.0), ("model_error", 0.0))]
    assert speckled.candidates("ml") == [(("blur_px", blur), ("model_error", 0.2)) for blur in (0.0, 1.0)]
    assert len(still.candidates("weighted")) > 1


@pytest.mark.usefixtures("own_estimator")
def test_an_estimator_of_somebody_else() -> None:
    """It tunes an option of its own, is told the spot's width, and is measured like any other."""
    specification = StudySpecification(
        "s", [Sweep("a", flux_e=1000, pixels=10)], realisations=200, estimators=["own"], fixed_k=[]
    )
    cell = specification.cells()[0]
    methods = CellMethods(cell, specification)
    assert methods.candidates("own") == [(("power", 1.0),), (("power", 2.0),)]
    assert specification.search_range_of(cell) == 1.0
    ((images, truth),) = realisations(cell, 50, np.random.default_rng(1))
    slopes = methods.measure("own", (("power", 2.0),), images)
    found = np.stack([slopes.x, slopes.y], axis=-1)
    assert np.abs(found - truth).mean() < 0.3
    measured = fs.experiments.measure_cell(cell, specification)
    assert measured["chosen_candidate"][0, 0] in (1.0, 2.0)
    assert measured["error"][0, 0] < 0.3
