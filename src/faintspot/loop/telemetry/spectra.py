"""Spectra of open-loop slopes and of the fitted turbulence, noise and vibrations; its strength and winds."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import (
    R0,
    Measured,
    OpenLoop,
    outer_scale_and_r0,
    wind_errors,
    winds_of,
)
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.slope_spectra import SlopeRecords, SlopeSpectra, interpolated
from faintspot.loop.control.identification.vibrations import MODES, mode_shapes
from faintspot.loop.slope_covariance import ARCSEC, SlopeTurbulence
from faintspot.loop.turbulence_strength import differential_image_motion, turbulence_strength
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M
from faintspot.slopes.wavefront.discrepancy import not_gradients

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
_LARGEST_ERROR = 0.5
"""The changes are taken to be small."""


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
    if max(angle_error, gain_error) > _LARGEST_ERROR:
        return [Measured(*quantity, remark="hidden by noise") for quantity in changes]
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


_DRAWS = 1000
_GAIN_SPREAD = 0.5  # of the deviation of the centroid gain from 1: it differs between spatial scales
_FEWEST_FOR_MOTION = 200  # frames with all slopes
_MOSTLY = 0.8  # of the frames


def measured_strength(
    loop: Recording, open_loop: OpenLoop, delay: LoopDelay, site: SlopeTurbulence
) -> list[Measured]:
    """Return outer scale, r0, r0 as of a seeing monitor, and the seeing."""
    if loop.pixel_scale_arcsec is None:
        return [Measured(R0, "m", remark="pixel_scale_arcsec is unknown")]
    if loop.is_closed:  # a matrix of mean gradients makes of what the mirror corrects mean gradients, too
        site = replace(site, averaged=0.5 * (1 + site.averaged))
    rows = open_loop.telemetry.trust.any(axis=1)
    strength = turbulence_strength(
        open_loop.telemetry.open_loop_px[rows],
        open_loop.residual[rows],
        open_loop.run[rows],
        site,
        gain_error=delay.gain_error / delay.gain,
        gain_spread=_GAIN_SPREAD * abs(1 - delay.gain),
        outer_scale_m=loop.outer_scale_m,
        frame_rate_hz=loop.frame_rate_hz,
    )
    if not math.isfinite(strength.r0_m):
        return [Measured(R0, "m", remark="no turbulence seen: the slopes are those of noise")]
    outer, r0 = outer_scale_and_r0(strength, loop.outer_scale_m)
    if not loop.is_closed:
        r0 = replace(r0, remark=f"for a centroid gain of 1 ± {delay.gain_error:.2g}")
    values = [outer, r0, *_image_motion(open_loop, site, loop.frame_rate_hz, delay.gain_error / delay.gain)]
    seeing = 0.98 * R0_WAVELENGTH_M / strength.r0_m / ARCSEC
    relative = strength.r0_error_m / strength.r0_m
    return [*values, Measured("seeing at 500 nm", "arcsec", seeing, seeing * relative, "0.98 λ / r0", True)]


def _image_motion(
    open_loop: OpenLoop, site: SlopeTurbulence, rate_hz: float, gain_error: float
) -> list[Measured]:
    """Return r0 as a seeing monitor measures it, from the sub-apertures that were measured in most frames."""
    measured = open_loop.telemetry.trust > 0
    kept = measured.mean(axis=0).reshape(2, -1).min(axis=0) > _MOSTLY
    columns = np.tile(kept, 2)
    slopes = open_loop.telemetry.open_loop_px[measured[:, columns].all(axis=1)][:, columns]
    if len(slopes) < _FEWEST_FOR_MOTION:
        return []
    site = replace(site, positions_m=site.positions_m[kept])
    r0, error = differential_image_motion(slopes, open_loop.variance[columns], site, rate_hz)
    error = math.hypot(error, 6 / 5 * gain_error * r0)
    remark = "as of a seeing monitor, for an infinite outer scale"
    return [Measured("r0 at 500 nm from differential image motion", "m", r0, error, remark, True)]


def measured_winds(identified: Identified, r0: Measured) -> list[Measured]:
    """Return coherence time, mean wind speed, and each layer's speed, direction and share."""
    turbulence = identified.turbulence
    winds, share = turbulence.wind_m_per_s, turbulence.fraction
    errors = wind_errors(identified)
    rng = np.random.default_rng(1)
    drawn = winds + errors * rng.standard_normal((_DRAWS, *winds.shape))
    weight = np.maximum(share + identified.fraction_error * rng.standard_normal((_DRAWS, len(share))), 1e-6)
    speeds = np.hypot(drawn[..., 0], drawn[..., 1])
    mean = ((weight * speeds ** (5 / 3)).sum(axis=1) / weight.sum(axis=1)) ** 0.6
    speed = float((share @ np.hypot(*winds.T) ** (5 / 3)) ** 0.6)
    values = [Measured("wind speed, mean for the coherence time", "m/s", speed, float(mean.std()))]
    if math.isfinite(r0.value):
        time_ms = 314 * r0.value / speed
        error = time_ms * math.hypot(r0.error / r0.value, float(mean.std()) / speed)
        values.append(Measured("coherence time at 500 nm", "ms", time_ms, error))
    for rank, wind in enumerate(winds_of(identified), 1):
        values += [replace(value, name=f"layer {rank}: {value.name}") for value in vars(wind).values()]
    return values
