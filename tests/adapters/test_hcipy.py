import warnings
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot import Settings
from faintspot.base.flags import INVALID

pytestmark = pytest.mark.slow  # the import of HCIPy, in every process

hcipy: Any
SlopeEstimator: Any

SIDE, LENSLETS, WIDTH_M, WAVELENGTH_M, F_NUMBER = 12, 7, 4.2e-3, 0.7e-6, 150.0
PIXEL_M = WIDTH_M / (LENSLETS * SIDE)
EVERYTHING = Settings("brightest", keep_brightest=SIDE * SIDE, rule="threshold")  # as HCIPy's own
FAINT = Settings(noise_std=1.0, keep_brightest=20)


@pytest.fixture(scope="module", autouse=True)
def imported() -> None:
    """Import HCIPy when the first test runs, not where tests are listed."""
    global hcipy, SlopeEstimator
    hcipy = pytest.importorskip("hcipy", reason="hcipy is not installed (extra loop)")
    from faintspot.adapters.hcipy import SlopeEstimator


def sensor(pixels: int = LENSLETS * SIDE, shift_px: float = 0.0) -> Any:
    """Return the optics, with every lenslet moved by part of a pixel."""
    grid = hcipy.make_pupil_grid(pixels, WIDTH_M)
    pitch = WIDTH_M / LENSLETS
    x = np.arange(-3, 4) * pitch + shift_px * WIDTH_M / pixels
    lenslets = hcipy.CartesianGrid(hcipy.SeparatedCoords((x, x)))
    array = hcipy.MicroLensArray(grid, lenslets, F_NUMBER * pitch)
    return hcipy.ShackHartmannWavefrontSensorOptics(grid, array)


def image_through(optics: Any, aberration: tuple[float, ...] = (2.0, -1.5, 1.0, 0.8)) -> Any:
    """Return the image of 1e6 photons after some low modes, radian."""
    grid = optics.mla_index.grid
    modes = hcipy.make_zernike_basis(len(aberration), WIDTH_M, grid, starting_mode=2, radial_cutoff=False)
    phase = sum(value * mode for value, mode in zip(aberration, modes, strict=True))
    wavefront = hcipy.Wavefront(hcipy.Field(np.exp(1j * phase), grid), WAVELENGTH_M)
    wavefront.total_power = 1e6
    return optics.forward(wavefront).power


def theirs(optics: Any, image: Any, mask: Any) -> Any:
    """Return HCIPy's own slopes."""
    estimator = hcipy.ShackHartmannWavefrontSensorEstimator(optics.mla_grid, optics.mla_index, mask)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # scipy.ndimage.measurements
        return estimator.estimate([image])


def inner(optics: Any) -> Any:
    """Say which lenslets are not at the edge, where a moved array leaves the detector."""
    return optics.mla_grid.as_("polar").r < 1.9e-3


@pytest.fixture(scope="module")
def optics() -> Any:
    return sensor()


def test_noise_free_slopes_are_hcipys_own() -> None:
    # The same pixels are summed: float32 pixels against float64 leave 1e-6 px.
    moved = sensor(shift_px=0.3)
    image, mask = image_through(moved), inner(moved)
    expected = theirs(moved, image, mask)
    slopes = SlopeEstimator(moved.mla_grid, moved.mla_index, mask, settings=EVERYTHING).estimate([image])
    assert isinstance(slopes, hcipy.Field)
    assert slopes.shape == expected.shape
    assert slopes.grid == expected.grid
    assert np.ptp(expected) > 0.5 * PIXEL_M  # something to measure
    np.testing.assert_allclose(np.asarray(slopes), np.asarray(expected), rtol=0, atol=1e-5 * PIXEL_M)


