"""What an estimator lacks is said in one line; measured flux, configuration files and tables."""

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.estimators import spot_tables
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.simulate import sensor_frames

LAYOUT = fs.Layout.grid((3, 4), pixels=12)
NOISE = fs.Calibration(dark=0.0, read_noise_e=1.0)


def frames(n: int, flux_e: float, seed: int = 1) -> tuple[Any, Any]:
    return sensor_frames(
        LAYOUT, n, flux_e=flux_e, detector=fs.slopes.simulate.Detector(1.0), rng=np.random.default_rng(seed)
    )


def weights() -> fs.FixedWeights:
    return fs.FixedWeights(*np.random.default_rng(3).uniform(0.1, 1.0, (3, *LAYOUT.window)))


class TestWhatIsMissing:
    @pytest.mark.parametrize(
        ("settings", "parts", "message"),
        [
            (fs.Settings("ml"), {}, "psf: expected a PSF"),
            (fs.Settings("ml"), {"calibration": None, "psf": fs.PSF.analytic()}, "calibration.read_noise_e"),
            (fs.Settings("weighted"), {}, "settings.spot_fwhm_px"),
            (fs.Settings(noise_std="auto"), {}, "settings.spot_fwhm_px"),
            (fs.Settings("thresholded"), {}, "estimator.threshold_e"),
        ],
    )
    def test_what_an_estimator_lacks_is_named(
        self, settings: fs.Settings, parts: dict[str, Any], message: str
    ) -> None:
        with refused(message):
            fs.SlopePipeline(LAYOUT, settings, **{"calibration": NOISE, **parts})


class TestMeasuredFlux:
    def test_is_each_frames_own(self) -> None:
        """Frames measured together and one by one are the same, though their flux differs."""
        faint, bright = frames(2, 60.0)[0], frames(2, 900.0)[0]
        both = np.concatenate([faint, bright])
        settings = fs.Settings(noise_std="auto", keep_brightest="auto", spot_fwhm_px=1.9)
        pipeline = fs.SlopePipeline(LAYOUT, settings, NOISE)
        together = pipeline(both)
        for i, frame in enumerate(both):
            alone = fs.SlopePipeline(LAYOUT, settings, NOISE)(frame)
            assert np.array_equal(together.x[i], alone.x)
            assert np.array_equal(together.flags[i], alone.flags)

    def test_is_close_to_the_flux_given(self) -> None:
        """Of 12 spots of 400 e- the mean flux is known to 3 %, which moves no slope by more than 0.03 px."""
        frame, _ = frames(1, 400.0)
        psf = fs.PSF.analytic()
        measured = fs.SlopePipeline(LAYOUT, fs.Settings("map"), NOISE, psf=psf)(frame[0])
        given = fs.SlopePipeline(LAYOUT, fs.Settings("map", flux_e=400.0), NOISE, psf=psf)
        assert np.abs(measured.x - given(frame[0]).x).max() < 0.03

    @pytest.mark.parametrize("value", [0.0, -1e6, 1e30, np.nan, np.inf])
    def test_frames_without_sense_are_survived(self, value: float) -> None:
        frame = np.full(LAYOUT.frame_shape, value, np.float32)
        for settings in (
            fs.Settings(noise_std="auto", keep_brightest="auto", spot_fwhm_px=1.9),
            fs.Settings(estimator="map"),
        ):
            slopes = fs.SlopePipeline(LAYOUT, settings, NOISE, psf=fs.PSF.analytic())(frame)
            assert np.isfinite(slopes.vector).all()


