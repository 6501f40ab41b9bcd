"""Likelihood of frozen-flow layers given the cross-spectra of slopes, and its maximum.

Cross-spectra of all slopes in overlapping windows are compared with those of frozen layers of von Karman
turbulence (Whittle's likelihood of complex Wishart matrices). Strengths of all winds of a grid come first, by
multiplicative updates; then winds, strengths, noise and outer scale of the layers that stand out are refined,
and layers are merged or left out as long as the Bayesian information criterion says so.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.loop.control.identification.slope_spectra import SlopeRecords, SlopeSpectra
from faintspot.loop.control.identification.vibrations import MODES, Vibration, mode_shapes
from faintspot.loop.turbulence_strength import OUTER_SCALE_SPREAD

Complex = NDArray[np.complex128]

_WINDOW_S, _WINDOW, _SHORTEST_WINDOW = 0.5, 64, 16
_FASTEST_M_PER_S = 45.0
_RINGS_M_PER_S = (0.0, 1.5, 3.0, 4.5, 6.0, 8.0, 10.5, 13.5, 17.5, 22.5, 29.0, 37.0)
_UPDATES, _FIRST_UPDATES = 60, 3
_MOST_LAYERS = 6
_LEAST_SHARE = 0.03
_CLEAR = np.array([2.0, 6.0])
"""Expected rises of the misfit, in penalties of a layer, beyond which the layers are not tried without the
weakest, and with the nearest two merged. The first is underestimated by up to three times, the second
overestimated as much."""
_REFINEMENTS = 40
_SPEED_UNIT = 2.0  # m/s, in which winds have about the same effect as logarithms of strengths
_NOISE = 1e-3, 1e3
_UNMODELLED, _UNMODELLED_RANGE = 0.03, (0.003, 0.3)  # of `Layers.unmodelled`: the first value, and limits


@dataclass(frozen=True, eq=False)
class Layers:
    """Parameters of a model of the turbulence."""

    wind_m_per_s: Floats
    """(layers, 2)"""
    strength: Floats
    """(layers,): r0^(-5/3)."""
    noise: float
    outer_scale_m: float
    unmodelled: float = _UNMODELLED
    """Part of the turbulence's spectra that is not as in the model, in each slope independently: centroid
    gains, aliasing, speckles. Bright stars, whose noise does not hide it, would have false layers."""
    criterion: float = math.inf


class LayerLikelihood:
    """Half the deviance of models from the cross-spectra of records."""

    def __init__(self, records: SlopeRecords, rate_hz: float, vibrations: Sequence[Vibration]) -> None:
        every = max(1, round(_WINDOW_S * rate_hz / _WINDOW))
        length = min(_WINDOW, max(_SHORTEST_WINDOW, len(records.slopes) // (3 * every)))
        window = np.hanning(length + 2)[1:-1]
        window /= np.linalg.norm(window)
        self._bins = np.arange(
            1, length // 2, 2
        )  # every second one: neighbours are alike under such a window
        segments = records.segments(every, length)
        transformed = np.fft.rfft(segments * window[:, None], axis=1)[:, self._bins].swapaxes(0, 1)
        self._measured = transformed.swapaxes(1, 2) @ transformed.conj() / len(segments)
        self._weight = len(segments) / every
        step_s = every / rate_hz
        reach_m = _FASTEST_M_PER_S * length * step_s
        self._site, self.averaged = records.site, records.site.averaged
        self._spectra = SlopeSpectra(records.site, step_s, window, self._bins, reach_m)
        self._tables, _ = self._spectra.tables(records.site.outer_scale_m)
        self._noise_px2 = records.noise_px2
        self._vibrating = self._of_vibrations(vibrations, rate_hz, every, length)

    def _of_vibrations(
        self, vibrations: Sequence[Vibration], rate_hz: float, every: int, length: int
    ) -> Complex:
        """Return the cross-spectra of vibrations."""
        m = len(self._noise_px2)
        shapes, total = mode_shapes(self._site.positions_m), np.zeros((len(self._bins), m, m), np.complex128)
        for vibration in vibrations:
            correlation = vibration.correlation(rate_hz, every * length)[::every]
            spectrum = self._spectra.of_process(m * vibration.rms_px**2 * correlation)
            shape = shapes[MODES.index(vibration.mode)]
            total += spectrum.real[:, None, None] * np.outer(shape, shape)
        return total

    def averaging(self, averaged: float) -> LayerLikelihood:
        """Return the likelihood with another `SlopeTurbulence.averaged`."""
        likelihood = copy.copy(self)
        likelihood.averaged, likelihood._spectra = averaged, self._spectra.averaging(averaged)
        likelihood._tables, _ = likelihood._spectra.tables(self._site.outer_scale_m)
        return likelihood

    def _matrices(self, distinct: Complex, unmodelled: float) -> Complex:
        """Return the cross-spectra of turbulence with what is not modelled of it."""
        full, diagonal = self._spectra.matrices(distinct), np.arange(len(self._noise_px2))
        full[:, diagonal, diagonal] *= 1 + unmodelled
        return full

    def _summed(self, gradient: Complex, unmodelled: float) -> Complex:
        """Return `SlopeSpectra.summed` for `_matrices`."""
        diagonal = np.arange(len(self._noise_px2))
        scaled = gradient.copy()
        scaled[:, diagonal, diagonal] *= 1 + unmodelled
        return self._spectra.summed(scaled)

    def _residual(self, turbulence: Complex, noise: float) -> tuple[Complex, Complex]:
        """Return the model's cross-spectra and their inverse, from those of the turbulence."""
        model = turbulence + self._vibrating
        diagonal = np.arange(len(self._noise_px2))
        model[:, diagonal, diagonal] += noise * self._noise_px2
        return model, np.asarray(np.linalg.inv(model), np.complex128)

    def _value(self, distinct: Complex, noise: float, unmodelled: float) -> tuple[float, Complex, Floats]:
        """Return the misfit, and its derivatives with the distinct spectra and with the other two."""
        turbulence = self._matrices(distinct, unmodelled)
        model, inverse = self._residual(turbulence, noise)
        explained = inverse @ self._measured
        _, logarithm = np.linalg.slogdet(model)
        value = self._weight * float(logarithm.sum() + np.trace(explained, axis1=1, axis2=2).real.sum())
        gradient = self._weight * (inverse - explained @ inverse)
        of_slopes, power = (np.diagonal(matrix, axis1=1, axis2=2).real for matrix in (gradient, turbulence))
        of_noise = [(of_slopes @ self._noise_px2).sum(), (of_slopes * power).sum() / (1 + unmodelled)]
        return value, self._summed(gradient, unmodelled), np.array(of_noise)

    def strengths(self, spectra: Complex, start: float, noise: float = 1.0) -> tuple[Floats, float]:
        """Return strengths of given spectra (components, frequencies, distinct), and the noise.

        Multiplicative updates, each of which keeps what is positive positive (expectation maximisation with
        longer steps).
        """
        flat = spectra.reshape(len(spectra), -1).astype(np.complex64)
        strength = np.full(len(spectra), start / len(spectra))
        for update in range(_UPDATES):
            power = 0.5 if update < _FIRST_UPDATES else 0.9
            distinct = (strength.astype(np.float32) @ flat).reshape(spectra.shape[1:]).astype(np.complex128)
            _, inverse = self._residual(self._matrices(distinct, _UNMODELLED), noise)
            explained = inverse @ self._measured @ inverse
            measured, expected = (
                (flat @ self._summed(part, _UNMODELLED).ravel().astype(np.complex64)).real.astype(np.float64)
                for part in (explained, inverse)
            )
            strength *= (np.maximum(measured, 0.0) / np.maximum(expected, 1e-30)) ** power
            measured_noise, expected_noise = (
                (np.diagonal(matrices, axis1=1, axis2=2).real @ self._noise_px2).sum()
                for matrices in (explained, inverse)
            )
            noise = float(np.clip(noise * (measured_noise / expected_noise) ** power, *_NOISE))
        return strength, noise

    def of_winds(self, winds_m_per_s: Floats) -> Layers:
        """Return the strengths of components (components, winds, 2), each of several equally strong winds."""
        spectra = np.array(
            [
                np.mean([self._spectra.of_wind(wind, self._tables) for wind in winds], axis=0)
                for winds in winds_m_per_s
            ]
        )
        strength, noise = self.strengths(spectra, self._start())
        value, _, _ = self._value(np.tensordot(strength, spectra, 1), noise, _UNMODELLED)
        outer_scale_m, n_winds = self._site.outer_scale_m, winds_m_per_s.shape[1]
        return Layers(
            winds_m_per_s.reshape(-1, 2),
            np.repeat(strength / n_winds, n_winds),
            noise,
            outer_scale_m,
            criterion=value + self._penalty(len(strength) + 1),
        )

    def peaks(self) -> Layers:
        """Return the winds of a grid with a significant strength, and the strength around them."""
        winds = _grid()
        spectra = np.array([self._spectra.of_wind(wind, self._tables) for wind in winds])
        strength, noise = self.strengths(spectra, self._start())
        if not strength.sum() > 0:
            raise InputError("slopes: no turbulence that a wind carries was found")
        remaining, peaks = strength.copy(), []
        near = np.hypot(*(winds[:, None] - winds).transpose(2, 0, 1)) < _near(winds)[:, None]
        for _ in range(_MOST_LAYERS):
            around = (near @ remaining) * (remaining > 0)
            best = int(np.argmax(around))
            if around[best] < _LEAST_SHARE * strength.sum():
                break
            part = remaining * near[best]
            peaks.append([*(part @ winds / part.sum()), part.sum()])
            remaining[near[best]] = 0.0
        x, y, peak = np.array(peaks).T
        return Layers(np.column_stack([x, y]), peak, noise, self._site.outer_scale_m)

    def selected(self, start: Layers) -> tuple[Layers, Floats]:
        """Return the layers that the information criterion selects, from a start on, and their `errors`."""
        best = self.refined(start)
        errors = self.errors(best)
        while len(best.strength) > 1:
            is_weak = best.strength.min() < _LEAST_SHARE * best.strength.sum()
            is_clear = (_rises(best, errors) > _CLEAR * self._penalty(3)) & (not is_weak)
            fewer = [model for model, clear in zip(_with_one_less(best), is_clear, strict=True) if not clear]
            if not fewer:
                break
            simpler = min(map(self.refined, fewer), key=lambda layers: layers.criterion)
            if simpler.criterion > best.criterion and not is_weak:
                break
            best, errors = simpler, self.errors(simpler)
        return best, errors

    def refined(self, start: Layers) -> Layers:
        """Return the maximum-likelihood layers near a starting point."""
        count = len(start.strength)
        scale = self._weight * len(self._bins)

        def misfit(x: Floats) -> tuple[float, Floats]:
            value, gradient = self._of_layers(_unpacked(x, count))
            prior = (x[-1] - math.log(self._site.outer_scale_m)) / OUTER_SCALE_SPREAD
            gradient[-1] += prior / OUTER_SCALE_SPREAD
            return (value + 0.5 * prior**2) / scale, gradient / scale

        fit = scipy.optimize.minimize(
            misfit,
            _packed(start),
            jac=True,
            method="L-BFGS-B",
            bounds=_bounds(count),
            options={"maxiter": _REFINEMENTS, "ftol": 2e-7},
        )
        return replace(
            _unpacked(fit.x, count), criterion=scale * float(fit.fun) + self._penalty(3 * count + 3)
        )

    def _of_layers(self, layers: Layers) -> tuple[float, Floats]:
        """Return the misfit of layers, and its derivatives with respect to the packed parameters."""
        derivatives, total = self._derivatives(layers)
        noise = np.array([layers.noise, layers.unmodelled])
        value, gradient, of_others = self._value(total, *noise)
        of_spectra = [float((gradient * derivative).sum().real) for derivative in derivatives]
        return value, np.array([*of_spectra[:-1], *(of_others * noise), of_spectra[-1]])

    def _derivatives(self, layers: Layers) -> tuple[list[Complex], Complex]:
        """Return the derivatives of the distinct spectra with winds, strengths and outer scale, and them."""
        tables, slopes = self._spectra.tables(layers.outer_scale_m)
        of_winds, of_strengths = [], []
        total, of_scale = 0.0, 0.0
        for wind, strength in zip(layers.wind_m_per_s, layers.strength, strict=True):
            unshifted, *along, scale = strength * self._spectra.changes(wind, tables, slopes)
            of_winds += [_SPEED_UNIT * derivative for derivative in along]
            of_strengths.append(unshifted)
            total, of_scale = total + unshifted, of_scale + scale
        return [*of_winds, *of_strengths, np.asarray(of_scale)], np.asarray(total)

    def errors(self, layers: Layers) -> Floats:
        """Return (layers, 3) standard errors of winds (x, y, m/s) and of the logarithm of the strength."""
        derivatives, total = self._derivatives(layers)
        turbulence = self._matrices(total, layers.unmodelled)
        _, inverse = self._residual(turbulence, layers.noise)
        of_noise = np.zeros((2, *inverse.shape), np.complex128)
        diagonal = np.arange(len(self._noise_px2))
        of_noise[0][:, diagonal, diagonal] = layers.noise * self._noise_px2
        part = layers.unmodelled / (1 + layers.unmodelled)
        of_noise[1][:, diagonal, diagonal] = part * turbulence[:, diagonal, diagonal]
        of_spectra = (self._matrices(derivative, layers.unmodelled) for derivative in derivatives)
        changes = np.array([inverse @ change for change in (*of_spectra, *of_noise)])
        flat = changes.reshape(len(changes), -1)
        information = self._weight * (flat @ changes.swapaxes(2, 3).reshape(len(changes), -1).T).real
        information[-3, -3] += OUTER_SCALE_SPREAD**-2
        count = len(layers.strength)
        errors = np.sqrt(np.maximum(np.diag(np.linalg.pinv(information, hermitian=True)), 0.0))
        winds = _SPEED_UNIT * errors[: 2 * count].reshape(count, 2)
        return np.column_stack([winds, errors[2 * count : 3 * count]])

    def _penalty(self, parameters: int) -> float:
        return 0.5 * parameters * math.log(max(2.0, self._weight * len(self._bins)))

    def _start(self) -> float:
        """Return a strength r0^(-5/3) from the total variance."""
        spectra = self._spectra.of_wind(np.array([10.0, 0.0]), self._tables)
        turbulence = self._matrices(spectra, _UNMODELLED)
        both = self._measured, turbulence
        measured, theory = (np.trace(matrices, axis1=1, axis2=2).real.sum() for matrices in both)
        return float(0.5 * measured / theory)


