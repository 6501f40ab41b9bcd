"""Every built-in estimator, and the example's own one, passes the tests that a plug-in can inherit."""

from __future__ import annotations

import functools
import importlib.util
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from tests.pipeline_cases import FIELDS
from tests.shared_data import ROOT

import faintspot as fs
from faintspot.base.statistics import absolute_errors
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.estimators import Estimator, estimators, registry
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.centroid import CentreOfGravity
from faintspot.slopes.estimators.built_in.matched import Matched
from faintspot.slopes.estimators.built_in.maximum_a_posteriori import MaximumAPosteriori
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumLikelihood
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.thresholded import Thresholded
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.estimators.built_in.trained import Trained
from faintspot.slopes.estimators.built_in.weighted import Weighted
from faintspot.slopes.estimators.built_in.window import Window
from faintspot.testing import FLUX_E, READ_NOISE_E, SIDE, EstimatorTests

EXAMPLE = ROOT / "examples" / "own_estimator.py"


@pytest.fixture(autouse=True, scope="module")
def only_here() -> Iterator[None]:
    """The example's estimator is known to the tests of this module alone."""
    yield
    registry._kinds.pop("power", None)
    sys.modules.pop("own_estimator", None)


class TestBrightest(EstimatorTests):
    def make(self) -> Estimator:
        return BrightestPixels(keep_brightest=20)


class TestTotalVariation(EstimatorTests):
    # Its iterations stop at a relative change of 1 %, where they have not yet made the image symmetric.
    centre_tolerance_px = 0.015
    # What the denoising does to the noise is not in its standard errors.
    error_ratio = (0.5, 2.0)

    def make(self) -> Estimator:
        return TotalVariation(noise_std=2.0, keep_brightest=20)

    @pytest.mark.parametrize("keep", [32, 255])
    def test_the_slope_has_converged(self, keep: int) -> None:
        """Where nearly all pixels are kept, 24 iterations leave 1.5 times the converged error: the shallow
        background converges last. Both errors are of the same images, so that 4 % are no matter of chance.
        """
        images, truth = fs.slopes.simulate.subapertures(
            500, flux_e=80.0, profile="gaussian", detector=Detector(0.1), rng=np.random.default_rng(5)
        )
        layout = fs.Layout.grid((1, 1), pixels=16)
        settings = fs.Settings(noise_std=0.17, keep_brightest=keep)
        errors = []
        for each in settings, settings.replace(tolerance=0.0, max_iterations=2000):
            slopes = fs.SlopePipeline(layout, each)(images)
            errors.append(float(absolute_errors(slopes.x[:, 0], slopes.y[:, 0], truth).mean()))
        assert errors[0] == pytest.approx(errors[1], rel=0.04)


class TestSmoothed(EstimatorTests):
    # Nor is what the smoothing does to it.
    error_ratio = (0.5, 2.0)

    def make(self) -> Estimator:
        return Smoothed(keep_brightest=20)


class TestCentroid(EstimatorTests):
    def make(self) -> Estimator:
        return CentreOfGravity()


class TestThresholded(EstimatorTests):
    def make(self) -> Estimator:
        return Thresholded(threshold_e=5.0)

    @pytest.mark.parametrize("side", [8, 12, 16])
    def test_is_the_same_at_every_width_bit_for_bit(self, side: int) -> None:
        """Real time measures what is left over from whole groups at a smaller width."""
        layout = fs.Layout.grid((4, 5), pixels=side)
        calibration = fs.Calibration(100.3, gain_e_per_adu=0.51, read_noise_e=1.0)
        frames = 100 + np.random.default_rng(side).poisson(6.0, (10, *layout.frame_shape)).astype(np.float32)
        wide = fs.SlopePipeline(layout, Thresholded(threshold_e=0.7), calibration)
        for width in (4, 8, 16):
            narrow = wide.with_width(width)(frames)
            for field in (*FIELDS, "standard_error_x", "standard_error_y", "covariance_xy"):
                np.testing.assert_array_equal(getattr(narrow, field), getattr(wide(frames), field))


class TestWindow(EstimatorTests):
    def make(self) -> Estimator:
        return Window(window_fwhm_px=4.0)


class TestWeighted(EstimatorTests):
    def make(self) -> Estimator:
        return Weighted()


class TestMatched(EstimatorTests):
    def make(self) -> Estimator:
        return Matched()


class TestMaximumLikelihood(EstimatorTests):
    def make(self) -> Estimator:
        return MaximumLikelihood()


class TestMaximumAPosteriori(EstimatorTests):
    def make(self) -> Estimator:
        return MaximumAPosteriori(prior_std_px=0.5)


@functools.cache
def trained_score() -> fs.TrainedScore:
    return fs.train_estimator(
        flux_e=FLUX_E,
        detector=fs.slopes.simulate.Detector(read_noise_e=READ_NOISE_E),
        shape=(SIDE, SIDE),
        profile="gaussian",
        realisations=2000,
        rng=np.random.default_rng(3),
    )


class TestTrained(EstimatorTests):
    # Learnt from noisy spots: the centre is found to its training's noise.
    centre_tolerance_px = 0.02

    def make(self) -> Estimator:
        return Trained()

    def score(self) -> fs.TrainedScore:
        return trained_score()


@functools.cache
def example_estimator() -> type[Estimator]:
    spec = importlib.util.spec_from_file_location("own_estimator", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up annotations
    spec.loader.exec_module(module)
    return module.PowerCentroid  # type: ignore[no-any-return]


class TestOwn(EstimatorTests):
    def make(self) -> Estimator:
        return example_estimator()()


def test_every_built_in_estimator_is_tested() -> None:
    tested = {kind().make().name for kind in EstimatorTests.__subclasses__()}
    assert estimators().keys() <= tested
