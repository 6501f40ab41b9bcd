"""Every built-in estimator, and the example's own one, passes the tests that a plug-in can inherit."""

import functools
import importlib.util
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from tests.pipeline_cases import FIELDS
from tests.shared_data import ROOT

import faintspot as fs
from faintspot.base.statistics import absolute_errors
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.estimators import Estimator, estimators, registry
from faintspot.slopes.spots.shapes import spots
from faintspot.testing import EstimatorTests

EXAMPLE = ROOT / "examples" / "own_estimator.py"


@pytest.fixture(autouse=True, scope="module")
def only_here() -> Iterator[None]:
    """The example's estimator is known to the tests of this module alone."""
    yield
    registry._kinds.pop("power", None)
    sys.modules.pop("own_estimator", None)


@functools.cache
def example_estimator() -> type[Estimator]:
    spec = importlib.util.spec_from_file_location("own_estimator", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look up annotations
    spec.loader.exec_module(module)
    return module.PowerCentroid  # type: ignore[no-any-return]


OPTIONS: dict[str, dict[str, Any]] = {
    "brightest": {"keep_brightest": 20},
    "tv": {"noise_std": 2.0, "keep_brightest": 20},
    "smoothed": {"keep_brightest": 20},
    "thresholded": {"threshold_e": 5.0},
    "window": {"window_fwhm_px": 4.0},
    "map": {"prior_std_px": 0.5},
}
# The iterations of "tv" stop at a relative change of 1 %, where they have not yet made the image symmetric.
CENTRE_TOLERANCE_PX = {"tv": 0.015}
ONE_OF_EACH_FAMILY = ("tv", "window", "map", "power")


class TestEveryEstimator(EstimatorTests):
    @pytest.fixture(autouse=True, params=[*estimators(), "power"])
    def _choose(self, request: pytest.FixtureRequest) -> None:
        self.kind = request.param
        self.centre_tolerance_px = CENTRE_TOLERANCE_PX.get(self.kind, EstimatorTests.centre_tolerance_px)

    def make(self) -> Estimator:
        kind = example_estimator() if self.kind == "power" else estimators()[self.kind]
        return kind(**OPTIONS.get(self.kind, {}))

    @pytest.mark.slow
    def test_does_not_depend_on_grouping_threads_and_width(self) -> None:
        if self.kind not in ONE_OF_EACH_FAMILY:
            pytest.skip("compiled anew at another SIMD width, as another one of its family is")
        super().test_does_not_depend_on_grouping_threads_and_width()


@pytest.mark.parametrize("name", ["brightest", "tv", "smoothed", "centroid", "thresholded"])
@pytest.mark.parametrize(("flux_e", "noise_e"), [(40.0, 0.1), (100.0, 1.0), (40.0, 3.0), (1000.0, 16.0)])
def test_standard_errors_are_the_scatter_or_none(name: str, flux_e: float, noise_e: float) -> None:
    """Of 20 positions, 30 images each: the scatter is known to 2 %, errors are within 15 %, of TV 20 %."""
    rng = np.random.default_rng(7)
    spot = flux_e * spots(rng.uniform(-0.5, 0.5, (20, 2)), shape=(16, 16), profile="gaussian", size=1.0)
    images = rng.poisson(np.repeat(spot, 30, axis=0)) + rng.normal(0.0, noise_e, (600, 16, 16))
    options = {"tv": {"noise_std": noise_e}, "thresholded": {"threshold_e": 3 * noise_e}}.get(name, {})
    slopes = fs.measure_images(
        images, fs.Settings(name, **options), calibration=fs.Calibration(read_noise_e=noise_e)
    )
    known = slopes.valid & np.isfinite(slopes.standard_error_x)
    if known.mean() < 0.8:  # lost in the noise: most have none
        assert noise_e >= 1
        return
    x = np.where(known, slopes.x, np.nan).reshape(20, 30)
    scatter = np.sqrt(np.nanmean(np.nanvar(x, axis=1, ddof=1)))
    stated = np.sqrt(np.mean(np.square(slopes.standard_error_x[known], dtype=np.float64)))
    assert stated == pytest.approx(scatter, rel=0.2 if name == "tv" else 0.15)


@pytest.mark.parametrize("window", [(5, 17), (17, 5)])
def test_a_spot_far_along_a_narrow_window_is_where_it_is(window: tuple[int, int]) -> None:
    """Farther from the middle than the window is wide, on either side."""
    along = [(6.0, 0.3), (-6.0, 0.3)] if window[1] > window[0] else [(0.3, 6.0), (0.3, -6.0)]
    layout = fs.Layout.grid((1, 2), pixels=window)
    frame = np.hstack([*spots(along, shape=window, flux_e=1e4, profile="gaussian")])
    slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=20))(frame)
    assert slopes.valid.all()
    np.testing.assert_allclose(np.stack([slopes.x, slopes.y], axis=1), along, atol=0.02)


@pytest.mark.slow  # compiled anew at other SIMD widths
@pytest.mark.parametrize("side", [8, 12, 16])
def test_a_threshold_gives_the_same_at_every_width_bit_for_bit(side: int) -> None:
    """Real time measures what is left over from whole groups at a smaller width."""
    layout = fs.Layout.grid((4, 5), pixels=side)
    calibration = fs.Calibration(100.3, gain_e_per_adu=0.51, read_noise_e=1.0)
    frames = 100 + np.random.default_rng(side).poisson(6.0, (10, *layout.frame_shape)).astype(np.float32)
    wide = fs.SlopePipeline(layout, fs.Settings("thresholded", threshold_e=0.7), calibration)
    for width in filter(wide.width.__ge__, (4, 8, 16)):
        narrow = wide.with_width(width)(frames)
        for field in (*FIELDS, "standard_error_x", "standard_error_y", "covariance_xy"):
            np.testing.assert_array_equal(getattr(narrow, field), getattr(wide(frames), field))


@pytest.mark.slow
def test_the_slope_of_a_denoised_image_has_converged() -> None:
    """Where nearly all pixels are kept, 24 iterations leave 1.5 times the converged error: the shallow
    background converges last. Both errors are of the same images, so that 4 % are no matter of chance.
    """
    images, truth = fs.slopes.simulate.subapertures(
        500, flux_e=80.0, profile="gaussian", detector=Detector(0.1), rng=np.random.default_rng(5)
    )
    layout = fs.Layout.grid((1, 1), pixels=16)
    settings = fs.Settings(noise_std=0.17, keep_brightest=255)
    errors = []
    for each in settings, settings.replace(tolerance=0.0, max_iterations=2000):
        slopes = fs.SlopePipeline(layout, each)(images)
        errors.append(float(absolute_errors(slopes.x[:, 0], slopes.y[:, 0], truth).mean()))
    assert errors[0] == pytest.approx(errors[1], rel=0.04)