def test_lenslets_that_are_not_a_whole_number_of_pixels_wide() -> None:
    # 81 pixels for 7 lenslets: 11.57 each, so that HCIPy sums 11 or 12 pixels a side; the windows have 11.
    # The row between, 6 px from the centre, has up to 1 % of the flux: 0.06 px. A window's middle instead of
    # the lenslet's centre would be off by up to 0.5 px.
    odd, settings = sensor(pixels=81), EVERYTHING.replace(keep_brightest=121)
    image, mask = image_through(odd), inner(odd)
    estimator = SlopeEstimator(odd.mla_grid, odd.mla_index, mask, settings=settings)
    layout = estimator.measured.pipeline.layout
    assert layout.window == (11, 11)
    assert np.ptp(layout.offsets) > 0.8
    slopes = np.asarray(estimator.estimate([image]))
    assert np.abs(slopes - np.asarray(theirs(odd, image, mask))).max() < 0.1 * WIDTH_M / 81
    windows = layout.images(image.shaped)
    for axis, centre in enumerate(estimator.estimation_grid.coords):
        metres = layout.images(np.reshape(image.grid.coords[axis], (81, 81))) - centre[:, None, None]
        expected = (windows * metres).sum(axis=(1, 2)) / windows.sum(axis=(1, 2))
        np.testing.assert_allclose(slopes[axis], expected, rtol=0, atol=1e-5 * PIXEL_M)


def test_fits_into_hcipys_sensor_and_takes_what_it_takes(optics: Any) -> None:
    first = SlopeEstimator(optics.mla_grid, optics.mla_index, settings=FAINT)
    assert isinstance(first, hcipy.WavefrontSensorEstimator)
    np.testing.assert_array_equal(first.estimation_subapertures, np.arange(49))
    mask = optics.mla_grid.zeros(dtype=bool)
    mask[first.estimation_subapertures[::3]] = True
    chosen = SlopeEstimator(optics.mla_grid, optics.mla_index, mask, settings=FAINT)
    np.testing.assert_array_equal(chosen.estimation_subapertures, np.arange(49)[::3])
    image = image_through(optics)
    np.testing.assert_array_equal(chosen.estimate([image]), np.asarray(first.estimate([image]))[:, ::3])
    from hcipy.wavefront_sensing.wavefront_sensor import WavefrontSensor

    whole = WavefrontSensor(wfs_estimator=chosen, detector=hcipy.NoiselessDetector(image.grid))
    whole.detector.integrate(image, 1)
    np.testing.assert_array_equal(whole.read_out(), chosen.estimate([image]))
    other = hcipy.Field(np.asarray(image), hcipy.make_pupil_grid(84, 1.0))
    for images, message in (
        (image, "list of one image"),
        ([], "list of one image"),
        ([image[:-1]], "list of one image"),
        ([other], "another grid"),
    ):
        with refused(message):
            first.estimate(images)


def test_lenslets_beside_the_detector_are_left_out() -> None:
    grid = hcipy.make_pupil_grid(84, WIDTH_M)
    optics = hcipy.SquareShackHartmannWavefrontSensorOptics
    square = optics(grid, F_NUMBER, LENSLETS, WIDTH_M)  # to twice the pupil
    estimator = SlopeEstimator(square.mla_grid, square.mla_index, settings=FAINT)
    own = hcipy.ShackHartmannWavefrontSensorEstimator(square.mla_grid, square.mla_index)
    np.testing.assert_array_equal(estimator.estimation_subapertures, own.estimation_subapertures)
    assert estimator.estimation_grid.size == 49


def test_a_detector_with_other_pixels(optics: Any) -> None:
    grid = hcipy.make_pupil_grid(42, WIDTH_M)
    detector = hcipy.NoisyDetector(grid, include_photon_noise=False, subsampling=2)
    detector.integrate(image_through(optics), 1)
    image = detector.read_out()
    settings = Settings("brightest", keep_brightest=36, rule="threshold")
    estimator = SlopeEstimator(optics.mla_grid, optics.mla_index, settings=settings, detector_grid=grid)
    coarse = hcipy.MicroLensArray(grid, optics.mla_grid, 1.0)
    expected = theirs(coarse, image, np.ones(49, bool))
    np.testing.assert_allclose(
        np.asarray(estimator.estimate([image])), np.asarray(expected), rtol=0, atol=1e-4 * PIXEL_M
    )


