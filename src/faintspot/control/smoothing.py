"""What telemetry says of the slopes behind its noise: their second moments, given a model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov

from faintspot.control.kalman import SlopePredictor
from faintspot.control.models import SlopeModel
from faintspot.control.telemetry import OpenLoopTelemetry, usual_variance

Floats = NDArray[np.float64]


def smoothed_moments(model: SlopeModel, telemetry: OpenLoopTelemetry) -> Floats:
    """Return expected second moments (3 m, 3 m) of z[k + 1], z[k], z[k - 1], given all frames and a model.

    The model is of one layer.
    The expectation step of expectation maximisation (Shumway & Stoffer 1982, J. Time Series Anal. 3, 253),
    with the steady errors of the filter and of the Rauch-Tung-Striebel smoother.
    """
    variance = usual_variance(telemetry)
    filtered, predicted, ahead = _filtered(model, telemetry, variance)
    m = model.slopes
    onward = model.onward
    gain = np.linalg.solve(ahead[:m, :m] + np.diag(variance), ahead[:m]).T
    after = ahead - gain @ ahead[:m]
    back = np.linalg.solve(ahead + 1e-9 * np.trace(ahead) * np.eye(2 * m), onward @ after).T
    for frame in range(len(filtered) - 2, -1, -1):
        filtered[frame] += back @ (filtered[frame + 1] - predicted[frame + 1])
    error = solve_discrete_lyapunov(back, after - back @ ahead @ back.T)
    triple = np.hstack([filtered[1:, :m], filtered[:-1]])
    moments = triple.T @ triple / len(triple)
    moments[:m, :m] += error[:m, :m]
    moments[m:, m:] += error
    moments[:m, m:] += (error @ back.T)[:m]
    moments[m:, :m] += (error @ back.T)[:m].T
    return np.asarray(0.5 * (moments + moments.T))


def _filtered(
    model: SlopeModel, telemetry: OpenLoopTelemetry, variance: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return the state after each frame, the one predicted for it, (frames, 2 m), and its error."""
    predictor = SlopePredictor(model, variance)
    shape = len(telemetry), 2 * model.slopes
    after, before = np.zeros(shape), np.zeros(shape)
    for frame, slopes in enumerate(telemetry.open_loop_px):
        before[frame] = predictor.state
        predictor.correct(slopes, telemetry.variance_px2[frame])
        after[frame] = predictor.state
        predictor.advance()
    return after, before, predictor.covariance
