"""Tip and tilt of a single sub-aperture: oscillators in place of winds."""

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.loop.control.driven import driven, oscillator
from tests.refusals import refused

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.learning import GAINS, learn_controller
from faintspot.loop.control.identification.loop_delay import DelayFits
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.integrator import LoopPlant
from faintspot.loop.control.reconstructor import make_reconstructor

_RATE_HZ, _FRAMES, _NOISE = 500.0, 8000, 0.5
_TURBULENCE, _VIBRATION, _BROAD = (
    oscillator(1.5, 0.5, 1.0),
    oscillator(20.0, 0.003, 0.3),
    oscillator(45.0, 0.3, 0.4),
)
_CELLS = np.zeros((1, 2), np.int64)
_SITE = Recording(np.zeros((1, 2)), None, None, _CELLS, _RATE_HZ).site


def _seen(seed: int) -> NDArray[np.float64]:
    """Return tip and tilt, (frames, 2)."""
    rng = np.random.default_rng(seed)
    moving = [driven(rng, _FRAMES, _RATE_HZ, 2, _TURBULENCE, _VIBRATION, _BROAD) for _ in range(2)]
    return np.array(moving).T + _NOISE * rng.standard_normal((_FRAMES, 2))


@pytest.mark.slow
def test_the_vibration_is_found_and_the_learnt_filter_beats_the_best_integrator() -> None:
    plant = LoopPlant(np.eye(2), make_reconstructor(np.eye(2)), 2, 0.01)
    learning, scoring = (
        OpenLoopTelemetry(slopes, np.full(slopes.shape, _NOISE**2), np.ones(slopes.shape))
        for slopes in map(_seen, (2, 3))
    )
    learnt = learn_controller(plant, learning, _SITE, _RATE_HZ)
    assert learnt.identified is not None
    assert learnt.identified.noise_factor == pytest.approx(1.0, rel=0.1)
    for mode in ("tip", "tilt"):
        of_mode = [each for each in learnt.identified.oscillators if each.mode == mode]
        narrow = min(of_mode, key=lambda each: each.damping)
        # Its phase is lost within 3 s, which makes 0.1 Hz in 16 s.
        assert narrow.frequency_hz == pytest.approx(20.0, abs=0.3)
        assert narrow.rms_px == pytest.approx(_VIBRATION.rms_px, rel=0.4)
    gain, plain = plant.best_gain(GAINS, scoring, np.eye(2))
    left = plant.residual(partial(learnt.controller, plant), scoring, np.eye(2))
    # Noise is 0.5 of either, whatever the control; of the rest, the filter leaves at most three quarters.
    assert left - 2 * _NOISE**2 < 0.75 * (plain - 2 * _NOISE**2), gain


def test_delay_is_not_told() -> None:
    run = np.zeros(_FRAMES, np.int64)
    with refused("3 sub-apertures"):
        DelayFits(_seen(4), np.zeros((_FRAMES, 2)), run, _SITE, _RATE_HZ)
