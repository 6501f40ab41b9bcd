"""Tests that every estimator must pass, for authors of estimators: inherit `EstimatorTests` in a test module.

::

    class TestMine(faintspot.testing.EstimatorTests):
        def make(self) -> Mine:
            return Mine()

Needs pytest.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.flags import UNMEASURED
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.base import Estimator, Need
from faintspot.slopes.estimators.registry import estimator_named
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import spots

SIDE = 16
N = 53
READ_NOISE_E = 1.0
FLUX_E = 2000.0
SPOT_FWHM_PX = 2.0


class EstimatorTests:
    """Tests of an estimator; override `make`, and other methods and attributes if the estimator needs it."""

    centre_tolerance_px = 2e-3
    """Largest error at the centre for a symmetric noise-free spot, due to float32 and tables."""
    error_ratio = (0.8, 1.25)
    """Allowed range of the stated over the actual standard error, for bright spots near the centre."""

    def make(self) -> Estimator:
        """Return the estimator with options that suit 16 x 16 px, spots of 2 px and 1 e- of read noise."""
        raise NotImplementedError

    # The sensor -------------------------------------------------------------------------------------

    def pipeline(self, n: int = N, **options: Any) -> SlopePipeline:
        """Return a pipeline of n sub-apertures in a column."""
        shared = {"spot_fwhm_px": SPOT_FWHM_PX, "flux_e": FLUX_E, **options.pop("shared", {})}
        return SlopePipeline(
            Layout.grid((n, 1), pixels=SIDE),
            Settings(self.make(), **shared),
            Calibration(dark=0.0, read_noise_e=READ_NOISE_E),
            psf=PSF.analytic("gaussian", size=SPOT_FWHM_PX / 2, radius_px=12),
            **options,
        )

    def frame(self, n: int = N, noise: bool = True, reach_px: float = 0.5, seed: int = 1) -> tuple[Any, Any]:
        """Return a frame of n spots and their positions (n, 2)."""
        rng = np.random.default_rng(seed)
        truth = rng.uniform(-reach_px, reach_px, (n, 2))
        flux = FLUX_E * spots(truth, shape=(SIDE, SIDE), profile="gaussian", size=SPOT_FWHM_PX / 2)
        images = rng.poisson(flux) + rng.normal(0.0, READ_NOISE_E, flux.shape) if noise else flux
        return images.reshape(n * SIDE, SIDE).astype(np.float32), truth

    # The tests --------------------------------------------------------------------------------------

    def test_is_known_by_its_name(self) -> None:
        assert estimator_named(self.make().name) is type(self.make())

    def test_is_finite_on_hostile_images(self) -> None:
        pipeline = self.pipeline()
        for frame in hostile_frames():
            slopes = pipeline(frame)
            for values in (slopes.x, slopes.y, slopes.flux):
                assert np.all(np.isfinite(values))
            assert not np.any(np.isnan(slopes.standard_error_x) | np.isnan(slopes.standard_error_y))
            assert np.all(np.isfinite(slopes.covariance_xy))
            assert np.all((slopes.flags & UNMEASURED == 0) | ((slopes.x == 0) & (slopes.y == 0)))

    def test_finds_the_centre_of_symmetric_spots(self) -> None:
        frame, _ = self.frame(noise=False, reach_px=0.0)
        slopes = self.pipeline()(frame)
        assert np.all(slopes.valid)
        assert np.abs(slopes.vector).max() < self.centre_tolerance_px

    def test_follows_the_spot(self) -> None:
        frame, truth = self.frame()
        slopes = self.pipeline()(frame)
        for axis, found in enumerate((slopes.x, slopes.y)):
            assert np.corrcoef(found, truth[:, axis])[0, 1] > 0.9

    def test_does_not_depend_on_grouping_threads_and_width(self) -> None:
        frame, _ = self.frame()
        whole = self.pipeline(threads=1)(frame)
        again = self.pipeline(threads=2)(np.stack([frame, frame, frame]))
        assert_same(whole, again, 1)
        alone = self.pipeline(7)(frame[: 7 * SIDE])
        np.testing.assert_array_equal(alone.x, whole.x[:7])
        narrow = self.pipeline(width=4)(frame)
        # Sums are rounded in a different order if a row is one vector.
        np.testing.assert_allclose(narrow.vector, whole.vector, atol=2e-4)

    def test_standard_errors_are_those_of_the_slopes(self) -> None:
        frame, truth = self.frame(800)
        slopes = self.pipeline(800)(frame)
        stated = np.concatenate([slopes.standard_error_x, slopes.standard_error_y])
        if not np.isfinite(stated).any():
            return  # it states no standard errors
        actual = slopes.vector - np.concatenate([truth[:, 0], truth[:, 1]])
        good = np.isfinite(stated) & (np.abs(actual) < 1.0)
        low, high = self.error_ratio
        # With 1600 errors, their scatter is known to 2 %; a centroid gain other than 1 adds to it.
        gain = np.polyfit(np.concatenate([truth[:, 0], truth[:, 1]])[good], slopes.vector[good], 1)[0]
        left = slopes.vector[good] - gain * np.concatenate([truth[:, 0], truth[:, 1]])[good]
        assert low < np.sqrt(np.mean(stated[good] ** 2)) / left.std() < high

    def test_comes_back_from_a_file(self, tmp_path: Path) -> None:
        settings = Settings(self.make(), search_range_px=3.0)
        path = tmp_path / "faintspot.toml"
        settings.save(path)
        assert Settings.load(path) == settings

    def test_says_what_it_does(self) -> None:
        estimator = self.make()
        assert estimator.label
        assert "\n" not in estimator.in_words(N, SIDE**2)
        assert estimator.in_words(N, SIDE**2)
        for declared in estimator.declared().values():
            assert declared.meaning.endswith(".")

    def test_what_is_tuned_fits_its_options(self) -> None:
        scene = Scene(FLUX_E, READ_NOISE_E, (SIDE, SIDE), SPOT_FWHM_PX, 1.0, d_over_r0=2.0)
        estimator = self.make().for_scene(scene)
        for name, values in estimator.tuned(scene).items():
            assert len(values) > 1
            for value in values:
                assert getattr(estimator.replaced({name: value}), name) == value

    def test_says_what_is_missing(self) -> None:
        layout, frame = Layout.grid((N, 1), pixels=SIDE), self.frame()[0]
        estimator = self.make()
        try:
            slopes = SlopePipeline(layout, Settings(estimator))(frame)
        except ValueError as error:
            assert estimator.required & set(Need), f"nothing is needed, but: {error}"
            assert "\n" not in str(error)
        else:
            assert not estimator.required
            assert np.all(np.isfinite(slopes.vector))


def hostile_frames() -> list[NDArray[np.float32]]:
    """Return frames of N windows with values that no camera should deliver."""
    rng = np.random.default_rng(2)
    shape = (N * SIDE, SIDE)
    noise = rng.normal(0.0, 10.0, shape)
    frames = [np.zeros(shape), np.full(shape, 1e25), np.full(shape, np.nan), -np.abs(noise), 1e30 * noise]
    holes = noise.copy()
    holes[rng.random(shape) < 0.1] = np.nan
    holes[rng.random(shape) < 0.05] = np.inf
    spike = np.zeros(shape)
    spike[::SIDE, 0] = 1e12
    return [frame.astype(np.float32) for frame in (*frames, holes, spike)]


def assert_same(one: Slopes, several: Slopes, frame: int) -> None:
    """Assert that the slopes of a frame measured among several equal those measured alone, bit for bit."""
    for name in ("x", "y", "flux", "flags", "standard_error_x", "standard_error_y", "covariance_xy"):
        np.testing.assert_array_equal(getattr(one, name), getattr(several, name)[frame], err_msg=name)
