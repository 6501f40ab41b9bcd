import sys

import numpy as np
import pytest
from tests.loop.simulation.loop_cases import quiet

from faintspot.base.errors import MissingExtraError
from faintspot.loop.simulation.telescope.mirror import make_pupil

pytest.importorskip("hcipy")
WAVELENGTH_M = 1.65e-6


@pytest.fixture(scope="module")
def random_wavefront() -> np.ndarray:
    rng = np.random.default_rng(1)
    smooth = np.fft.ifft2(np.fft.fft2(rng.standard_normal((84, 84))) * np.exp(-np.arange(84) / 5)[:, None])
    return np.asarray(smooth.real / smooth.real.std() * 150, np.float32)


def test_the_pupil_is_an_annulus() -> None:
    pupil = make_pupil(quiet())
    area = float(pupil.amplitude.sum()) * pupil.spacing_m**2
    assert area == pytest.approx(np.pi / 4 * 4.2**2 * (1 - 0.29**2), rel=2e-3)  # points cut by the edge


def test_a_flat_wavefront_is_perfect() -> None:
    pupil = make_pupil(quiet())
    field = pupil.field(np.full((84, 84), 123.0, np.float32), WAVELENGTH_M)
    assert pupil.strehl(field) == pytest.approx(1, abs=1e-6)
    assert pupil.rms(np.full((84, 84), 123.0)) == pytest.approx(0, abs=1e-3)


def test_strehl_is_the_peak_of_a_fraunhofer_propagation(random_wavefront: np.ndarray) -> None:
    pupil = make_pupil(quiet())
    field = pupil.field(random_wavefront, WAVELENGTH_M)
    padded = np.abs(np.fft.fft2(field, (336, 336))) ** 2
    flat = np.abs(np.fft.fft2(pupil.amplitude, (336, 336))) ** 2
    assert pupil.strehl(field) == pytest.approx(padded[0, 0] / flat[0, 0], rel=1e-4)


def test_zernike_modes_of_known_ones() -> None:
    """Tilt along x and y, and focus (Noll), within 2 %: the radius is that of the outermost lit point."""
    pupil = make_pupil(quiet())
    x, y = np.meshgrid(*[(np.arange(84) - 41.5) * 0.05 / 2.1] * 2)
    wavefront = 30 * 2 * x + 10 * 2 * y + 20 * np.sqrt(3) * (2 * (x**2 + y**2) - 1)
    expected = np.zeros(10)
    expected[:3] = 30.0, 10.0, 20.0
    np.testing.assert_allclose(pupil.zernike(wavefront), expected, atol=0.6)


def test_the_strehl_ratio_is_marechals() -> None:
    pupil = make_pupil(quiet())
    rng = np.random.default_rng(2)
    wavefront = (50 * rng.standard_normal((84, 84))).astype(np.float32)
    variance = (2e-9 * np.pi / WAVELENGTH_M * pupil.rms(wavefront)) ** 2
    strehl = pupil.strehl(pupil.field(wavefront, WAVELENGTH_M))
    assert strehl == pytest.approx(np.exp(-variance), abs=1e-3)  # Gaussian phase: exact but for chance


def test_a_missing_hcipy_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "hcipy", None)
    with pytest.raises(MissingExtraError, match=r"faintspot\[loop\]"):
        make_pupil(quiet())
