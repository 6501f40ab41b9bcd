"""Frames of another simulator, by other authors, whose wavefront tells where every spot is."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import faintspot as fs

makewfs = pytest.importorskip("makewfs")

LENSLETS, WINDOW, SAMPLES = 6, 12, 16
DIAMETER_M, WAVELENGTH_M, PX_PER_DIFFRACTION = 4.2, 0.7e-6, 2.0
GAIN, OFFSET_ADU, READ_NOISE_E, PHOTONS = 0.5, 100, 2.0, 1e5
CONFIGURATION = f"""
schema_version = 1
input = {{ shape = [{LENSLETS * SAMPLES}, {LENSLETS * SAMPLES}], grid_extent_m = {DIAMETER_M} }}
telescope = {{ pupil_diameter_m = {DIAMETER_M} }}
source = {{ detector_photon_rate_per_s = {PHOTONS} }}
sensor = {{ wavelength_m = {WAVELENGTH_M} }}
[shack_hartmann]
lenslets_across_pupil = {LENSLETS}
pixels_per_subaperture = {WINDOW}
spot_sampling_pixels_per_lambda_over_d = {PX_PER_DIFFRACTION}
minimum_illuminated_fraction = 0.99
[detector]
exposure_s = 1.0
[detector.camera]
name = "camera"
sensor_type = "CCD"
resolution = [{LENSLETS * WINDOW}, {LENSLETS * WINDOW}]
pixel_size_um = 10.0
quantum_efficiency = 1.0
full_well_e = 30000
bit_depth = 16
gain_e_per_adu = {GAIN}
bias_offset_adu = {OFFSET_ADU}
read_noise_e = {READ_NOISE_E}
dark_current_e_per_s = 0.0
"""
FRAMES = 40
OPTIONS: dict[str, dict[str, float]] = {"tv": {"noise_std": READ_NOISE_E, "keep_brightest": 20}}
Observed = tuple[fs.Layout, NDArray[np.uint16], NDArray[np.float64]]


def centres(count: int) -> NDArray[np.float64]:
    """Return the centres of so many equal parts of the pupil, as fractions of its radius."""
    return (np.arange(count) + 0.5 - count / 2) * 2 / count


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Observed:
    """Return the fully lit sub-apertures, frames, and true slopes (2 n,) of tilt, focus and astigmatism."""
    path: Path = tmp_path_factory.mktemp("makewfs") / "sensor.toml"
    path.write_text(CONFIGURATION)
    sensor = makewfs.WavefrontSensor.from_toml(path)
    x, y = np.meshgrid(*2 * [centres(LENSLETS * SAMPLES)])
    wavefront = 0.7 * x - 0.4 * y + 0.45 * x**2 - 0.3 * y**2 + 0.3 * x * y
    radius_m, side_m = DIAMETER_M / 2, DIAMETER_M / LENSLETS
    per_px = WAVELENGTH_M / side_m / PX_PER_DIFFRACTION  # angle
    frames = [sensor.expose(radius_m * per_px * wavefront, seed=seed).data for seed in range(FRAMES)]
    valid = np.asarray(sensor.valid_subapertures())
    x, y = (grid[valid] for grid in np.meshgrid(*2 * [centres(LENSLETS)]))
    layout = fs.Layout.grid((LENSLETS, LENSLETS), pixels=WINDOW)[valid.ravel()]
    return layout, np.asarray(frames, np.uint16), np.r_[0.7 + 0.9 * x + 0.3 * y, -0.4 - 0.6 * y + 0.3 * x]


def measured(layout: fs.Layout, frames: NDArray[np.uint16], estimator: str, **options: float) -> fs.Slopes:
    """Return slopes measured with what the simulated sensor is known to be."""
    calibration = fs.Calibration(OFFSET_ADU, gain_e_per_adu=GAIN, read_noise_e=READ_NOISE_E)
    psf = fs.PSF.analytic("diffraction", size=PX_PER_DIFFRACTION / 2)
    return fs.SlopePipeline(layout, fs.Settings(estimator, **options), calibration, psf=psf)(frames)


@pytest.mark.parametrize(("estimator", "error_px"), [("tv", 0.01), ("ml", 0.01), ("window", 0.04)])
def test_slopes_are_those_of_the_wavefront(observed: Observed, estimator: str, error_px: float) -> None:
    """To the noise of a mean (5 sigma), and 0.01 px, to which pixels and the wings that windows cut off
    leave spots symmetric; a fixed window, whose response bends, errs by 3 % of displacements of 1.4 px."""
    layout, frames, true_px = observed
    slopes = measured(layout, frames, estimator, **OPTIONS.get(estimator, {}))
    assert np.abs(true_px).max() > 1.0
    assert slopes.valid.all()
    scatter_px = slopes.vector.std(axis=0)
    error = np.abs(slopes.vector.mean(axis=0) - true_px)
    assert (error < error_px + 5 * scatter_px / FRAMES**0.5).all()
    # Errors of single slopes hold to 30 %, in the rms over all sub-apertures.
    stated_px = np.hstack([slopes.standard_error_x, slopes.standard_error_y])
    assert 0.77 < np.sqrt(np.mean(scatter_px**2) / np.mean(stated_px**2)) < 1.3


def test_flux_is_that_of_the_lenslets(observed: Observed) -> None:
    """A fit of the whole spot counts its wings, too: 2 % are left for those beyond the PSF."""
    layout, frames, _ = observed
    slopes = measured(layout, frames, "ml")
    of_a_lenslet = PHOTONS / (np.pi / 4 * LENSLETS**2)
    np.testing.assert_allclose(slopes.flux.mean(axis=0), of_a_lenslet, rtol=0.02)