def _grid() -> Floats:
    """Return the winds of a grid, (winds, 2) m/s, at the resolution of half-second windows."""
    winds = [np.zeros((1, 2))]
    for ring, speed in enumerate(_RINGS_M_PER_S[1:]):
        count = math.ceil(2 * math.pi * speed / max(1.5, 0.22 * speed))
        angle = 2 * math.pi * (np.arange(count) + 0.5 * (ring % 2)) / count
        winds.append(speed * np.column_stack([np.cos(angle), np.sin(angle)]))
    return np.concatenate(winds)


def _near(winds_m_per_s: Floats) -> Floats:
    """Return the distance within which winds count as the same peak [m/s]."""
    return np.asarray(np.maximum(2.5, 0.3 * np.hypot(*winds_m_per_s.T)))


def _doubtful(layers: Layers) -> tuple[int, int, int]:
    """Return the weakest layer, and the nearest two."""
    winds = layers.wind_m_per_s
    apart = np.hypot(*(winds[:, None] - winds).transpose(2, 0, 1)) / np.minimum(
        *np.meshgrid(*[_near(winds)] * 2)
    )
    first, second = np.unravel_index(np.argmin(apart + np.diag(np.full(len(winds), np.inf))), apart.shape)
    return int(np.argmin(layers.strength)), int(first), int(second)


