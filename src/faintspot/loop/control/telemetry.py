"""Telemetry from which a controller learns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import Controller
from faintspot.loop.control.noise import LARGEST_CORRELATION

Floats = NDArray[np.float64]

LEAST_SHARE = 0.02  # of the prior's information, that a slope is taken to add at least

LEAST_VARIANCE_PX2 = 1e-8  # of slopes that are known without an error


@dataclass(frozen=True, eq=False)
class OpenLoopTelemetry:
    """Open-loop slopes of consecutive frames, with their noise and the estimator's weight on them."""

    open_loop_px: Floats
    """(frames, m): open-loop slopes; any finite value where not measured."""
    variance_px2: Floats
    """(frames, m): variance of their noise; infinite: not measured."""
    trust: Floats
    """(frames, m): part of a deviation from what was expected that the estimator gives: 1, of estimators with
    a prior less, where not measured 0."""
    covariance_xy_px2: Floats | None = None
    """(frames, m / 2): covariance of the noise of x and y, 0 where not measured; None: independent."""

    def __len__(self) -> int:
        return len(self.open_loop_px)

    def part(self, start: int, stop: int | None) -> OpenLoopTelemetry:
        """Return a selection of frames."""
        arrays = {name: array for name, array in vars(self).items() if array is not None}
        return OpenLoopTelemetry(**{name: array[start:stop] for name, array in arrays.items()})

    @property
    def covariances_px2(self) -> Floats:
        """(frames, m / 2): covariance of the noise of x and y; 0 where they are independent."""
        if self.covariance_xy_px2 is None:
            return np.zeros((len(self), self.open_loop_px.shape[1] // 2))
        return self.covariance_xy_px2

    def scaled(self, noise_factor: float) -> OpenLoopTelemetry:
        """Return the same telemetry with the noise scaled."""
        covariance = self.covariance_xy_px2
        return OpenLoopTelemetry(
            self.open_loop_px,
            self.variance_px2 * noise_factor,
            self.trust,
            None if covariance is None else covariance * noise_factor,
        )


def without_prior(
    slopes_px: Floats, standard_error_px: Floats, expected_px: Floats, prior_std_px: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """Return slopes without the estimator's prior, their variances, and `Telemetry.trust`.

    A posterior's mean and variance s hold the prior of variance v, too; fed back to the filter that the
    prior came from, it would count twice. The frame alone has the variance 1 / (1 / s - 1 / v), at most
    v / 0.02 so that a posterior as wide as the prior stays harmless, and its slope is as much farther from
    the prior's mean as the prior has drawn it there (all Gaussian).
    """
    variance = np.maximum(np.square(standard_error_px), LEAST_VARIANCE_PX2)
    measured = np.isfinite(variance)
    if prior_std_px is None:
        return slopes_px, variance, measured.astype(np.float64)
    prior = np.square(prior_std_px)
    # Information of the frame in units of the prior's.
    share = np.maximum(prior / variance - 1, LEAST_SHARE)
    trust = np.where(measured, share / (1 + share), 0.0)
    alone = expected_px + (slopes_px - expected_px) * (1 + share) / share
    return alone, np.where(measured, prior / share, np.inf), trust


def usual_noise(telemetry: OpenLoopTelemetry) -> tuple[Floats, Floats]:
    """Return the noise that gives as much information as the frames do on average.

    Returns
    -------
    variance_px2, covariance_xy_px2 : (m,), (m / 2,) array
    """
    variance, covariance = telemetry.variance_px2, telemetry.covariances_px2
    x, y = np.split(variance, 2, axis=1)
    measured = np.isfinite(x) & np.isfinite(y)
    root = np.sqrt(np.where(measured, x, 1.0) * np.where(measured, y, 1.0))
    rho = np.where(measured, np.clip(covariance / root, -LARGEST_CORRELATION, LARGEST_CORRELATION), 0.0)
    rest = 1 - np.square(rho)
    information = np.where(np.isfinite(variance), 1 / (variance * np.tile(rest, (1, 2))), 0.0).mean(axis=0)
    of_x, of_y = np.split(np.maximum(information, 1e-6), 2)
    shared = (rho / (root * rest)).mean(axis=0)
    determinant = of_x * of_y - np.square(shared)
    return np.concatenate([of_y / determinant, of_x / determinant]), shared / determinant


def as_estimated(slopes_px: Floats, trust: Floats, controller: Controller) -> Floats:
    """Return the slopes that an estimator with a prior would have given a controller."""
    if controller.undoes_prior:
        return slopes_px
    expected = controller.expected().mean_px
    return np.asarray(expected + trust * (slopes_px - expected))
