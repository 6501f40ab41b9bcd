"""Every estimator's kernel equals the oracle, whatever shares its group, its frame or its threads."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.optimize import minimize
from tests import naive_estimators as oracle
from tests.estimator_cases import FIELDS, Case, assert_same, assert_sane, one_psf, random_case, with_noise_map
from tests.estimator_oracle import assert_equals_oracle
from tests.patience import examples

import faintspot as fs
from faintspot.slopes.estimators import estimators
from faintspot.slopes.kernels.groups import Scratch
from faintspot.slopes.kernels.parallel import run_groups
from faintspot.slopes.pipeline.images import measure_images
from faintspot.slopes.spots.bounds import cramer_rao
from faintspot.slopes.spots.psf import PSF

SEEDS = st.integers(0, 2**32 - 1)
EVERY = pytest.mark.parametrize("estimator", list(estimators()))
QUICK = [name for name in estimators() if name != "map"]  # its oracle looks at every position of a grid


def on_unknown_background(case: Case, seed: int) -> Case:
    """The same with a constant fitted along, and a dark that is off by some ADU."""
    off = np.random.default_rng(seed).normal(0.0, 5.0)
    calibration = replace(case.calibration, dark=case.calibration.dark + off)
    return replace(case, settings=case.settings.replace(local_background="on"), calibration=calibration)


class TestAgainstOracle:
    @pytest.mark.parametrize("estimator", QUICK)
    @given(seed=SEEDS)
    @examples(4)
    def test_random_spots_equal_the_oracle(self, estimator: str, seed: int) -> None:
        case = random_case(seed, estimator)
        assert_equals_oracle(case, case.measure())

    @pytest.mark.slow  # one of each family, as each is compiled anew
    @pytest.mark.parametrize("estimator", ["tv", "window", "weighted", "ml"])
    @given(seed=SEEDS)
    @examples(10)
    def test_random_spots_with_a_noise_map(self, estimator: str, seed: int) -> None:
        case = with_noise_map(random_case(seed, estimator), seed)
        assert_equals_oracle(case, case.measure())

    @pytest.mark.slow  # compiled for noise maps, as the next one
    @given(seed=SEEDS)
    @examples(3)
    def test_noise_map_on_an_unknown_background(self, seed: int) -> None:
        case = on_unknown_background(with_noise_map(random_case(seed, "ml"), seed), seed)
        assert_equals_oracle(case, case.measure())

    @pytest.mark.slow
    @given(seed=SEEDS)
    @example(seed=487)  # no position of the grid is both near the prior and within the limits
    @examples(2)
    def test_posterior_with_a_noise_map(self, seed: int) -> None:
        case = with_noise_map(random_case(seed, "map", n=2), seed)
        assert_equals_oracle(case, case.measure())

    @given(seed=SEEDS)
    @example(seed=188536)  # a third of the expected flux, beyond the search limit
    @example(seed=34)  # broad along one axis alone
    @examples(2)
    def test_random_spots_with_a_prior(self, seed: int) -> None:
        case = random_case(seed, "map", n=2)
        assert_equals_oracle(case, case.measure())

    @given(seed=SEEDS)
    @examples(5)
    def test_random_spots_on_an_unknown_background(self, seed: int) -> None:
        case = on_unknown_background(random_case(seed, "ml"), seed)
        assert_equals_oracle(case, case.measure())

    @pytest.mark.parametrize("seed", [1, 2, 3])
    def test_posterior_on_an_unknown_background(self, seed: int) -> None:
        case = on_unknown_background(random_case(seed, "map", n=2, window=(10, 11)), seed)
        assert_equals_oracle(case, case.measure())

    @pytest.mark.slow
    # Each is compiled anew: test_pipeline.py has "tv", and `make fuzz` compares every estimator.
    @pytest.mark.parametrize("width", [8, 16])
    @pytest.mark.parametrize("estimator", ["window", "ml"])
    def test_any_simd_width(self, estimator: str, width: int) -> None:
        case = random_case(width, estimator, n=7)
        assert assert_equals_oracle(case, case.measure(width=width)) > 2

    @pytest.mark.parametrize("estimator", ["ml", "weighted", "window", "brightest"])
    @pytest.mark.parametrize("window", [(2, 2), (3, 5), (5, 17), (20, 24)])
    def test_any_window_equals_the_oracle(self, estimator: str, window: tuple[int, int]) -> None:
        case = random_case(11, estimator, n=6, window=window)
        assert assert_equals_oracle(case, case.measure()) > 2

    def test_comparison_is_not_empty(self) -> None:
        """Most random spots are compared: less than a fifth is invalid or near a decision."""
        compared = total = 0
        for seed in range(3):
            case = random_case(seed, "ml", n=8)
            compared += assert_equals_oracle(case, case.measure())
            total += 8
        assert compared > 0.8 * total

    def test_standard_error_of_denoised_images(self) -> None:
        """From the pixels that are left of the denoised image, and the noise of the measured ones."""
        case = random_case(4, "tv", n=9)
        denoising = case.settings.replace(noise_std=1.0, error_scale=1.0)
        pipeline = replace(case, settings=denoising).pipeline()
        stages = pipeline.explain(case.images.reshape(-1, case.images.shape[2]))
        noise = case.calibration.read_noise_photoelectrons or 0.0
        excess = case.calibration.excess_noise
        variance = noise**2 + excess * case.calibration.background_e
        for s in np.flatnonzero(stages.slopes.valid):
            left, g = stages.background_subtracted[s], stages.calibrated[s]
            expected = oracle.gravity_error(left, g, variance, excess, spread=1.5)[:2]
            found = stages.slopes.standard_error_x[s], stages.slopes.standard_error_y[s]
            np.testing.assert_allclose(found, expected, rtol=1e-4)  # float32 sums of a few hundred pixels
            y, x = (np.arange(side) - 0.5 * (side - 1) for side in left.shape)
            noise = variance + excess * g
            noise = np.where(noise > 0, np.minimum(noise, 1.5 * left**2), noise)
            weight = np.where(left > 0, noise, 0.0) / left.sum() ** 2
            away_x, away_y = x - (left.sum(axis=0) @ x) / left.sum(), y - (left.sum(axis=1) @ y) / left.sum()
            covariance = stages.slopes.covariance_xy[s]
            assert abs(covariance - away_y @ weight @ away_x) < 1e-4 * expected[0] * expected[1]


class TestIndependence:
    """Slopes are the same bit by bit."""

    @EVERY
    def test_order_of_the_subapertures(self, estimator: str) -> None:
        case = random_case(3, estimator, n=21)
        order = np.random.default_rng(1).permutation(21)
        assert_same(case.measure(), case.select(order).measure(), order)

    @EVERY
    def test_threads_and_frames(self, estimator: str) -> None:
        case = random_case(5, estimator, n=19, window=(9, 11))
        height, width = case.layout.frame_shape
        frames = np.stack([case.images.reshape(height, width)] * 4)
        frames += np.arange(4, dtype=np.float32)[:, None, None]
        prior = np.random.default_rng(2).normal(0.0, 0.5, (4, 19, 2))
        together = case.pipeline(threads=1)(frames, prior)
        assert_same(together, case.pipeline(threads=7)(frames, prior))
        for i in range(4):
            alone = case.pipeline()(frames[i], prior[i])
            for name in FIELDS:
                assert np.array_equal(getattr(together, name)[i], getattr(alone, name)), name

    @EVERY
    def test_slopes_do_not_depend_on_neighbours(self, estimator: str) -> None:
        """Also next to images of another kind, when they are set alike and have one PSF."""
        case = random_case(8, estimator, n=12)
        psf = one_psf() if case.psf is not None else None
        alike = {
            name: value[0] for name, value in case.settings.chosen().items() if isinstance(value, np.ndarray)
        }
        case = replace(case, psf=psf, settings=case.settings.replace(**alike))
        expected = case.measure()
        hostile = case.images.copy()
        hostile[1::2] = np.resize(
            np.array([0, np.nan, 1e30, -5e3, 7, np.inf], np.float32), hostile[1::2].shape
        )
        calm = replace(case, images=hostile).measure()
        for name in FIELDS:
            assert np.array_equal(getattr(calm, name)[::2], getattr(expected, name)[::2]), name
        assert_same(expected, case.select(slice(2, 9)).measure(), slice(2, 9))

    def test_measure_is_the_pipeline(self) -> None:
        case = random_case(9, "map", n=5)
        parts: dict[str, Any] = {"psf": case.psf, "prior": case.prior}
        slopes = measure_images(case.images, case.settings, calibration=case.calibration, **parts)
        assert_same(slopes, case.measure())

    def test_measured_flux_does_not_depend_on_frames_before(self) -> None:
        case = random_case(10, "map", n=6)
        measured = replace(case, settings=case.settings.replace(flux_e=None))
        frame = case.images.reshape(-1, case.images.shape[2])
        used, fresh = measured.pipeline(), measured.pipeline()
        used(np.stack([frame * scale for scale in (9.0, 0.1, 3.0)]))
        assert_same(used(frame), fresh(frame))


class TestNoiseMap:
    @pytest.mark.slow
    @EVERY
    def test_constant_map_is_the_number(self, estimator: str) -> None:
        """Of one variance, so that only the order of roundings may differ."""
        case = random_case(21, estimator, n=9)
        number = case.calibration.read_noise_e
        shape = case.layout.frame_shape
        same = replace(case.calibration, read_noise_e=np.full(shape, number))
        found, expected = replace(case, calibration=same).measure(), case.measure()
        assert np.array_equal(found.flags, expected.flags)
        for name in ("x", "y", "flux", "standard_error_x", "standard_error_y"):
            values = getattr(expected, name)
            np.testing.assert_allclose(getattr(found, name), values, rtol=1e-5, atol=1e-5, err_msg=name)

    @pytest.mark.slow
    @pytest.mark.parametrize("estimator", ["tv", "weighted"])
    def test_images_and_widths(self, estimator: str) -> None:
        """Calibrated images and other SIMD widths give what the frames give."""
        case = with_noise_map(random_case(22, estimator, n=9), 1)
        case = replace(case, images=np.nan_to_num(case.images, nan=1.0))
        pipeline, expected = case.pipeline(), case.measure()
        frame = case.images.reshape(-1, case.images.shape[2])
        calibrated = pipeline.explain(frame).calibrated.reshape(frame.shape)
        measured = [pipeline.for_images()(calibrated, case.prior)]
        if estimator == "weighted":  # which compiles faster
            measured.append(pipeline.with_width(4)(frame, case.prior))
        for found in measured:
            for name in ("x", "y", "standard_error_x"):
                values = getattr(expected, name)
                np.testing.assert_allclose(getattr(found, name), values, rtol=1e-4, atol=1e-4, err_msg=name)

    def test_automatic_settings_follow_the_mean_variance(self) -> None:
        """Of the pixels of each sub-aperture."""
        case = random_case(23, "tv", n=4, window=(8, 8))
        settings = fs.Settings("tv", noise_std="auto", keep_brightest="auto", flux_e=200.0, spot_fwhm_px=2.0)
        levels = np.array([0.5, 1.0, 2.0, 4.0])
        noise = np.repeat(levels, 8)[:, None] * np.tile([1.0, 0.2], (32, 4))
        mapped = fs.Calibration(dark=0.0, read_noise_e=noise)
        table = replace(case, settings=settings, calibration=mapped).pipeline().plan.settings[0]
        for s, level in enumerate(levels * math.sqrt((1.0 + 0.04) / 2)):
            plain = fs.Calibration(dark=0.0, read_noise_e=level)
            own = replace(case, settings=settings, calibration=plain).pipeline().plan.settings[0]
            np.testing.assert_allclose(table[:, s], own[:, s], rtol=1e-6)

    @pytest.mark.slow
    def test_hostile_noise_maps_give_sane_slopes(self) -> None:
        """Noiseless, noisier than any camera, and all pixels but one bad."""
        for estimator in estimators():
            case = random_case(24, estimator, n=3, window=(6, 7))
            noise = np.full(case.images.shape, 1e6)
            noise[0], noise[2] = 0.0, np.nan
            noise[2, 3, 3] = 1.0
            mapped = replace(case.calibration, read_noise_e=noise.reshape(-1, 7))
            assert_sane(replace(case, calibration=mapped).measure())


class TestLocalBackground:
    """When a constant is fitted along with the spot."""

    @pytest.mark.parametrize("estimator", ["ml", "map"])
    def test_automatic_without_a_dark(self, estimator: str) -> None:
        case = random_case(12, estimator, n=5, window=(10, 10))
        case = replace(case, images=np.float32(2.0) + case.images)
        on = replace(case, settings=case.settings.replace(local_background="on"))
        off = replace(case, settings=case.settings.replace(local_background="off"))
        assert not np.array_equal(on.measure().x, off.measure().x)

        def with_dark(each: Case, **changes: Any) -> Case:
            return replace(each, calibration=replace(case.calibration, **changes))

        for each, changes in ((off, {"dark": 0.0}), (on, {"dark": None})):
            assert_same(with_dark(case, **changes).measure(), with_dark(each, dark=0.0).measure())
        rough = {"dark": 1.0, "estimated": ("dark",)}
        assert_same(with_dark(case, **rough).measure(), with_dark(on, dark=1.0).measure())

    def test_images_keep_what_is_known_of_the_dark(self) -> None:
        for dark, fitted in ((None, True), (3.0, False)):
            case = random_case(12, "ml", n=5)
            pipeline = replace(case, calibration=replace(case.calibration, dark=dark)).pipeline()
            assert pipeline.for_images().plan.prepared.fits_background is fitted  # type: ignore[attr-defined]

    def test_flux_that_is_measured_does_not_count_the_background(self) -> None:
        """40 spots give their mean flux to 5 %; a few per cent of it fall onto the edge."""
        psf, rng = one_psf(), np.random.default_rng(3)
        images = psf.images(rng.uniform(-1, 1, (40, 2)), (12, 12), 500.0) + rng.normal(
            20.0, 1.0, (40, 12, 12)
        )
        images[:, 0, 3] = np.nan
        settings = fs.Settings("map", search_range_px=3.0)
        case = Case(images.astype(np.float32), settings, fs.Calibration(read_noise_e=1.0), psf)
        pipeline = case.pipeline()
        flux = np.empty((1, 40), np.float32)
        frame = case.images.reshape(1, -1, 12)
        source = pipeline.source(frame, frame.dtype)

        def job(start: int, stop: int, scratch: Scratch) -> None:
            pipeline.plan.flux_kernel(source, start, stop, scratch, flux)

        run_groups(job, -(-40 // pipeline.width), source.lanes, (12, 12))
        assert flux.mean() == pytest.approx(500.0, rel=0.1)
        assert np.mean(np.abs(pipeline(frame[0]).flux - 500.0) < 100.0) > 0.95


class TestPhysics:
    """The standard errors are those of the slopes, in 4,000 images of known spots."""

    N = 4000

    def test_bound_with_an_unknown_background(self) -> None:
        """A spot as wide as the window: the constant costs what the Cramer-Rao bound says it costs."""
        psf = PSF.analytic("gaussian", size=1.8, radius_px=26)
        rng = np.random.default_rng(7)
        places = rng.uniform(-1, 1, (self.N, 2))
        images = fs.slopes.simulate.Detector(1.0).expose(psf.images(places, (8, 8), 2000.0).clip(0), rng)
        chosen = fs.Settings("ml", local_background="on", weight_floor=0.0)
        slopes = measure_images(
            images, chosen, calibration=fs.Calibration(dark=5.0, read_noise_e=1.0), psf=psf
        )
        rms = np.sqrt(np.mean((np.stack([slopes.x, slopes.y], axis=1) - places) ** 2))
        bound = cramer_rao(
            2000.0 * psf.images(np.zeros((1, 2)), (8, 8)).sum(),
            psf=psf,
            shape=(8, 8),
            detector=fs.slopes.simulate.Detector(1.0),
            position_range_px=1.0,
            unknown_background=True,
        )
        assert rms == pytest.approx(float(bound.mean()), rel=0.05)  # 1 % of it from the number of spots
        errors = np.sqrt(np.mean(slopes.standard_error_x**2))
        assert errors == pytest.approx(float(bound[0]), rel=0.05)

    @pytest.mark.parametrize("limited", [0, 1])
    def test_best_position_on_the_search_limit(self, limited: int) -> None:
        """An oblique spot beyond the limit on one axis; the other one and the flux are left to be fitted."""
        psf = PSF.analytic("gaussian", size=1.1, elongation=1.7, angle_deg=35.0, radius_px=26)
        place = np.array([0.3, 0.3])
        place[limited] = 2.0
        image = np.round(psf.images(place[None], (10, 10), 900.0)[0]).astype(np.float32)
        settings = fs.Settings("ml", steps=20, weight_floor=0.0, search_range_px=1.2)
        known: dict[str, Any] = {"calibration": fs.Calibration(dark=0.0, read_noise_e=1.0), "psf": psf}
        slopes = measure_images(image[None], settings, **known)
        found = np.array([slopes.x[0], slopes.y[0]])

        def improbability(values: Any) -> float:
            at = np.full(2, 1.2)
            at[1 - limited] = values[0]
            m = np.maximum(psf.images(at[None], (10, 10), 100.0 * values[1])[0], 0.0)
            return float(np.sum(m - (image + 1.0) * np.log(m + 1.0)))

        best = minimize(improbability, [0.1, 8.0], method="Nelder-Mead", options={"fatol": 1e-8}).x
        assert found[limited] == pytest.approx(1.2)
        assert abs(best[0] - place[1 - limited]) > 0.1  # the limit does matter to the other axis
        assert found[1 - limited] == pytest.approx(
            best[0], abs=5e-3
        )  # a tenth of its error: the PSF is tabulated
        assert slopes.flux[0] == pytest.approx(100 * best[1], rel=2e-3)


def test_unknown_read_noise_gives_infinite_errors() -> None:
    for estimator in ("brightest", "tv", "centroid", "thresholded", "smoothed", "weighted"):
        case: Case = random_case(14, estimator, n=6)
        calibration = replace(case.calibration, read_noise_e=None)
        slopes = replace(case, calibration=calibration).measure()
        assert slopes.valid.any()
        assert np.all(np.isposinf(slopes.standard_error_x))
        assert np.all(np.isposinf(slopes.standard_error_y))