def _rises(layers: Layers, errors: Floats) -> Floats:
    """Return the expected rises of the misfit without the weakest layer, and with the nearest two merged.

    They are those of a parabola with the curvature that the errors tell (Wald's test); 0 if not known.
    """
    weakest, first, second = _doubtful(layers)
    difference = layers.wind_m_per_s[first] - layers.wind_m_per_s[second]
    variance = np.square(errors)
    of_winds = variance[[first, second], :2].sum(axis=0)
    if min(variance[weakest, 2], *of_winds) == 0:
        return np.zeros(2)
    return 0.5 * np.array([1 / variance[weakest, 2], (difference**2 / of_winds).sum()])


def _with_one_less(layers: Layers) -> list[Layers]:
    """Return the layers without the weakest, and with the nearest two merged."""
    strength, winds = layers.strength, layers.wind_m_per_s
    weakest, first, second = _doubtful(layers)
    merged, pair = winds.copy(), strength[[first, second]]
    merged[first] = pair @ winds[[first, second]] / pair.sum()
    sums = strength.copy()
    sums[first] = pair.sum()
    left_out = replace(
        layers, wind_m_per_s=np.delete(winds, weakest, 0), strength=np.delete(strength, weakest)
    )
    joined = replace(layers, wind_m_per_s=np.delete(merged, second, 0), strength=np.delete(sums, second))
    return [left_out, joined]


def _packed(layers: Layers) -> Floats:
    """Return the parameters scaled to similar size: winds, and logarithms of all others."""
    ends = np.log([layers.noise, layers.unmodelled, layers.outer_scale_m])
    return np.concatenate([layers.wind_m_per_s.ravel() / _SPEED_UNIT, np.log(layers.strength), ends])


def _unpacked(x: Floats, count: int) -> Layers:
    noise, unmodelled, scale = map(math.exp, x[-3:])
    winds = _SPEED_UNIT * x[: 2 * count].reshape(count, 2)
    return Layers(winds, np.exp(x[2 * count : -3]), noise, scale, unmodelled)


def _bounds(count: int) -> list[tuple[float, float]]:
    fastest = _FASTEST_M_PER_S / _SPEED_UNIT
    logarithms = [(-25.0, 25.0)] * count
    ends = [(math.log(low), math.log(high)) for low, high in (_NOISE, _UNMODELLED_RANGE, (2.0, 200.0))]
    return [(-fastest, fastest)] * (2 * count) + logarithms + ends
