"""Images and settings that no estimator expects: nothing raises, nothing is NaN, no flux is flagged."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from tests.estimator_cases import (
    Case,
    assert_same,
    assert_sane,
    one_psf,
    random_case,
    settings_of,
    with_noise_map,
    with_options,
)
from tests.patience import examples, mostly_slow
from tests.refusals import refused
from tests.slopes.estimators.image_cases import KINDS, MAGNITUDES

import faintspot as fs
from faintspot.slopes.estimators import estimators
from faintspot.slopes.kernels import groups
from faintspot.slopes.pipeline.images import measure_images
from faintspot.slopes.spots.psf import PSF

Flag = fs.SubapertureFlag
SEEDS = st.integers(0, 2**32 - 1)
EVERY = pytest.mark.parametrize("estimator", list(estimators()))
FITTED = ("ml", "map")


def hostile_images(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """One kind of trouble for each image, in any unit; some pixels, or all, are not finite."""
    n, window = shape[0], (shape[1], shape[2])
    units = rng.choice([*MAGNITUDES, 1e-30, 1e30, 3e38], (n, 1, 1)) * rng.choice([1, 1, -1], (n, 1, 1))
    images = units * [KINDS[kind](rng, window) for kind in rng.choice(list(KINDS), n)]
    part = rng.choice([0.0, 0.0, 0.2, 0.5, 1.0], (n, 1, 1))
    bad = rng.choice([np.nan, np.inf, -np.inf], (n, 1, 1))
    with np.errstate(over="ignore"):
        return np.where(rng.random(shape) < part, bad, images).astype(np.float32)


def flat_case(estimator: str, images: NDArray[Any], **changes: Any) -> Case:
    """Images with the simplest settings."""
    chosen: dict[str, Any] = {"threshold_e": 1.0, "spot_fwhm_px": 2.0, "keep_brightest": 5, **changes}
    psf = one_psf() if estimator in FITTED else None
    return Case(images, settings_of(estimator, **chosen), fs.Calibration(dark=0.0, read_noise_e=1.0), psf)


class TestImages:
    @pytest.mark.slow
    @EVERY
    @given(seed=SEEDS)
    @examples(8)
    def test_hostile_images_give_sane_slopes(self, estimator: str, seed: int) -> None:
        case = random_case(seed, estimator)
        rng = np.random.default_rng(seed)
        images = hostile_images(rng, case.images.shape)
        measured = rng.random() < 0.5
        chosen = case.settings
        if measured:
            chosen = with_options(chosen.replace(flux_e=None), normalisation="frame")
        chosen = with_options(chosen, local_background=str(rng.choice(["on", "off"])))
        if rng.random() < 0.3:
            case = with_noise_map(case, seed)
        assert_sane(replace(case, images=images, settings=chosen).measure())

    @EVERY
    def test_all_pixels_bad(self, estimator: str) -> None:
        case = flat_case(estimator, np.full((5, 8, 9), np.nan, np.float32))
        slopes = case.measure()
        assert_sane(slopes)
        assert np.all(slopes.flags == Flag.TOO_MANY_BAD_PIXELS)
        assert np.all(slopes.bad_pixels == 72)

    @EVERY
    @pytest.mark.parametrize("level", [0.0, -40.0])
    def test_no_flux_is_flagged(self, estimator: str, level: float) -> None:
        """A frame without any flux in which light was expected."""
        case = flat_case(estimator, np.full((5, 8, 9), level, np.float32), flux_e=400.0)
        slopes = case.measure()
        assert_sane(slopes)
        if estimator == "smoothed" and level < 0:
            return  # the zeros beyond the window are the flux that it sees
        if estimator == "window":
            return  # it divides by the flux that was expected, so that a faint frame is no worse than others
        assert np.all(slopes.flags & Flag.NO_FLUX)

    @pytest.mark.parametrize(
        ("estimator", "known", "most"),
        [
            ("ml", {}, 0.04),
            ("weighted", {}, 0.04),
            ("map", {"flux_e": 400.0, "prior_std_px": 1.0}, 0.1),
        ],
    )
    def test_dark_frames_are_flagged(self, estimator: str, known: dict[str, float], most: float) -> None:
        """Read noise alone makes about 1 % of spots that look sound; 500 images tell to 0.5 %."""
        images = np.random.default_rng(3).normal(0.0, 1.0, (500, 10, 10)).astype(np.float32)
        slopes = flat_case(estimator, images, **known).measure()
        assert_sane(slopes)
        assert np.mean(slopes.flags == 0) < most

    @pytest.mark.slow  # compiled anew, for whole numbers: one of each family
    @pytest.mark.parametrize("estimator", ["brightest", "tv", "window", "ml"])
    def test_bad_pixels_and_saturation_are_counted(self, estimator: str) -> None:
        images = np.round(one_psf().images(np.zeros((6, 2)), (9, 9), 3000.0)).astype(np.uint16)
        images[0, 4, 4] = 65535
        case = flat_case(estimator, images)
        mask = np.zeros((54, 9), bool)
        mask[9 + 4, 5] = True  # next to the middle of the second image: one that every estimator looks at
        slopes = replace(case, calibration=replace(case.calibration, bad_pixels=mask)).measure()
        assert_sane(slopes)
        assert slopes.flags[0] & Flag.SATURATED
        assert slopes.bad_pixels.tolist() == [0, 1, 0, 0, 0, 0]
        assert np.all(slopes.flags[1:] == 0)

    @pytest.mark.parametrize(  # each is compiled anew
        ("estimator", "dtype"),
        [
            *product(["brightest"], ["uint8", "uint16", "int16", "float16", "float64", ">f4"]),
            pytest.param("ml", "uint16", marks=pytest.mark.slow),
        ],
    )
    def test_slopes_do_not_depend_on_the_type_of_pixels(self, estimator: str, dtype: str) -> None:
        """Whole numbers that all of them hold give one answer; frames are the same for every estimator."""
        images = np.round(one_psf().images([[0.3, -0.2]] * 4, (8, 8), 500.0)).clip(0, 200)
        case = flat_case(estimator, images.astype(np.float32))
        assert_same(case.measure(), replace(case, images=images.astype(dtype)).measure())

    @EVERY
    def test_outside_flux_does_not_pull(self, estimator: str) -> None:
        """A spot beyond the search range gives a slope within it."""
        images = one_psf().images([[3.0, -3.0]] * 4, (12, 12), 2000.0).astype(np.float32)
        slopes = flat_case(estimator, images, search_range_px=0.5, flux_e=2000.0).measure()
        assert_sane(slopes)
        assert np.all(np.abs(slopes.vector) <= 0.5)


class TestSettings:
    @EVERY
    @given(seed=SEEDS)
    @examples(2)
    def test_extreme_settings_give_sane_slopes(self, estimator: str, seed: int) -> None:
        rng = np.random.default_rng(seed)
        case = random_case(seed, estimator, n=6)

        def extreme(*values: float) -> NDArray[np.float64]:
            return rng.choice(values, 6)

        chosen = with_options(
            case.settings,
            search_range_px=extreme(1e-3, 0.5, 3.0, 1e4),
            flux_e=extreme(1e-3, 1.0, 1e12),
            prior_std_px=extreme(1e-6, 0.3, 1e4),
            weight_fwhm_px=extreme(0.1, 2.0, 1e3),
            spot_fwhm_px=extreme(0.1, 2.0),
            smoothing_px=extreme(0.01, 1.0, 16.0),
            threshold_e=extreme(0.0, 1e12),
            model_error=extreme(0.0, 10.0),
            weight_floor=extreme(0.0, 1.0),
            error_scale=extreme(1e-3, 1e3),
            steps=int(rng.choice([1, 100])),
            local_background=str(rng.choice(["on", "off"])),
        )
        calibration = replace(case.calibration, read_noise_e=float(rng.choice([0.0, 1e-6, 1e6])))
        prior = rng.normal(0.0, 1.0, (6, 2)) * rng.choice([1.0, 1e3, 1e30])
        assert_sane(replace(case, settings=chosen, calibration=calibration, prior=prior).measure())

    @EVERY
    @pytest.mark.parametrize("distance", [3.9, 40.0])
    def test_reference_at_the_edge_and_outside(self, estimator: str, distance: float) -> None:
        case = random_case(1, estimator, n=5, window=(8, 8))
        for reference in ([distance, 0.0], [-distance, distance]):
            assert_sane(case.measure(reference=np.tile(reference, (5, 1))))

    @EVERY
    @pytest.mark.parametrize("number", mostly_slow(1, [np.nan, 3e38, -3e38]))
    def test_indices_stay_within_the_tables(self, estimator: str, number: float) -> None:
        """Whatever numbers come past the door: reading outside of the tables would end the process."""
        case = random_case(1, estimator, n=5, window=(8, 8))
        for row in (groups.ZERO_X, groups.ZERO_Y, groups.RANGE):
            pipeline = case.pipeline()
            for table in pipeline.plan._levels:
                table[row] = number
            assert pipeline(case.images.reshape(-1, 8), case.prior).x.shape == (5,)

    @EVERY
    @pytest.mark.parametrize("number", mostly_slow(1, [np.nan, 1e6]))
    def test_a_prior_that_no_frame_can_hold_counts_as_none(self, estimator: str, number: float) -> None:
        """For the sub-apertures that have it; a loop that diverges must not stop the camera."""
        case = random_case(4, estimator, n=6)
        prior = np.full((6, 2), 0.3)
        prior[::2] = number
        expected = replace(case, prior=np.where(np.abs(prior) < 1, prior, 0.0)).measure()
        assert_same(replace(case, prior=prior).measure(), expected)

    @pytest.mark.parametrize("estimator", mostly_slow(1, FITTED))
    @pytest.mark.parametrize("nodes", [5, 41])
    def test_small_and_odd_psfs(self, estimator: str, nodes: int) -> None:
        """Smaller than a pixel's reach, one-sided, or with negative parts."""
        rng = np.random.default_rng(nodes)
        case = random_case(2, estimator, n=7)
        samples = rng.normal(0.2, 1.0, (nodes, nodes))
        samples[nodes // 2, nodes // 2] += 30.0
        for oversampling in (1, 4):
            assert_sane(replace(case, psf=PSF(samples, oversampling)).measure())

    def test_spot_wider_than_the_window(self) -> None:
        psf = PSF.analytic("gaussian", size=6.0, radius_px=40)
        for estimator in FITTED:
            case = random_case(3, estimator, n=6, window=(4, 5))
            assert_sane(replace(case, psf=psf).measure())


class TestRefused:
    """One line that names the value, what was expected and where."""

    IMAGES = np.ones((3, 8, 8), np.float32)
    NOISE = fs.Calibration(dark=0.0, read_noise_e=1.0)

    @pytest.mark.parametrize("number", [np.nan, np.inf, -1e39, 1e39, 1e6])
    def test_a_reference_that_no_frame_can_hold(self, number: float) -> None:
        case = random_case(1, "brightest", n=5, window=(8, 8))
        with refused("reference", "expected"):
            case.pipeline(reference=np.full((5, 2), number))

    def test_bad_images_and_priors(self) -> None:
        chosen = fs.Settings(estimator="map", flux_e=10.0)

        def run(images: Any, prior: Any = None) -> fs.Slopes:
            return measure_images(images, chosen, calibration=self.NOISE, psf=one_psf(), prior=prior)

        for images, words in (
            (np.ones((8, 8)), "(8, 8)"),
            (np.ones((2, 3, 8, 8)), "(2, 3, 8, 8)"),
            (np.ones((0, 8, 8)), "empty"),
            (np.ones((3, 8, 8), complex), "complex"),
            ([["a"]], "real numbers"),
        ):
            with refused("images", words):
                run(images)
        for prior, words in (
            (np.zeros((2, 2)), "(2, 2)"),
            (np.zeros((4, 3, 2)), "(4, 3, 2)"),
            ("ahead", "real numbers"),
        ):
            with refused("prior", words):
                run(self.IMAGES, prior)
