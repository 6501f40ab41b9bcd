import numpy as np
import pytest
from tests.loop.simulation.loop_cases import quiet

import faintspot as fs
from faintspot.base.errors import InputError
from faintspot.loop.simulation import load_loop
from faintspot.loop.simulation.telescope.atmosphere import make_atmosphere
from faintspot.loop.simulation.telescope.mirror import make_pupil
from faintspot.loop.simulation.telescope.wavefront_sensor import ShackHartmann, make_sensor

pytest.importorskip("hcipy")
FLAT = np.zeros((84, 84), np.float32)


@pytest.fixture(scope="module")
def sensor() -> ShackHartmann:
    return make_sensor(quiet(), make_pupil(quiet()))


def _tilt(sensor: ShackHartmann, x_px: float, y_px: float) -> np.ndarray:
    line = (np.arange(84) + 0.5) / 84 * 7
    return ((x_px * line + y_px * line[:, None]) / sensor.px_per_nm).astype(np.float32)


def test_36_sub_apertures_are_illuminated(sensor: ShackHartmann) -> None:
    assert len(sensor.layout) == 36
    assert sensor.illumination.min() > 0.5
    assert sensor.layout.frame_shape == (112, 112)


def test_flat_spots_are_the_lenslets_diffraction(sensor: ShackHartmann) -> None:
    """Two Gauss-Legendre samples a pixel: within 0.3 % of the brightest pixel."""
    expected = fs.slopes.simulate.spots(np.zeros((1, 2)), shape=(16, 16), profile="diffraction", size=1.0)[0]
    illuminated = np.flatnonzero(sensor.illumination > 0.9999)
    spot = sensor.spots(FLAT)[illuminated[0]]
    assert len(illuminated) > 4
    np.testing.assert_allclose(spot, expected, atol=3e-3 * expected.max())


def test_flux_is_that_of_the_illuminated_part(sensor: ShackHartmann) -> None:
    """About 95 % of the flux falls into the window; the rest is the wings, wider where partly lit."""
    np.testing.assert_allclose(sensor.spots(FLAT).sum(axis=(1, 2)), 0.95 * sensor.illumination, rtol=0.05)


def test_a_tilt_moves_the_spots(sensor: ShackHartmann) -> None:
    tilt = _tilt(sensor, 0.5, -0.25)
    np.testing.assert_allclose(sensor.mean_slopes_px(tilt), np.repeat([0.5, -0.25], 36), rtol=1e-4)
    both = _tilt(sensor, 0.5, 0.5)
    np.testing.assert_allclose(sensor.spots(FLAT, 0.5), sensor.spots(both), atol=2e-5)
    settings = fs.Settings(estimator="ml", search_range_px=3)
    pipeline = fs.SlopePipeline(
        sensor.layout, settings, fs.Calibration(dark=0.0, read_noise_e=1.0), psf=fs.PSF.analytic(), threads=1
    )
    slopes = pipeline(sensor.frame(sensor.spots(tilt)) * 1e5)
    illuminated = sensor.illumination > 0.9999
    np.testing.assert_allclose(slopes.x[illuminated], 0.5, atol=0.01)  # the PSF's own tables are good to that
    np.testing.assert_allclose(slopes.y[illuminated], -0.25, atol=0.01)


def test_noise_free_slopes_are_mean_gradients(sensor: ShackHartmann) -> None:
    """Centre of gravity of all the flux in the window, wavefronts of 160 nm rms.

    The window cuts the wings: a gain of 0.96; scatter about the line below 2 % of the slopes' rms.
    """
    atmosphere = make_atmosphere(quiet(), 1)
    settings = fs.Settings("brightest", keep_brightest=255)
    pipeline = fs.SlopePipeline(sensor.layout, settings, threads=1)
    truth, measured = [], []
    for time in np.arange(0, 5, 0.5):
        wavefront = 0.25 * atmosphere.wavefront_nm(time)
        truth.append(sensor.mean_slopes_px(wavefront))
        measured.append(pipeline(sensor.frame(sensor.spots(wavefront)) * 1e6).vector)
    true, seen = np.ravel(truth), np.ravel(measured)
    gain, offset = np.polyfit(true, seen, 1)
    assert gain == pytest.approx(0.96, abs=0.02)
    assert abs(offset) < 0.005
    assert np.std(seen - gain * true) < 0.02 * true.std()


def test_spots_are_as_long_as_asked() -> None:
    """Three times the 0.886 lambda / d of a lenslet, within 8 %: widths add in quadrature but roughly."""
    configuration = load_loop("elongated_3e")
    sensor = make_sensor(configuration, make_pupil(configuration))
    spot = sensor.spots(np.zeros((sensor.points,) * 2, np.float32))[np.argmax(sensor.illumination)]

    def width(profile: np.ndarray) -> float:
        fine = np.interp(np.arange(0, 15, 0.01), np.arange(16), profile)
        return float((fine > profile.max() / 2).sum() * 0.01)

    assert width(spot[7:9].sum(axis=0)) == pytest.approx(3 * 0.886 * 2, rel=0.08)
    assert width(spot[:, 7:9].sum(axis=1)) == pytest.approx(0.886 * 2, rel=0.25)  # pixels widen it
    np.testing.assert_allclose(spot, spot[::-1, ::-1], atol=1e-6)


def test_nothing_illuminated_is_refused() -> None:
    dark = quiet().replace("sensor", subapertures=1, samples=12, least_illumination=0.9)
    with pytest.raises(InputError, match=r"no sub-aperture has 0\.9 of its area in the pupil"):
        make_sensor(dark, make_pupil(dark))
