"""Estimate wind layers, turbulence, noise, vibrations and oscillators from open-loop slopes."""

from __future__ import annotations

import copy
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import scipy

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import OpenLoopTelemetry
from faintspot.loop.control.identification.layer_likelihood import LayerLikelihood, Layers
from faintspot.loop.control.identification.slope_spectra import SlopeRecords
from faintspot.loop.control.identification.vibrations import (
    MODES,
    ModeSpectra,
    Vibration,
    find_vibrations,
    mode_spectra,
    with_vibrations,
    without_passing_grid,
)
from faintspot.loop.control.kalman.predictor import SlopeModel
from faintspot.loop.slope_covariance import SlopeTurbulence

_MOST = 6
_FIRST_BIN = 2
_WIDTHS = (3, 15, 61)  # bins, of maxima that are sought
_FREQUENCIES = 1e-4, 0.25  # of the frame rate; faster ones cannot be predicted over the delay of a loop
_DAMPINGS = 1e-4, 0.99
_TURBULENCE = 0.002, 0.9
"""Frequency, as a part of the frame rate, and damping from which the fit of turbulence starts."""


def fitted_oscillators(
    amplitudes: Floats, rate_hz: float, slopes: int
) -> tuple[tuple[Vibration, ...], Floats]:
    """Return oscillators, and the variance of the white noise of each mode, (k,).

    Parameters
    ----------
    amplitudes : (frames, k) array
        Open-loop amplitudes of the first k of `MODES`.
    rate_hz : float
    slopes : int
        Number of slopes that the modes were taken from.

    """
    spectra, oscillators, noise = mode_spectra(amplitudes, rate_hz), [], []
    for mode, spectrum, values in zip(MODES, spectra.power, amplitudes.T, strict=False):
        x = _Fit(spectrum, spectra, float(values.var())).best()
        noise.append(math.exp(x[0]))
        for frequency, damping, power in x[1:].reshape(-1, 3):
            line = _vibration(frequency, damping)
            rms = math.sqrt(math.exp(power) / slopes)
            oscillators.append(replace(line, mode=mode, frequency_hz=line.frequency_hz * rate_hz, rms_px=rms))
    return tuple(oscillators), np.array(noise)


def _vibration(log_frequency: float, log_damping: float) -> Vibration:
    """Return an oscillator of variance 1 with a frequency in units of the frame rate."""
    frequency, damping = np.exp([log_frequency, log_damping])
    return Vibration(
        MODES[0],
        float(np.clip(frequency, *_FREQUENCIES)),
        float(np.clip(damping, *_DAMPINGS)),
        1.0,
        math.nan,
        math.nan,
    )


