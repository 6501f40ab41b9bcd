"""Replays in one product or in compiled code are those of the controllers themselves."""

from functools import partial

import numpy as np
from tests.loop.control.control_cases import FRAME_S, LAYERS, PHASE, PLANT, TURBULENCE, telemetry

from faintspot.loop.control.base import ASSUMED, OpenLoopTelemetry
from faintspot.loop.control.identification.learning import learn_controller

FRAMES = telemetry(400, 0.5, model=LAYERS)


def partly_trusted() -> OpenLoopTelemetry:
    """Return frames of an estimator with a prior; a tenth of the slopes was not measured."""
    rng = np.random.default_rng(3)
    lost = rng.random(FRAMES.trust.shape) < 0.1
    variance = np.where(lost, np.inf, FRAMES.variance_px2)
    return OpenLoopTelemetry(FRAMES.open_loop_px, variance, np.where(lost, 0.0, 0.8))


def test_integrators_are_replayed_together() -> None:
    gains, frames = (0.1, 0.4, 1.9), telemetry(3000, 0.5)
    for seen in (partly_trusted(), frames):
        found = PLANT.replayed_integrators(gains, seen, PHASE)
        for gain, left in zip(gains, found, strict=True):
            np.testing.assert_allclose(left, PLANT.replayed(partial(PLANT.integrator, gain), seen, PHASE))
    assert np.isinf(found[-1]).all()  # its commands double every few frames until they are no numbers
    assert np.isfinite(found[:-1]).all()


def test_the_compiled_filter_is_replayed() -> None:
    """Four steps of conjugate gradients are within 1e-3 of the solution."""
    model = learn_controller(PLANT, FRAMES, TURBULENCE, 1 / FRAME_S, ASSUMED)
    seen = partly_trusted()
    expected = PLANT.replayed(partial(model.controller, PLANT), seen.scaled(model.noise_factor), PHASE)
    np.testing.assert_allclose(model.replayed(PLANT, seen, PHASE), expected, rtol=0.02, atol=1e-3)