class TestConfiguration:
    def test_psf_and_weights_come_back(self, tmp_path: Path) -> None:
        path = tmp_path / "faintspot.toml"
        psf = fs.PSF.analytic(elongation=2.0, angle_deg=30.0, radius_px=8.0)
        for item in (LAYOUT, fs.Settings(estimator="ml"), NOISE, psf, weights()):
            configuration.save(path, item)
        again = configuration.Configuration(path)
        assert again.psf is not None
        assert np.allclose(again.psf.samples, psf.samples)
        assert again.weights is not None
        assert np.array_equal(again.weights.x, weights().x)
        frame = frames(1, 300.0)[0][0]
        expected = fs.SlopePipeline(LAYOUT, fs.Settings(estimator="ml"), NOISE, psf=psf)(frame)
        assert np.array_equal(fs.SlopePipeline.from_file(path)(frame).x, expected.x)

    def test_analytic_psf_is_read_from_the_table(self, tmp_path: Path) -> None:
        path = tmp_path / "faintspot.toml"
        for item in (LAYOUT, fs.Settings(estimator="ml"), NOISE):
            configuration.save(path, item)
        with path.open("a") as file:
            file.write('\n[psf]\nprofile = "gaussian"\nsize = 1.2\n')
        psf = configuration.Configuration(path).psf
        assert psf is not None
        assert np.allclose(psf.samples, fs.PSF.analytic("gaussian", size=1.2).samples)

    @pytest.mark.parametrize(
        ("table", "message"),
        [
            ("[psf]\nfile = 3\n", "psf.file: expected the name of a file"),
            ('[psf]\nfile = "none.npz"\n', "none.npz: no such file"),
            ('[psf]\nprofile = "gaussian"\nsise = 1.0\n', "psf.sise: unknown key"),
            ('[psf]\nprofile = "moffat"\n', "expected one of 'diffraction', 'gaussian'"),
            ('[weights]\nfiel = "a.npz"\n', "weights.fiel: unknown key"),
        ],
    )
    def test_mistakes_in_the_table_are_refused(self, tmp_path: Path, table: str, message: str) -> None:
        path = tmp_path / "faintspot.toml"
        configuration.save(path, LAYOUT)
        configuration.save(path, fs.Settings("brightest"))
        with path.open("a") as file:
            file.write("\n" + table)
        with refused(message):
            _ = configuration.Configuration(path).spot


class TestTables:
    def test_taps_sum_to_one(self) -> None:
        taps = spot_tables.gaussian_taps(np.array([0.5, 1.3, 3.0]), (16, 16))
        assert np.allclose(taps[:, 0] + 2 * taps[:, 1:].sum(axis=1), 1.0, atol=1e-6)

    def test_gain_of_gaussian_spots(self) -> None:
        """A Gaussian weight sees 1 / (1 + (spot / weight)^2) of a displacement of a Gaussian spot.

        The pixel widens the spot; sampled at whole pixels this holds to 1 %.
        """
        psf = fs.PSF.analytic("gaussian", size=2.0)
        spot = float(psf.fwhm_px[0, 0])
        weight = np.array([3.0, 5.0])
        both = np.repeat(weight[:, None], 2, axis=1)
        known = spot_tables.model_of_weights(both, np.full((2, 2), spot), psf, (16, 16), 16)
        assert np.allclose(known.gain[:, 0], 1.0 + (spot / weight) ** 2, rtol=0.01)

    def test_least_flux_grows_with_noise_and_range(self) -> None:
        psf = fs.PSF.analytic()
        by_noise = [spot_tables.least_flux(psf, 0, noise**2, 1.0, 1.0, 16) for noise in (0.1, 1.0, 3.0, 16.0)]
        assert all(a < b for a, b in itertools.pairwise(by_noise))
        by_range = [spot_tables.least_flux(psf, 0, 9.0, 1.0, reach, 16) for reach in (1.0, 2.0, 8.0)]
        assert all(a < b for a, b in itertools.pairwise(by_range))

    def test_posterior_of_known_flux_integrates_the_likelihood(self) -> None:
        """The table gives the log-likelihood ratio of Poisson pixels of variance v + m."""
        psf, v, flux = fs.PSF.analytic(), 0.5, 40.0
        grid, _ = spot_tables.posterior_grid(1.0, 1.9, (8, 8))
        logarithms, constants = spot_tables.posterior_tables(
            psf, np.array([0]), np.array([flux]), np.array([v]), 1.0, grid, (8, 8), 16
        )
        image = np.random.default_rng(2).poisson(psf.images([[0.2, -0.4]], (8, 8), flux)[0])
        mean = np.maximum(psf.images(grid, (8, 8), flux), 0.0)
        expected = ((image + v) * np.log((mean + v) / v) - mean).sum(axis=(1, 2))
        found = (logarithms[0, :, :, :8] * image).sum(axis=(1, 2)) + constants[0]
        assert np.allclose(found, expected, rtol=1e-5, atol=1e-4)
