"""Spots that their window cuts, or that are unlike all their neighbours, are flagged; others are not."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests import naive
from tests.patience import mostly_slow

import faintspot as fs
from faintspot import SubapertureFlag as Flag
from faintspot.slopes.kernels.groups import SlopeArrays
from faintspot.slopes.pipeline.slopes import RESULT_TYPES

SIDE = 20
LAYOUT = fs.Layout.grid((12, 12), pixels=SIDE, outer_radius=6.0)
PSF = fs.PSF.analytic("diffraction", size=1.6, radius_px=20)
N = len(LAYOUT)


def frame_of(positions: NDArray[Any], flux_e: NDArray[Any], seed: int) -> NDArray[np.float64]:
    """Return a frame whose spots reach into the windows of their neighbours."""
    rng, side = np.random.default_rng(seed), 3 * SIDE
    frame = np.zeros(np.array(LAYOUT.frame_shape) + 2 * SIDE)
    for corner, position, flux in zip(LAYOUT.corners, positions, flux_e, strict=True):
        rows, columns = (slice(first, first + side) for first in corner)
        frame[rows, columns] += PSF.images([position], (side, side), flux)[0]
    frame = frame[SIDE:-SIDE, SIDE:-SIDE]
    return np.asarray(rng.poisson(np.maximum(frame, 0)) + 2.0 * rng.standard_normal(frame.shape))


def measured(estimator: str, frame: NDArray[np.float64], **options: Any) -> fs.Slopes:
    settings = fs.Settings(estimator, **options, **({"noise_std": 2.0} if estimator == "tv" else {}))
    calibration = fs.Calibration(dark=0.0, read_noise_e=2.0)
    return fs.SlopePipeline(LAYOUT, settings, calibration, psf=PSF)(frame)


def number_of(row: int, column: int) -> int:
    return int(np.flatnonzero((LAYOUT.cells == (row, column)).all(axis=1))[0])


class TestAgainstOracle:
    @given(seed=st.integers(0, 2**32 - 1))
    def test_random_layouts_equal_the_oracle(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        rows, columns = (int(n) for n in rng.integers(1, 9, 2))
        layout = fs.Layout.grid((rows, columns), pixels=12, pitch=14, origin=(3, 3), frame_shape=(130, 130))
        layout = layout[np.sort(rng.permutation(len(layout))[: int(rng.integers(1, len(layout) + 1))])]
        n = len(layout)
        reference = rng.uniform(-1.0, 1.0, (n, 2))
        fwhm = rng.choice([1.5, 4.0, 8.0], n)
        pipeline = fs.SlopePipeline(layout, fs.Settings("centroid", spot_fwhm_px=fwhm), reference=reference)
        arrays = SlopeArrays(*(np.zeros((1, n), kind) for kind in RESULT_TYPES))
        wild = rng.random((2, n)) < 0.1
        arrays.x[0], arrays.y[0] = rng.normal(0.0, np.where(wild, 4.0, rng.choice([0.05, 0.5, 3.0])))
        arrays.flags[0] = rng.choice([0, 0, 0, Flag.NO_FLUX, Flag.SATURATED], n)
        arrays.flux[0] = rng.uniform(300.0, 400.0, n) * rng.choice([0.0, 1.0, 1.0, 1.0, 1.4, 2.0], n)
        before = arrays.flags.copy()
        pipeline.flag_doubtful(arrays, np.zeros((1, *layout.frame_shape), np.float32))
        slopes = fs.Slopes(*(array[0] for array in arrays))
        expected = naive.doubtful(slopes, layout, fwhm[:, None], reference)
        assert np.array_equal(slopes.flags, before[0] | expected)

    def test_hexagonal_neighbours_are_compared(self) -> None:
        rows, columns = np.divmod(np.arange(25), 5)
        centres = np.column_stack([20.0 + 14 * columns + 7 * rows, 20.0 + 13 * rows])
        corners = np.floor(centres[:, ::-1] - 5.5).astype(int)
        layout = fs.Layout(
            (110, 140), (11, 11), corners, centres, np.column_stack([rows, columns]), "hexagonal", 14.0
        )
        arrays = SlopeArrays(*(np.zeros((1, 25), kind) for kind in RESULT_TYPES))
        arrays.x[0, [0, 12]] = 3.0
        pipeline = fs.SlopePipeline(layout, fs.Settings("centroid"))
        pipeline.flag_doubtful(arrays, np.zeros((1, *layout.frame_shape), np.float32))
        assert np.flatnonzero(arrays.flags[0] & Flag.UNLIKE_NEIGHBOURS).tolist() == [0, 12]


class TestSecondSpots:
    """A reflection beside the spot or in place of it, which pulls less than displacements differ."""

    @pytest.mark.parametrize(("flux", "flagged"), [(1.0, False), (1.6, True), (0.5, False), (0.16, True)])
    def test_flux_decides_on_doubtful_spots(self, flux: float, flagged: bool) -> None:
        arrays = SlopeArrays(*(np.zeros((1, N), kind) for kind in RESULT_TYPES))
        arrays.x[0], arrays.y[0] = np.random.default_rng(1).uniform(-0.25, 0.25, (2, N))
        arrays.flux[0] = 1000.0
        middle = number_of(6, 6)
        arrays.x[0, middle], arrays.flux[0, middle] = 0.55, 1000.0 * flux
        pipeline = fs.SlopePipeline(LAYOUT, fs.Settings("brightest"))
        pipeline.flag_doubtful(arrays, np.zeros((1, *LAYOUT.frame_shape), np.float32))
        assert (arrays.flags[0] != 0).tolist() == [flagged and s == middle for s in range(N)]


@pytest.mark.parametrize("defocus_px", [0.0, 1.0])
def test_spots_between_wrong_ones_stay_valid(defocus_px: float) -> None:
    """Each of its four lines has a wrong spot; those that it continues on one side have none."""
    arrays = SlopeArrays(*(np.zeros((1, N), kind) for kind in RESULT_TYPES))
    arrays.y[0], arrays.x[0] = defocus_px * (LAYOUT.cells - 5.5).T
    wrong = [number_of(*cell) for cell in ((5, 6), (6, 5), (5, 5), (5, 7))]
    arrays.x[0, wrong] += 5.0, -4.0, 3.0, -6.0
    pipeline = fs.SlopePipeline(LAYOUT, fs.Settings("brightest"))
    pipeline.flag_doubtful(arrays, np.zeros((1, *LAYOUT.frame_shape), np.float32))
    assert np.flatnonzero(arrays.flags[0]).tolist() == sorted(wrong)


@pytest.mark.parametrize("estimator", mostly_slow(2, ["tv", "ml", "brightest", "smoothed", "weighted"]))
def test_planted_spots_are_flagged_and_others_are_not(estimator: str) -> None:
    """A spot outside its window, a spot cut by it, an unlit window that has its neighbour's flux."""
    far, cut, unlit, beside = (number_of(*cell) for cell in ((5, 3), (3, 8), (0, 6), (1, 6)))
    affected = [far, cut, unlit, beside, number_of(5, 4), number_of(4, 8)]  # the last have a second spot
    others = 0
    for seed in range(3):
        positions = np.random.default_rng(seed).normal(0.0, 0.4, (N, 2))
        flux_e = np.full(N, 2e4)
        positions[far], positions[cut], positions[beside] = (14.0, 0.0), (0.0, 9.5), (0.0, -7.0)
        flux_e[unlit] = 0.0
        slopes = measured(estimator, frame_of(positions, flux_e, seed), spot_fwhm_px=3.2)
        doubtful = slopes.flags & (Flag.AT_SEARCH_LIMIT | Flag.UNLIKE_NEIGHBOURS) != 0
        assert doubtful[[far, cut, unlit, beside]].all()
        assert slopes.flags[cut] & Flag.AT_SEARCH_LIMIT
        assert slopes.flags[unlit] & Flag.UNLIKE_NEIGHBOURS
        others += int(np.count_nonzero(np.delete(doubtful, affected)))
    assert others <= 0.01 * 3 * N


@pytest.mark.parametrize("estimator", ["brightest", "centroid", "ml"])
def test_independent_displacements_are_not_flagged(estimator: str) -> None:
    """Neighbours that know nothing of each other are no reason to doubt one of them."""
    positions = np.random.default_rng(1).uniform(-4.0, 4.0, (N, 2))
    slopes = measured(estimator, frame_of(positions, np.full(N, 5e3), 1), spot_fwhm_px=3.2)
    assert np.count_nonzero(slopes.flags) <= 0.01 * N


def test_a_layout_without_a_pitch_has_no_neighbours() -> None:
    images = PSF.images([(0.0, 0.0)] * 5 + [(4.0, 0.0)], (SIDE, SIDE), 1e4)
    assert not fs.measure_images(images, fs.Settings("brightest", keep_brightest=20)).flags.any()
