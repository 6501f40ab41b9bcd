"""Learning a model of open-loop slopes from short, noisy telemetry, with the help of theory.

What telemetry says of the slopes behind its noise depends on the model that they are smoothed with: theory's
at first (expectation maximisation). A ridge regression of z[k + 1] on z[k], z[k - 1] draws the model back to
theory, in the metric of theory's own covariances: its normal equations are those of a weighted mean of
measured and theoretical moments. Which theory, and how much weight the measured moments get, is decided by
what the control would have left of the turbulence in frames that it has not learnt from. A theory that knows
layers is tried with each of them by itself, too; telemetry cannot tell them apart.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Self

import numpy as np
from numpy.typing import NDArray

from faintspot.control.models import SlopeModel, joint_moments
from faintspot.control.smoothing import smoothed_moments
from faintspot.control.telemetry import OpenLoopTelemetry, lagged_covariance

Floats = NDArray[np.float64]
Score = Callable[[SlopeModel, OpenLoopTelemetry], float]

MEASURED_SHARES = (0.1, 0.25, 0.5, 0.75)
_NOISE_FACTORS = (0.1, 30.0)


@dataclass(frozen=True, eq=False)
class Strengths:
    """How strong turbulence and noise are in telemetry."""

    later_px2: Floats
    """(2, m, m): covariances of slopes one and two frames apart, which have no noise."""
    noise_factor: float
    """Actual variance of the noise as a multiple of what the standard errors say."""

    @classmethod
    def of(cls, telemetry: OpenLoopTelemetry) -> Self:
        """Measure them: noise is what the variance has beyond its extrapolation from later lags."""
        later = np.array([lagged_covariance(telemetry, lag) for lag in (1, 2)])
        finite = np.where(np.isfinite(telemetry.variance_px2), telemetry.variance_px2, 0.0)
        squares = np.square(telemetry.trust)
        noise = (squares * finite).sum(axis=0) / np.maximum(squares.sum(axis=0), 1e-12)
        beyond = np.trace(lagged_covariance(telemetry, 0)) - np.trace(_extrapolated(later))
        factor = float(np.clip(beyond / max(noise.sum(), 1e-12), *_NOISE_FACTORS))
        return cls(later, factor)

    def relative_to(self, theory_px2: Floats) -> float:
        """Return by what to multiply theoretical covariances (3, m, m): by slopes without tip and tilt."""
        theory = _without_tilt(_extrapolated(theory_px2[1:]))
        return max(_without_tilt(_extrapolated(self.later_px2)), 0.01 * theory) / theory


@dataclass(frozen=True, eq=False)
class Identified:
    """What was learnt."""

    model: SlopeModel
    noise_factor: float
    """What to multiply the variances of standard errors by."""
    source: str
    """What it was learnt from: which theory, and how much telemetry counts."""
    score: float
    """Mean square of what control by it leaves, in frames that were not learnt from."""


def identify(
    telemetry: OpenLoopTelemetry,
    theories_px2: Mapping[str, Floats],
    score: Score,
    shares: Sequence[float] = MEASURED_SHARES,
) -> Identified:
    """Choose a model: of each half of the frames, the other half is scored.

    Parameters
    ----------
    telemetry : Telemetry
    theories_px2 : mapping of (layers, 3, m, m) arrays
        Theoretical covariances for lags of 0, 1 and 2 frames, by name; only the ratio of the layers'
        strengths is used.
    score : callable
        Mean square of what control by a model leaves in some frames.
    shares : sequence of float
        Weights of measured moments that are tried beside none.
    """
    middle = len(telemetry) // 2
    parts = telemetry.part(0, middle), telemetry.part(middle, len(telemetry)), telemetry
    strengths = [Strengths.of(part) for part in parts]
    together = {name: theory.sum(axis=0) for name, theory in theories_px2.items()}
    makers: dict[str, Callable[[int], SlopeModel]] = {}
    tried: dict[str, float] = {}

    def of_theory(name: str, layers: Floats, part: int) -> SlopeModel:
        return SlopeModel.of_covariances(strengths[part].relative_to(together[name]) * layers)

    @cache
    def moments(name: str, part: int) -> tuple[Floats, Floats]:
        return _moments(parts[part], strengths[part], together[name])

    def measured(name: str, share: float, part: int) -> SlopeModel:
        return SlopeModel.of_moments(mixed(*moments(name, part), share))

    def attempt(source: str, make: Callable[[int], SlopeModel]) -> None:
        makers[source] = make
        left = [score(make(of), parts[1 - of].scaled(strengths[of].noise_factor)) for of in (0, 1)]
        tried[source] = float(np.mean(left))

    for name, theory in together.items():
        attempt(name, partial(of_theory, name, theory))
    nearest = min(tried, key=tried.__getitem__)
    for share in shares:
        attempt(f"{nearest}, measured moments {share:g}", partial(measured, nearest, share))
    for name, layers in theories_px2.items():
        if len(layers) > 1:
            source = f"{name}, {len(layers)} layers"
            makers[source] = partial(of_theory, name, layers)
            # Two numbers are learnt from all frames, which are scored at once: its filter takes long to make.
            tried[source] = score(makers[source](2), telemetry.scaled(strengths[2].noise_factor))
    best = min(tried, key=tried.__getitem__)
    return Identified(makers[best](2), strengths[2].noise_factor, best, tried[best])


def mixed(measured_px2: Floats, theory_px2: Floats, share: float) -> Floats:
    """Return a weighted mean of moments."""
    return share * measured_px2 + (1 - share) * theory_px2


def _moments(telemetry: OpenLoopTelemetry, strengths: Strengths, theory_px2: Floats) -> tuple[Floats, Floats]:
    """Return the moments (3 m, 3 m) of telemetry, smoothed with a theory, and of the theory."""
    theory = strengths.relative_to(theory_px2) * theory_px2
    model = SlopeModel.of_covariances(theory)
    return smoothed_moments(model, telemetry.scaled(strengths.noise_factor)), joint_moments(theory)


def _extrapolated(later: Floats) -> Floats:
    """Return the covariance of no lag, without noise, from those of one and two frames."""
    mean = (4 * later[0] - later[1]) / 3
    return np.asarray(0.5 * (mean + mean.T))


def _without_tilt(covariance: Floats) -> float:
    """Return the sum of variances about each axis's mean over the sub-apertures."""
    n = len(covariance) // 2
    total = np.trace(covariance)
    for axis in (slice(0, n), slice(n, 2 * n)):
        total -= covariance[axis, axis].mean() * n
    return float(total)
