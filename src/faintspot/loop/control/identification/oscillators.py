"""Oscillators that describe tip and tilt where no winds are seen, as with a single sub-aperture.

The spectrum of each mode is taken for that of white noise and of several damped oscillators, which stand for
turbulence and for narrow and broad vibrations. One after the other is added by maximum likelihood, as long as
the Bayesian information criterion says so.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from faintspot.loop.control.identification.vibrations import MODES, ModeSpectra, Vibration, mode_spectra

Floats = NDArray[np.float64]

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
        fit = minimize(self._misfit, start, method="L-BFGS-B")
        return fit.x, float(fit.fun)

    def _misfit(self, x: Floats) -> float:
        expected = self._expected(x)
        return self._segments * float(np.sum(np.log(expected) + self._spectrum / expected)) / 2

    def _expected(self, x: Floats) -> Floats:
        total = np.full(len(self._spectrum), math.exp(np.clip(x[0], -80, 80)))
        for frequency, damping, power in x[1:].reshape(-1, 3):
            lagged = self._correlation * _vibration(frequency, damping).correlation(1.0, self._length)
            spectrum = 2 * np.fft.rfft(lagged).real[self._bins] - lagged[0]
            total += math.exp(np.clip(power, -80, 80)) * np.maximum(spectrum, 0.0)
        return total
