"""Delay, gain and law of loops without geometry."""

import numpy as np
import pytest
from scipy.signal import lfilter
from tests.loop.control.modal_cases import integrated, wandering
from tests.patience import mostly_slow

from faintspot.loop.control.identification.modal_delay import (
    FILTERED,
    INTEGRATOR,
    OTHER,
    ModalFits,
    law_of,
)

FRAMES = 4000
RUN = np.zeros(FRAMES, np.int64)


@pytest.mark.parametrize(
    ("delay", "loop_gain"),
    mostly_slow(1, [(1.5, 0.4), (1.0, 0.6), (2.0, 0.2), (2.0, 0.6), (3.0, 0.2), (3.0, 0.4)]),
)
def test_delay_of_tip_and_tilt_is_measured(delay: float, loop_gain: float) -> None:
    """Within 0.2 frames and 3 errors, with a vibration; the gain within 3 errors."""
    rng = np.random.default_rng([int(2 * delay), int(10 * loop_gain)])
    slopes, commands = integrated(wandering(rng, FRAMES), rng, delay=delay, loop_gain=loop_gain)
    found = ModalFits(slopes, commands, RUN).best()
    assert found.delay_frames == pytest.approx(delay, abs=min(0.2, 3 * found.delay_error))
    assert found.gain == pytest.approx(0.8, abs=3 * found.gain_error)


def test_gain_of_a_known_delay() -> None:
    rng = np.random.default_rng(4)
    slopes, commands = integrated(wandering(rng, FRAMES), rng, gain=0.5, loop_gain=0.6)
    found = ModalFits(slopes, commands, RUN).of(2.0)
    assert (found.delay_frames, found.delay_error) == (2.0, 0.0)
    assert found.gain == pytest.approx(0.5, rel=0.2)


@pytest.mark.slow
def test_gain_of_a_bright_sensor_that_sees_fine_turbulence() -> None:
    """Structure too fine for the mirror, in the slopes alone, up to 50 Hz."""
    rng = np.random.default_rng(12)
    fine = lfilter([1.0], np.poly([0.5] * 4), rng.standard_normal((FRAMES, 8)), axis=0)
    seen = wandering(rng, FRAMES, 8) + 0.05 * fine / fine.std()
    slopes, commands = integrated(seen, rng, gain=0.5, loop_gain=1.2, noise=0.001)
    assert ModalFits(slopes, commands, RUN).of(2.0).gain == pytest.approx(0.5, rel=0.25)


def test_a_gain_with_which_the_recorded_loop_was_not_stable_is_none() -> None:
    """The stable limit of a delay of 2 frames is 1; the spectra alone say 1.09, as the loop grows slowly."""
    rng = np.random.default_rng(13)
    slopes, commands = integrated(wandering(rng, 400), rng, gain=0.8, loop_gain=1.3)
    found = ModalFits(slopes, commands, RUN[:400]).of(2.0)
    assert 0.8 < 1.3 * found.gain < 1.0


def test_the_law_is_named() -> None:
    rng = np.random.default_rng(5)
    open_loop = wandering(rng, FRAMES)
    plain, filtered = (integrated(open_loop, rng, filtered=part) for part in (0.0, 0.4))
    assert law_of(*plain, RUN) == f"{INTEGRATOR} of gain 0.4"
    assert law_of(*filtered, RUN) == FILTERED
    assert law_of(plain[0], rng.standard_normal(plain[1].shape), RUN) == OTHER
