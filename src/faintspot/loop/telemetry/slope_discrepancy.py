"""Errors of registration that open-loop slopes show, because no wavefront causes such slopes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.open_loop import Measured, OpenLoop
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.slope_spectra import interpolated
from faintspot.slopes.wavefront.discrepancy import not_gradients

Floats = NDArray[np.float64]

_LEAST_MEASURED = 0.7  # of the frames, of slopes that are compared
_BLOCKS = 12
_COMMON_ERRORS = 0.005, 0.02
"""Standard errors, rad and relative, of partly illuminated sub-apertures."""


def recorded_discrepancy(loop: Recording, open_loop: OpenLoop, identified: Identified) -> list[Measured]:
    """Return the rotation of the slopes' axes, and the gain of x relative to that of y.

    The slopes of a wavefront, turned or stretched, are not those of any wavefront: that part is compared with
    what is measured, for which the sum of slopes around a closed path is not 0. What noise and isotropic
    turbulence add is subtracted.
    """
    measured = open_loop.telemetry.trust > 0
    used = measured.mean(axis=0) >= _LEAST_MEASURED
    used &= np.tile(used.reshape(2, -1).all(axis=0), 2)
    others, n = not_gradients(np.asarray(loop.cells, np.int64), used), int(used.sum()) // 2
    ones, zeros = np.eye(n), np.zeros((n, n))
    changes = {
        ("rotation of the slopes' axes", "degrees"): np.block([[zeros, -ones], [ones, zeros]]),
        ("gain of x relative to y", ""): 0.5 * np.block([[ones, zeros], [zeros, -ones]]),
    }
    if not others.shape[1]:
        return [Measured(*quantity, remark="too few slopes were measured") for quantity in changes]
    slopes = interpolated(open_loop.telemetry.open_loop_px[:, used], measured[:, used])
    slopes = slopes - slopes.mean(axis=0)
    without = np.diag(open_loop.variance[used]) + identified.turbulence.covariance_px2()[np.ix_(used, used)]
    shares = [
        _share(slopes @ others, slopes @ change.T @ others, others, change, without, open_loop.variance[used])
        for change in changes.values()
    ]
    (angle, angle_error), (gain, gain_error) = (
        (value, math.hypot(error, common))
        for (value, error), common in zip(shares, _COMMON_ERRORS, strict=True)
    )
    turned, stretched = changes
    about = "of the detector's axes from those of the lenslets"
    return [
        Measured(*turned, math.degrees(angle), math.degrees(angle_error), about),
        Measured(*stretched, math.exp(gain), math.exp(gain) * gain_error),
    ]


def _share(
    projected: Floats, changed: Floats, others: Floats, change: Floats, without: Floats, noise: Floats
) -> tuple[float, float]:
    """Return how much of a change is in the slopes, and its standard error from blocks of frames.

    Parameters
    ----------
    projected, changed : (frames, k) array
        Slopes that no wavefront causes: as measured, and of the slopes after a whole change.
    others : (m, k) array
    change : (m, m) array
    without : (m, m) array
        Covariance of slopes without any change.
    noise : (m,) array
        Its part due to noise.
    """
    expected = float(np.einsum("ik,ij,jk->", others, without @ change.T, others))
    of_noise = float(np.square(change.T @ others).T.sum(axis=0) @ noise)
    products = (projected * changed).sum(axis=1) - expected
    squares = np.square(changed).sum(axis=1) - of_noise
    blocks = np.array_split(np.arange(len(products)), _BLOCKS)
    left_out = np.array(
        [np.delete(products, block).mean() / np.delete(squares, block).mean() for block in blocks]
    )
    error = math.sqrt((_BLOCKS - 1) * float(left_out.var()))
    return float(products.mean() / squares.mean()), error
