"""Spectra of open-loop slopes and of the fitted turbulence, noise and vibrations."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.open_loop import Measured, OpenLoop
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.slope_spectra import SlopeRecords, SlopeSpectra, interpolated
from faintspot.loop.control.identification.vibrations import MODES, mode_shapes
from faintspot.slopes.wavefront.discrepancy import not_gradients

Floats = NDArray[np.float64]

_LONGEST = 512
_FASTEST_M_PER_S = 60.0
OTHERS = "others"


@dataclass(frozen=True, eq=False)
class ModalSpectra:
    """Power spectra of tip, tilt, focus, and the mean of the other combinations of slopes, px^2/Hz."""

    frequency_hz: Floats
    measured: dict[str, Floats]
    model: dict[str, Floats]
    pieces: int
    """Number of averaged half-overlapping pieces."""


def modal_spectra(telemetry: OpenLoopTelemetry, identified: Identified) -> ModalSpectra:
    """Return measured and fitted spectra.

    Raises
    ------
    InputError
        When no sub-aperture was measured often enough.
    """
    rate, records = identified.rate_hz, SlopeRecords.of(telemetry, identified.turbulence)
    length = min(_LONGEST, len(records.slopes) // 4 * 2)
    window = np.hanning(length + 2)[1:-1]
    window /= np.linalg.norm(window)
    starts = range(0, len(records.slopes) - length + 1, length // 2)
    bins = np.arange(1, length // 2)
    shapes, m = mode_shapes(records.site.positions_m), records.slopes.shape[1]
    transformed = np.array(
        [
            np.fft.rfft(records.slopes[start : start + length] * window[:, None], axis=0)[bins]
            for start in starts
        ]
    )
    modes = np.square(np.abs(transformed @ shapes.T)).mean(axis=0).T
    total = np.square(np.abs(transformed)).sum(axis=2).mean(axis=0)
    matrices = _model(records, identified, window, bins)
    expected = np.einsum("ki,fij,kj->kf", shapes, matrices, shapes)
    total_model = np.trace(matrices, axis1=1, axis2=2)
    measured, model = dict(zip(MODES, modes, strict=True)), dict(zip(MODES, expected, strict=True))
    others = max(m - len(MODES), 1)
    measured[OTHERS], model[OTHERS] = (
        (total - modes.sum(axis=0)) / others,
        (total_model - expected.sum(axis=0)) / others,
    )
    shown = [name for name, values in measured.items() if (values > 0).all()]  # few slopes have no focus
    density = 2 / rate
    return ModalSpectra(
        bins * rate / length,
        {name: density * measured[name] for name in shown},
        {name: density * model[name] for name in shown},
        len(starts),
    )


def _model(records: SlopeRecords, identified: Identified, window: Floats, bins: NDArray[np.int64]) -> Floats:
    """Return the cross-spectra (frequencies, m, m) of turbulence, noise and vibrations."""
    turbulence, rate, length = identified.turbulence, identified.rate_hz, len(window)
    shapes, m = mode_shapes(records.site.positions_m), records.slopes.shape[1]
    spectra = SlopeSpectra(records.site, 1 / rate, window, bins, _FASTEST_M_PER_S * length / rate)
    tables, _ = spectra.tables(turbulence.outer_scale_m)
    strength = turbulence.r0_m ** (-5 / 3) * turbulence.fraction
    distinct = sum(
        part * spectra.of_wind(wind, tables)
        for part, wind in zip(strength, turbulence.wind_m_per_s, strict=True)
    )
    matrices = spectra.matrices(np.asarray(distinct)).real
    diagonal = np.arange(m)
    matrices[:, diagonal, diagonal] += identified.noise_factor * records.noise_px2
    for oscillation in identified.moving:
        line = spectra.of_process(m * oscillation.rms_px**2 * oscillation.correlation(rate, length)).real
        shape = shapes[MODES.index(oscillation.mode)]
        matrices += np.maximum(line, 0.0)[:, None, None] * np.outer(shape, shape)
    return np.asarray(matrices)


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
