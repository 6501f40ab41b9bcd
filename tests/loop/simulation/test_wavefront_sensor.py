import sys

import numpy as np
import pytest
from tests.loop.simulation.best_fit import BestFit
from tests.loop.simulation.loop_cases import quiet
from tests.refusals import refused
from tests.shared_data import skip_without

import faintspot as fs
from faintspot.base.errors import MissingExtraError
from faintspot.loop.simulation import load_loop
from faintspot.loop.simulation.atmosphere import make_atmosphere
from faintspot.loop.simulation.wavefront_sensor import (
    DeformableMirror,
    PupilAmplitude,
    ShackHartmann,
    make_mirror,
    make_pupil,
    make_sensor,
)

skip_without("hcipy")
FLAT = np.zeros((84, 84), np.float32)


@pytest.fixture(scope="module")
def pupil() -> PupilAmplitude:
    return make_pupil(quiet())


@pytest.fixture(scope="module")
def mirror(pupil: PupilAmplitude) -> DeformableMirror:
    return make_mirror(quiet(), pupil)


@pytest.fixture(scope="module")
def sensor(pupil: PupilAmplitude) -> ShackHartmann:
    return make_sensor(quiet(), pupil)


def _tilt(sensor: ShackHartmann, x_px: float, y_px: float) -> np.ndarray:
    line = (np.arange(84) + 0.5) / 84 * 7
    return ((x_px * line + y_px * line[:, None]) / sensor.px_per_nm).astype(np.float32)


def test_36_sub_apertures_are_illuminated(sensor: ShackHartmann) -> None:
    """About 95 % of the flux falls into the window; the rest is the wings, wider where partly lit."""
    assert len(sensor.layout) == 36
    assert sensor.illumination.min() > 0.5
    assert sensor.layout.frame_shape == (112, 112)
    np.testing.assert_allclose(sensor.spots(FLAT).sum(axis=(1, 2)), 0.95 * sensor.illumination, rtol=0.05)
    dark = quiet().replace("sensor", subapertures=1, samples=12, least_illumination=0.9)
    with refused("0.9"):
        make_sensor(dark, make_pupil(dark))


def test_flat_spots_are_the_lenslets_diffraction(sensor: ShackHartmann) -> None:
    """Two Gauss-Legendre samples a pixel: within 0.3 % of the brightest pixel."""
    expected = fs.slopes.simulate.spots(np.zeros((1, 2)), shape=(16, 16), profile="diffraction", size=1.0)[0]
    illuminated = np.flatnonzero(sensor.illumination > 0.9999)
    spot = sensor.spots(FLAT)[illuminated[0]]
    assert len(illuminated) > 4
    np.testing.assert_allclose(spot, expected, atol=3e-3 * expected.max())


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


def test_commands_add_up(pupil: PupilAmplitude, mirror: DeformableMirror) -> None:
    """An actuator rises to its command and its neighbour to the crosstalk; tip and tilt have a unit rms."""
    assert mirror.commands == 52 + 2
    assert make_mirror(quiet().replace("mirror", tip_tilt=False), pupil).commands == 52
    command, (poke, tilt) = np.random.default_rng(1).normal(0, 100, mirror.commands), np.zeros((2, 54))
    expected = (mirror.matrix() @ command).reshape(84, 84)
    np.testing.assert_allclose(mirror.wavefront_nm(command), expected, atol=0.01)
    poke[30], tilt[-1] = 100.0, 50.0
    surface = mirror.wavefront_nm(poke)
    assert surface.max() == pytest.approx(100, rel=0.01)  # points lie beside the actuator
    row, column = np.unravel_index(surface.argmax(), surface.shape)
    beside = column + 12 if column < 60 else column - 12
    assert surface[row, beside] == pytest.approx(15, rel=0.2)
    assert pupil.rms(mirror.wavefront_nm(tilt)) == pytest.approx(50, rel=1e-4)
    left = BestFit.of(mirror, pupil).residual(mirror.wavefront_nm(command) + 77)  # takes off all of it
    assert pupil.rms(left) < 0.1


@pytest.mark.slow
def test_fitting_error_is_that_of_theory(pupil: PupilAmplitude, mirror: DeformableMirror) -> None:
    """0.28 (pitch / r0)^(5/3) rad^2 is the usual number for a continuous mirror (Hudgin 1977, JOSA 67, 393).

    Gaussian influence functions do somewhat better; 0.19 to 0.30 is accepted. The Strehl ratio is then that
    of Marechal's exp(-variance) within 0.01.
    """
    fit = BestFit.of(mirror, pupil)
    atmosphere = make_atmosphere(quiet(), 2)
    residuals = [fit.residual(atmosphere.wavefront_nm(time)) for time in np.arange(0, 10, 0.5)]
    variance = float(np.mean([pupil.rms(left) ** 2 for left in residuals]))
    coefficient = variance * (2 * np.pi / 500) ** 2 / (0.6 / 0.15) ** (5 / 3)
    assert 0.19 < coefficient < 0.30
    strehl = np.mean([pupil.strehl(pupil.field(left, 1.65e-6)) for left in residuals])
    assert strehl == pytest.approx(np.exp(-variance * (2 * np.pi / 1650) ** 2), abs=0.01)


WAVELENGTH_M = 1.65e-6


def test_strehl_is_the_peak_of_a_fraunhofer_propagation(pupil: PupilAmplitude) -> None:
    """Of Gaussian phase it is Marechal's but for chance; points are cut by the edge of the annulus."""
    area = float(pupil.amplitude.sum()) * pupil.spacing_m**2
    assert area == pytest.approx(np.pi / 4 * 4.2**2 * (1 - 0.29**2), rel=2e-3)
    white = np.random.default_rng(2).standard_normal((84, 84))
    smooth = np.fft.ifft2(np.fft.fft2(white) * np.exp(-np.arange(84) / 5)[:, None]).real
    for wavefront, marechal in ((150 * smooth / smooth.std(), 1.0), (50 * white, 1e-3), (FLAT + 123, 1e-6)):
        field = pupil.field(wavefront.astype(np.float32), WAVELENGTH_M)
        padded = np.abs(np.fft.fft2(field, (336, 336))) ** 2
        flat = np.abs(np.fft.fft2(pupil.amplitude, (336, 336))) ** 2
        assert pupil.strehl(field) == pytest.approx(padded[0, 0] / flat[0, 0], rel=1e-4)
        variance = (2e-9 * np.pi / WAVELENGTH_M * pupil.rms(wavefront)) ** 2
        assert pupil.strehl(field) == pytest.approx(np.exp(-variance), abs=marechal)


def test_a_missing_hcipy_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hcipy", None)
    with pytest.raises(MissingExtraError, match=r"faintspot\[loop\]"):
        make_pupil(quiet())
