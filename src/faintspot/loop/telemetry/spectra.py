"""Spectra of open-loop slopes and of the fitted turbulence, noise and vibrations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.slope_spectra import SlopeRecords, SlopeSpectra
from faintspot.loop.control.identification.vibrations import MODES, mode_shapes

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
