"""Telemetry of a frame other than its slopes, computed in one pass."""

from __future__ import annotations

from typing import Any

from faintspot.base.flags import INVALID, SubapertureFlag
from faintspot.slopes.kernels.compilation.compiling import compiled

_INVALID, _NOT_CONVERGED = int(INVALID), int(SubapertureFlag.NOT_CONVERGED)


@compiled
def fill_telemetry_rows(
    flux: Any,
    flags: Any,
    iterations: Any,
    error_x: Any,
    error_y: Any,
    covariance_xy: Any,
    counts: Any,
    table: Any,
) -> None:
    """Fill a table (7, n), and count: invalid sub-apertures, those at the iteration limit, iterations.

    Rows of the table: flux, valid, standard errors of x and y, iterations, flags, covariance of x and y.
    """
    counts[0] = counts[1] = counts[2] = 0
    for s in range(flux.shape[0]):
        invalid = flags[s] & _INVALID != 0
        counts[0] += invalid
        counts[1] += flags[s] & _NOT_CONVERGED != 0
        counts[2] += iterations[s]
        table[0, s] = flux[s]
        table[1, s] = 0.0 if invalid else 1.0
        table[2, s] = error_x[s]
        table[3, s] = error_y[s]
        table[4, s] = iterations[s]
        table[5, s] = flags[s]
        table[6, s] = covariance_xy[s]
