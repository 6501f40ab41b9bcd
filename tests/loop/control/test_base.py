from functools import partial

import numpy as np
import pytest
from tests.loop.control.control_cases import FRAME_S, LAYERS, PHASE, PLANT, TURBULENCE, telemetry

from faintspot.loop.control.base import (
    ASSUMED,
    CommandDelayLine,
    OpenLoopTelemetry,
    usual_noise,
    without_prior,
)
from faintspot.loop.control.identification.learning import learn_controller


def test_a_prior_is_taken_out_again() -> None:
    """A Gaussian posterior gives back the frame's own slope and variance."""
    rng = np.random.default_rng(1)
    mean, slope = rng.standard_normal((2, 50))
    prior, noise = rng.uniform(0.2, 1.0, (2, 50))
    variance = 1 / (1 / prior**2 + 1 / noise**2)
    posterior = variance * (mean / prior**2 + slope / noise**2)
    alone, found, trust = without_prior(posterior, np.sqrt(variance), mean, prior)
    informed = noise**2 < 50 * prior**2  # less is taken for that
    np.testing.assert_allclose(alone[informed], slope[informed], rtol=1e-6)
    np.testing.assert_allclose(found[informed], noise[informed] ** 2, rtol=1e-6)
    np.testing.assert_allclose((mean + trust * (alone - mean))[informed], posterior[informed], rtol=1e-6)


def test_posteriors_wider_than_the_prior_stay_harmless() -> None:
    _, variance, trust = without_prior(np.ones(3), np.array([2.0, 1.0, np.inf]), np.zeros(3), np.ones(3))
    np.testing.assert_allclose(variance, [50.0, 50.0, np.inf])
    np.testing.assert_allclose(trust, [1 / 51, 1 / 51, 0.0])


def test_usual_noise_gives_the_mean_information() -> None:
    """Of one sub-aperture, against whole matrices; without y in one frame, and nothing in another."""
    rng = np.random.default_rng(1)
    roots = rng.standard_normal((20, 2, 2))
    noise = roots @ roots.swapaxes(1, 2) + np.eye(2)
    information = np.linalg.inv(noise)
    variance, covariance = np.diagonal(noise, axis1=1, axis2=2).copy(), noise[:, 0, 1].copy()
    variance[3, 1], variance[7], covariance[[3, 7]] = np.inf, np.inf, 0.0
    information[3], information[7] = np.diag([1 / variance[3, 0], 0.0]), 0.0
    zeros = np.zeros_like(variance)
    found, shared = usual_noise(OpenLoopTelemetry(zeros, variance, zeros, covariance[:, None]))
    usual = np.linalg.inv(information.mean(axis=0))
    np.testing.assert_allclose(found, np.diag(usual))
    np.testing.assert_allclose(shared, usual[0, 1])


def test_a_command_acts_after_the_delay() -> None:
    for delay in (1, 2, 5):
        line, acted = CommandDelayLine(1, delay), []
        for frame in range(1, 12):
            acted.append(float(line.acting[0]))
            command = np.array([float(frame)])
            line.put(command)
            command[:] = -7.0  # the caller's array
            assert line.latest[0] == frame
        assert acted == [0.0] * delay + list(range(1, 12 - delay))


def test_no_command_is_beyond_the_stroke() -> None:
    """One that is not finite is not sent: it does not say in which direction the mirror should go."""
    line = CommandDelayLine(3, 2, 10.0)
    line.put(np.array([5.0, 20.0, -1e30]))
    np.testing.assert_array_equal(line.latest, [5.0, 10.0, -10.0])
    for wrong in (np.nan, np.inf, -np.inf):
        with pytest.raises(ArithmeticError):
            line.put(np.array([wrong, 3.0, 1.0]))
        np.testing.assert_array_equal(line.latest, [5.0, 10.0, -10.0])
        assert not line.acting.any()
    line.hold(np.array([0.0, 99.0, -99.0]))
    np.testing.assert_array_equal(line.acting, [0.0, 10.0, -10.0])
    np.testing.assert_array_equal(line.latest, line.acting)


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