def test_last_estimate_says_how_good_it_is(optics: Any) -> None:
    calibration = fs.Calibration(read_noise_e=1.0)
    estimator = SlopeEstimator(optics.mla_grid, optics.mla_index, settings=FAINT, calibration=calibration)
    with refused("slopes: no"):
        _ = estimator.measured.last.flags
    image = image_through(optics) / 100
    image[optics.mla_index == 3] = 0.0
    slopes = np.asarray(estimator.estimate([image]))
    assert estimator.measured.last.flags[3] & fs.SubapertureFlag.NO_FLUX
    assert not estimator.measured.last.flags[4] & INVALID
    np.testing.assert_array_equal(slopes[:, 3], 0.0)
    recorded = np.where(np.arange(49) == 3, np.nan, slopes)
    np.testing.assert_allclose(estimator.recorded().reshape(2, 49)[:, 3:5], recorded[:, 3:5], rtol=1e-6)
    np.testing.assert_allclose(estimator.measured.last.x, slopes[0] / PIXEL_M, rtol=1e-6, atol=1e-7)
    errors = np.asarray(estimator.standard_errors)
    assert errors.shape == slopes.shape
    assert np.isinf(errors[:, 3]).all()
    assert ((errors[:, 4] > 0) & (errors[:, 4] < PIXEL_M)).all()
    last = estimator.measured.last
    np.testing.assert_allclose(errors, PIXEL_M * np.stack([last.standard_error_x, last.standard_error_y]))


def test_axes_that_run_backwards(optics: Any) -> None:
    grid = optics.mla_index.grid
    image = image_through(optics)
    backwards = hcipy.CartesianGrid(hcipy.RegularCoords(-grid.delta, grid.dims, -grid.zero))
    estimator = SlopeEstimator(optics.mla_grid, optics.mla_index, settings=FAINT, detector_grid=backwards)
    forwards = SlopeEstimator(optics.mla_grid, optics.mla_index, settings=FAINT)
    # Float sums in another order, and a denoising that stops at a relative change of 1 %.
    turned = hcipy.Field(np.asarray(image)[::-1].copy(), backwards)
    np.testing.assert_allclose(
        np.asarray(estimator.estimate([turned])), np.asarray(forwards.estimate([image])), atol=0.02 * PIXEL_M
    )


def test_refused_in_one_line(optics: Any) -> None:
    for change, names in (
        ({"detector_grid": "polar"}, ("Cartesian",)),
        ({"mla_index": np.zeros(84 * 84)}, ("detector_grid",)),
        ({"mla_grid": "far"}, ("detector",)),
        ({"mla_grid": "dense"}, ("px",)),
        ({"estimation_subapertures": np.ones(7, bool)}, ("49",)),
        ({"pixels": 14}, ()),
    ):
        grid, mla = optics.mla_index.grid, optics.mla_grid
        grids = {"polar": grid.as_("polar"), "far": mla.shifted((1.0, 0.0)), "dense": mla.scaled(0.1)}
        arguments = {"mla_grid": mla, "mla_index": optics.mla_index, "settings": FAINT}
        arguments |= {
            name: grids[value] if isinstance(value, str) else value for name, value in change.items()
        }
        with refused(*names):
            SlopeEstimator(**arguments)


def test_calibration_and_prediction(optics: Any) -> None:
    asked: list[Any] = []
    settings = Settings("window", flux_e=30.0, spot_fwhm_px=2.0)
    estimator = SlopeEstimator(optics.mla_grid, optics.mla_index, settings=settings, predict=asked.append)
    image = image_through(optics)
    with estimator.calibrating():
        bright, faint = (np.asarray(estimator.estimate([image * scale])) for scale in (1.0, 1e-5))
    # The image is brought to the same flux first: rounding to float32 is what is left.
    np.testing.assert_allclose(bright, faint, atol=1e-5 * PIXEL_M)
    assert not asked
    first = estimator.estimate([image])
    estimator.estimate([image])
    assert len(asked) == 1
    assert asked[0] is first
    # 20,000 e- over a mean flux of 30: what calibrating is for.
    assert np.abs(np.asarray(first)).max() > 10 * np.abs(bright).max()


def test_predictions_are_in_metres_on_the_detector(optics: Any) -> None:
    """5 electrons say little, a prior of 0.02 px a lot."""
    predicted_m = np.random.default_rng(4).uniform(-0.5, 0.5, (2, 49)) * PIXEL_M
    settings = Settings("map", flux_e=5.0, prior_std_px=0.02)
    estimator = SlopeEstimator(
        *(optics.mla_grid, optics.mla_index),
        settings=settings,
        calibration=fs.Calibration(read_noise_e=1.0),
        psf=fs.PSF.analytic("gaussian", size=1.0),
        predict=lambda slopes: predicted_m,
    )
    image = image_through(optics, (0.0,)) * (5.0 * 49 / 1e6)
    estimator.estimate([image])
    slopes = np.asarray(estimator.estimate([image]))
    np.testing.assert_allclose(slopes, predicted_m, rtol=0, atol=0.02 * PIXEL_M)
