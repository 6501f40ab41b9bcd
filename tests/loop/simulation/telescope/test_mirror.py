import numpy as np
import pytest
from tests.loop.simulation.best_fit import BestFit
from tests.loop.simulation.loop_cases import quiet

from faintspot.loop.simulation.telescope.atmosphere import make_atmosphere
from faintspot.loop.simulation.telescope.mirror import make_mirror, make_pupil

pytest.importorskip("hcipy")


def test_commands_add_up() -> None:
    pupil = make_pupil(quiet())
    mirror = make_mirror(quiet(), pupil)
    assert mirror.commands == 52 + 2
    rng = np.random.default_rng(1)
    command = rng.normal(0, 100, mirror.commands)
    expected = (mirror.matrix() @ command).reshape(84, 84)
    np.testing.assert_allclose(mirror.wavefront_nm(command), expected, atol=0.01)


def test_an_actuator_rises_to_its_command_and_its_neighbour_to_the_crosstalk() -> None:
    mirror = make_mirror(quiet(), make_pupil(quiet()))
    poke = np.zeros(mirror.commands)
    poke[30] = 100.0
    surface = mirror.wavefront_nm(poke)
    assert surface.max() == pytest.approx(100, rel=0.01)  # points lie beside the actuator
    row, column = np.unravel_index(surface.argmax(), surface.shape)
    beside = column + 12 if column < 60 else column - 12
    assert surface[row, beside] == pytest.approx(15, rel=0.2)


def test_tip_and_tilt_have_a_unit_rms() -> None:
    pupil = make_pupil(quiet())
    mirror = make_mirror(quiet(), pupil)
    command = np.zeros(mirror.commands)
    command[-1] = 50.0
    assert pupil.rms(mirror.wavefront_nm(command)) == pytest.approx(50, rel=1e-4)
    assert make_mirror(quiet().replace("mirror", tip_tilt=False), pupil).commands == 52


def test_fitting_error_is_that_of_theory() -> None:
    """0.28 (pitch / r0)^(5/3) rad^2 is the usual number for a continuous mirror (Hudgin 1977, JOSA 67, 393).

    Gaussian influence functions do somewhat better; 0.19 to 0.30 is accepted. The Strehl ratio is then that
    of Marechal's exp(-variance) within 0.01.
    """
    pupil = make_pupil(quiet())
    fit = BestFit.of(make_mirror(quiet(), pupil), pupil)
    atmosphere = make_atmosphere(quiet(), 2)
    residuals = [fit.residual(atmosphere.wavefront_nm(time)) for time in np.arange(0, 10, 0.5)]
    variance = float(np.mean([pupil.rms(left) ** 2 for left in residuals]))
    coefficient = variance * (2 * np.pi / 500) ** 2 / (0.6 / 0.15) ** (5 / 3)
    assert 0.19 < coefficient < 0.30
    strehl = np.mean([pupil.strehl(pupil.field(left, 1.65e-6)) for left in residuals])
    assert strehl == pytest.approx(np.exp(-variance * (2 * np.pi / 1650) ** 2), abs=0.01)


def test_the_best_fit_takes_off_what_the_mirror_can_do() -> None:
    pupil = make_pupil(quiet())
    mirror = make_mirror(quiet(), pupil)
    command = np.random.default_rng(3).normal(0, 100, mirror.commands)
    left = BestFit.of(mirror, pupil).residual(mirror.wavefront_nm(command) + 77)
    assert pupil.rms(left) < 0.1
