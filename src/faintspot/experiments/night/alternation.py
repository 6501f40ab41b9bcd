"""Regression on observations that alternate while the seeing drifts.

Deviations from the regression have white noise and a drift whose correlation falls exponentially with time;
both are found by restricted maximum likelihood (Patterson & Thompson 1971, Biometrika 58, 545). Errors are
those of leaving out one cycle at a time, which assumes nothing of the scatter of single methods.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.statistics import FEWEST_PIECES, Estimate, student

_SHARES = (0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.995)  # of the variance that drifts
_TIMES = 8  # trial correlation times


@dataclass(frozen=True)
class Drift:
    """Share of the variance that drifts, and the time in which its correlation falls to 1 / e."""

    share: float
    time_s: float

    def correlation(self, time_s: Floats) -> Floats:
        """Return the correlation between observations, (n, n)."""
        apart_s = np.abs(time_s[:, None] - time_s)
        return self.share * np.exp(-apart_s / self.time_s) + (1 - self.share) * np.eye(len(time_s))


def likeliest_drift(design: Floats, values: Floats, time_s: Floats) -> Drift:
    """Return the drift under which the residuals of a regression are likeliest.

    Parameters
    ----------
    design : (n, p) array
    values, time_s : (n,) array
    """
    span_s = float(np.ptp(time_s))
    if len(values) <= design.shape[1] + 1 or span_s == 0:
        return Drift(0.0, 1.0)
    shortest_s = max(float(np.median(np.diff(np.sort(time_s)))), 1e-3 * span_s)
    times = np.geomspace(shortest_s, max(span_s, 2 * shortest_s), _TIMES)
    trials = [Drift(0.0, 1.0), *(Drift(share, float(each)) for share in _SHARES[1:] for each in times)]
    return max(trials, key=lambda drift: _likelihood(design, values, drift.correlation(time_s)))


def _likelihood(design: Floats, values: Floats, correlation: Floats) -> float:
    """Return the logarithm of the restricted likelihood, apart from a constant."""
    factor = scipy.linalg.cho_factor(correlation, lower=True)
    weighted = scipy.linalg.cho_solve(factor, design)
    information = design.T @ weighted
    residual = values - design @ (np.linalg.pinv(information) @ (weighted.T @ values))
    square = float(residual @ scipy.linalg.cho_solve(factor, residual))
    free = len(values) - np.linalg.matrix_rank(design)
    if square <= 0 or free <= 0:
        return -math.inf
    sizes = np.linalg.eigvalsh(information)
    of_design = np.log(sizes[sizes > 1e-12 * sizes[-1]]).sum()
    of_values = 2 * np.log(np.diag(factor[0])).sum()
    return float(-0.5 * (free * math.log(square / free) + of_values + of_design))


def coefficients(design: Floats, values: Floats, correlation: Floats) -> Floats:
    """Return the coefficients of a generalised least-squares fit, (p,)."""
    weighted = scipy.linalg.cho_solve(scipy.linalg.cho_factor(correlation, lower=True), design)
    return np.asarray(np.linalg.pinv(design.T @ weighted) @ (weighted.T @ values))


def coefficient(
    design: Floats, values: Floats, time_s: Floats, cycle: NDArray[np.int64], column: int
) -> Estimate:
    """Return one coefficient of a regression with its error and 95 % interval.

    Parameters
    ----------
    design : (n, p) array
    values, time_s : (n,) array
    cycle : (n,) array of int
        Observations that are left out together.
    column : int
        Of the design.
    """
    drift = likeliest_drift(design, values, time_s)
    correlation = drift.correlation(time_s)
    value = float(coefficients(design, values, correlation)[column])
    without = []
    for number in np.unique(cycle):
        kept = cycle != number
        if np.ptp(design[kept, column]) > 0 or np.ptp(design[:, column]) == 0:
            part = coefficients(design[kept], values[kept], correlation[np.ix_(kept, kept)])
            without.append(float(part[column]))
    return jackknife(value, without)


def jackknife(value: float, without: Sequence[float]) -> Estimate:
    """Return a value with the error that leaving out one piece at a time gives it.

    Parameters
    ----------
    value : float
        From all pieces.
    without : sequence of float
        The same without each of them; with fewer than three there is no error.
    """
    pieces = len(without)
    if pieces < FEWEST_PIECES:
        return Estimate(value, count=pieces)
    error = math.sqrt((pieces - 1) / pieces * float(np.square(np.array(without) - np.mean(without)).sum()))
    half = student(pieces - 1) * error
    return Estimate(value, error, value - half, value + half, pieces)


def predicted_by_others(values: Floats, time_s: Floats, group: NDArray[np.int64]) -> Floats:
    """Return a drifting value at each observation as those of all other groups predict it, (n,).

    Parameters
    ----------
    values, time_s : (n,) array
    group : (n,) array of int
        Observations that do not take part in each other's prediction.
    """
    mean = np.ones((len(values), 1))
    inverse = np.linalg.inv(likeliest_drift(mean, values, time_s).correlation(time_s))
    weighted = inverse @ mean
    residual = inverse @ (values - weighted[:, 0] @ values / weighted.sum())
    predicted = values.copy()
    for number in np.unique(group):
        rows = np.flatnonzero(group == number)
        predicted[rows] -= np.linalg.solve(inverse[np.ix_(rows, rows)], residual[rows])
    return predicted