class _Fit:
    """Spectrum of a mode to which noise and oscillators are fitted.

    Parameters are logarithms: variance of the noise; frequency, damping and variance of each oscillator.
    """

    def __init__(self, spectrum: Floats, modes: ModeSpectra, variance: float) -> None:
        bins = np.arange(_FIRST_BIN, len(spectrum) - 1)
        self._spectrum, self._variance = spectrum[bins], variance
        self._length, self._segments = modes.length, modes.segments
        self._frequency, self._bins = bins / modes.length, bins
        self._correlation = np.correlate(modes.window, modes.window, "full")[modes.length - 1 :]
        self._of_line = lru_cache(4 * _MOST)(self._line)  # a step of the fit changes one oscillator at a time

    def best(self) -> Floats:
        """Return the parameters that the information criterion selects."""
        noise = np.median(self._spectrum[-len(self._spectrum) // 4 :])
        x, misfit = self._refined(np.log([noise, *_TURBULENCE, self._variance]))
        penalty = 1.5 * math.log(len(self._spectrum) * self._segments / 2)
        widths = [width for width in _WIDTHS if 2 * width < len(self._spectrum)]
        while widths and len(x) < 3 * _MOST:
            fits = [self._refined(np.append(x, self._start(x, width))) for width in widths]
            more, smaller = min(fits, key=lambda fit: fit[1])
            if misfit - smaller < penalty:
                break
            x, misfit = more, smaller
        return x

    def _start(self, x: Floats, width: int) -> Floats:
        """Return the parameters of an oscillator at the largest excess over a number of bins."""
        expected = self._expected(x)
        excess = np.convolve(self._spectrum / expected - 1, np.ones(width), "same")
        peak = int(np.argmax(excess[width // 2 : -(width // 2)])) + width // 2
        frequency = self._frequency[peak]
        damping = np.clip(width / (2 * self._length * frequency), 1e-3, 0.5)
        power = 2 * max(float(self._spectrum[peak] - expected[peak]), 0.0) * width / self._length
        return np.log([frequency, damping, max(power, 1e-9 * self._variance)])

    def _refined(self, start: Floats) -> tuple[Floats, float]:
        fit = scipy.optimize.minimize(self._misfit, start, method="L-BFGS-B")
        return fit.x, float(fit.fun)

    def _misfit(self, x: Floats) -> float:
        expected = self._expected(x)
        return self._segments * float(np.sum(np.log(expected) + self._spectrum / expected)) / 2

    def _expected(self, x: Floats) -> Floats:
        total = np.full(len(self._spectrum), math.exp(np.clip(x[0], -80, 80)))
        for frequency, damping, power in x[1:].reshape(-1, 3):
            total += math.exp(np.clip(power, -80, 80)) * self._of_line(float(frequency), float(damping))
        return total

    def _line(self, frequency: float, damping: float) -> Floats:
        """Return the spectrum of an oscillator of variance 1."""
        lagged = self._correlation * _vibration(frequency, damping).correlation(1.0, self._length)
        spectrum: Floats = np.maximum(2 * np.fft.rfft(lagged).real[self._bins] - lagged[0], 0.0)
        return spectrum


_SPEEDS_M_PER_S = (5.0, 10.0, 20.0)  # of winds from anywhere
AVERAGED = 1.0, 0.85, 0.7, 0.55
"""Values of `SlopeTurbulence.averaged` that describe slopes; a filter for them is best with the first."""


@dataclass(frozen=True, eq=False)
class Identified:
    """Turbulence, noise and vibrations estimated from telemetry."""

    turbulence: SlopeTurbulence
    noise_factor: float
    """Variance of the noise relative to the squared standard errors."""
    vibrations: tuple[Vibration, ...]
    rate_hz: float
    is_layered: bool
    """Whether each layer has its own state; else winds only describe how fast turbulence changes."""
    wind_error_m_per_s: Floats
    """(layers, 2): standard errors; NaN for winds that were not fitted."""
    fraction_error: Floats
    """(layers,): standard errors; NaN if not fitted."""
    criterion: float
    """Half the Bayesian information criterion, up to a constant."""
    oscillators: tuple[Vibration, ...] = ()
    """Oscillators that stand for turbulence and vibrations of a single sub-aperture; then r0 is infinite."""

    @property
    def layers(self) -> list[SlopeTurbulence]:
        """Turbulence of each part of the slopes that has a state of its own."""
        return self.turbulence.layers() if self.is_layered else [self.turbulence]

    def covariances_px2(self) -> Floats:
        """Return (layers, 3, m, m): covariances of each layer's slopes for lags of 0, 1 and 2 frames."""
        return np.array([layer.lagged_px2(1 / self.rate_hz) for layer in self.layers])

    def parameters(self) -> Layers:
        """Return the parameters of the layers' likelihood."""
        air = self.turbulence
        strength = air.fraction * air.r0_m ** (-5 / 3)
        return Layers(air.wind_m_per_s, strength, self.noise_factor, air.outer_scale_m)

    def slope_model(self) -> SlopeModel:
        """Return the temporal model of the slopes, vibrations included."""
        slopes = 2 * len(self.turbulence.positions_m)
        model = SlopeModel(*np.zeros((3, 0, slopes, slopes)))
        if not self.oscillators:
            model = SlopeModel.of_covariances(self.covariances_px2())
        return with_vibrations(model, self.moving, self.turbulence.positions_m, self.rate_hz)

    @property
    def moving(self) -> tuple[Vibration, ...]:
        """Oscillators of the model: vibrations, or all that a single sub-aperture sees."""
        return self.oscillators or self.vibrations

    def summary(self) -> str:
        """Return a summary of one line."""
        if self.oscillators:
            return ", ".join(f"{mode.mode} at {mode.frequency_hz:.1f} Hz" for mode in self.oscillators)
        winds, shares = self.turbulence.wind_m_per_s, self.turbulence.fraction
        per_s = f"{self.turbulence.length_unit}/s"
        layers = [
            f"{math.hypot(x, y):.1f} {per_s} to {math.degrees(math.atan2(y, x)) % 360:.0f} degrees "
            f"({part:.0%})"
            for (x, y), part in sorted(zip(winds, shares, strict=True), key=lambda layer: -layer[1])
        ]
        shaking = [f"{line.mode} shakes at {line.frequency_hz:.1f} Hz" for line in self.vibrations]
        air = ", ".join(layers) if self.is_layered else "winds from anywhere"
        return ", ".join([air, *shaking])


class Identification:
    """Models of one piece of telemetry.

    Parameters
    ----------
    telemetry : OpenLoopTelemetry
    site : SlopeTurbulence
        Positions, sub-aperture and pixel scale; its outer scale is assumed within a factor of two.
    rate_hz : float
        Frames per second.
    averaged : sequence of float
        Values of `SlopeTurbulence.averaged` of which the likeliest is used.

    Raises
    ------
    InputError
        When too few sub-apertures were measured, or too few frames without a gap.
    """

    def __init__(
        self,
        telemetry: OpenLoopTelemetry,
        site: SlopeTurbulence,
        rate_hz: float,
        averaged: Sequence[float] = AVERAGED,
    ) -> None:
        self._site, self._rate_hz, self._averaged = site, rate_hz, tuple(averaged)
        records, whole = SlopeRecords.of(telemetry, site), SlopeRecords.of(telemetry, site, sys.maxsize)
        self._vibrations = find_vibrations(whole.modes(), rate_hz, whole.slopes.shape[1])
        self._likelihood = LayerLikelihood(records, rate_hz, self._vibrations)
        self._records = records
        self._anywhere: dict[float, tuple[LayerLikelihood, Layers]] = {}
        self._selected: dict[float, tuple[Layers, Floats]] = {}

    def among(self, averaged: Sequence[float]) -> Identification:
        """Return the identification with other values of `averaged`; fits are shared."""
        other = copy.copy(self)
        other._averaged = tuple(averaged)
        return other

    def layers(self, start: Identified | None = None) -> Identified:
        """Return layers with winds fitted to the telemetry, from earlier ones on, if any.

        A single sub-aperture shows no winds: of it, oscillators are fitted.
        """
        if len(self._site.positions_m) == 1:
            return self._oscillating()
        if start is not None:
            likelihood = self._likelihood.averaging(start.turbulence.averaged)
            return self._identified(likelihood, *likelihood.selected(start.parameters()))
        likelihood, _ = self._best
        if likelihood.averaged not in self._selected:
            self._selected[likelihood.averaged] = likelihood.selected(likelihood.peaks())
        layers, errors = self._selected[likelihood.averaged]
        # Winds from anywhere are not quite the turbulence, so neighbouring values are tried with layers, too.
        index = self._averaged.index(likelihood.averaged)
        for averaged in (*self._averaged[max(index - 1, 0) : index], *self._averaged[index + 1 : index + 2]):
            candidate = self._likelihood.averaging(averaged)
            refined = candidate.refined(layers)
            if refined.criterion < layers.criterion:
                likelihood, layers, errors = candidate, refined, candidate.errors(refined)
        return self._identified(likelihood, layers, errors)

    def of_winds(self, winds_m_per_s: Floats) -> Identified:
        """Return layers with given winds, (layers, 2), and fitted strengths."""
        likelihood, _ = self._best
        winds = np.asarray(winds_m_per_s, np.float64)[:, None]
        return self._identified(likelihood, likelihood.of_winds(winds))

    def anywhere(self) -> Identified:
        """Return isotropic turbulence: winds of several speeds, equally from all directions."""
        return self._identified(*self._best, is_layered=False)

    @property
    def _best(self) -> tuple[LayerLikelihood, Layers]:
        """The likelihood with the best of `averaged` for winds from anywhere, and these."""
        speeds = np.array(_SPEEDS_M_PER_S)
        still = replace(self._site, fraction=np.ones(len(speeds)), wind_m_per_s=np.outer(speeds, [1.0, 0.0]))
        winds = still.from_anywhere().wind_m_per_s
        for averaged in self._averaged:
            if averaged not in self._anywhere:
                likelihood = self._likelihood.averaging(averaged)
                self._anywhere[averaged] = likelihood, likelihood.of_winds(winds[None])
        return min(
            (self._anywhere[averaged] for averaged in self._averaged), key=lambda fit: fit[1].criterion
        )

    def _oscillating(self) -> Identified:
        records, none = self._records, np.full((1, 2), np.nan)
        fitted, noise_px2 = fitted_oscillators(records.modes()[:, :2], self._rate_hz, records.slopes.shape[1])
        still = replace(self._site, r0_m=math.inf, fraction=np.ones(1), wind_m_per_s=np.zeros((1, 2)))
        factor = float((noise_px2 / records.noise_px2).mean())
        rest = factor, self._vibrations, self._rate_hz, False, none, none[0, :1], math.nan
        return Identified(still, *rest, fitted)

    def _identified(
        self,
        likelihood: LayerLikelihood,
        layers: Layers,
        errors: Floats | None = None,
        *,
        is_layered: bool = True,
    ) -> Identified:
        fraction = layers.strength / layers.strength.sum()
        errors = np.full((len(fraction), 3), np.nan) if errors is None else errors
        turbulence = replace(
            self._site,
            r0_m=float(layers.strength.sum() ** (-3 / 5)),
            outer_scale_m=layers.outer_scale_m,
            fraction=fraction,
            wind_m_per_s=layers.wind_m_per_s,
            averaged=likelihood.averaged,
        )
        vibrations = self._vibrations
        if is_layered:
            site = self._site
            geometry = site.positions_m, site.subaperture_m, self._rate_hz
            vibrations = without_passing_grid(vibrations, layers.wind_m_per_s, *geometry)
        return Identified(
            turbulence,
            layers.noise,
            vibrations,
            self._rate_hz,
            is_layered,
            errors[:, :2],
            fraction * errors[:, 2],
            layers.criterion,
        )
