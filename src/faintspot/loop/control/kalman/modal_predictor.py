"""Kalman filters of modes: autoregressions seen through white noise, each on its own.

What the past of the strongest modes tells beyond that of each mode is added to its prediction: turbulence
that the wind carries is in some modes before it is in others. No geometry of the sensor is known.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.linalg import solve_toeplitz
from scipy.signal import lfilter

from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2

Floats = NDArray[np.float64]

ARRAYS = "coefficients", "gains", "coupling", "variance_px2", "predicted_px2"
"""Names of a filter's arrays."""
LAGS = 0, 8, 16, 24
"""Frames of the past by which modes predict others."""
_RIDGE = 1e-4  # of the variance of a mode
_LEAST_SIGNAL = 0.02  # of the noise, that the spectrum of a mode has at every frequency
_LEAST_DRIVING = 1e-9  # of the variance of a mode
_FREQUENCIES = 2**14  # in which the spectrum of an autoregression is factorised


class ModalPredictor:
    """Predict independent modes; the error of predictions and the gains are those of the usual noise.

    Parameters
    ----------
    arrays : mapping
        As from `modal_filter`.
    """

    def __init__(self, arrays: Mapping[str, Any]) -> None:
        self._coefficients, self._gains, self._coupling, self._noise_px2, self._predicted_px2 = (
            np.ascontiguousarray(arrays[name], np.float64) for name in ARRAYS
        )
        self._sources = len(self._coupling) // len(LAGS)
        self.std_px = np.sqrt(self._predicted_px2)
        """(m,): standard deviations of the prediction."""
        self.state = np.zeros_like(self._coefficients)
        """(order, m): modes of this frame and of those before it."""
        self._ahead: dict[int, Floats] = {}

    @property
    def mean_px(self) -> Floats:
        """(m,): predicted modes of the next frame."""
        return np.array(self.state[0])

    def ahead(self, frames: int) -> Floats:
        """Return (m,): the modes predicted for a number of frames after the current one."""
        own = (self.weights_ahead(frames) * self.state).sum(axis=0)
        return np.asarray(own + self.past(self._sources) @ self._coupling if self._sources else own)

    def past(self, sources: int) -> Floats:
        """Return (lags * sources,): the first modes as estimated now, of `LAGS` frames ago."""
        return np.asarray(self.state[list(LAGS), :sources].ravel())

    def weights_ahead(self, frames: int) -> Floats:
        """Return (order, m): weights of the state in the modes a number of frames later."""
        if frames not in self._ahead:
            weights = np.zeros_like(self.state)
            weights[0] = 1.0
            for _ in range(frames):
                first, weights = weights[0], np.vstack([weights[1:], np.zeros_like(weights[:1])])
                weights += first * self._coefficients
            self._ahead[frames] = weights
        return self._ahead[frames]

    def replies(self, frames: int) -> list[Any]:
        """Return how predicted modes answer to surprises, (m, m), for every set of gains: there is one."""
        own = sparse.diags((self.weights_ahead(frames) * self._gains).sum(axis=0)).tocsr()
        if not self._sources:
            return [own]
        replies = own.toarray()
        coupled = self._coupling.reshape(len(LAGS), self._sources, -1)
        replies[:, : self._sources] += np.einsum(
            "ls,lsm->ms", self._gains[list(LAGS), : self._sources], coupled
        )
        return [replies]

    def begin(self, slopes_px: Floats) -> None:
        """Restart from constant open-loop modes."""
        self.state[:] = slopes_px

    def surprise(self, difference_px: Floats, variance_px2: Floats) -> tuple[Floats, int]:
        """Return what modes differ from the prediction, 0 where not measured, and which gains to use."""
        return np.where(variance_px2 < LARGEST_VARIANCE_PX2, difference_px, 0.0), 0

    def failure(self, difference_px: Floats, variance_px2: Floats) -> float:
        """Return the mean square of what modes differ from the prediction, in its expected deviation."""
        measured = variance_px2 < LARGEST_VARIANCE_PX2
        squares = np.square(difference_px) / (self._predicted_px2 + variance_px2)
        return float(squares[measured].sum() / max(measured.sum(), 1))

    def correct(
        self, slopes_px: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """Update with the measured open-loop modes of this frame; infinite variance: invalid."""
        self.state += self._gains * self.surprise(slopes_px - self.state[0], variance_px2)[0]

    def advance(self) -> None:
        """Predict the next frame."""
        expected = (self._coefficients * self.state).sum(axis=0)
        self.state[1:] = self.state[:-1]
        self.state[0] = expected

    def matrices(self, frames: int) -> tuple[Floats, Floats, Floats, Floats]:
        """Return transition, correction, observation and modes so many frames ahead, of the flat state.

        Shapes: (states, states), (states, m) and twice (m, states).
        """
        order, m = self.state.shape
        onward = np.eye(order * m, k=-m)
        onward[:m] = _side_by_side(self._coefficients)
        observation, ahead = (_side_by_side(self.weights_ahead(k)) for k in (0, frames))
        for number, lag in enumerate(LAGS if self._sources else ()):
            coupled = self._coupling[number * self._sources : (number + 1) * self._sources]
            ahead[:, lag * m : lag * m + self._sources] += coupled.T
        return onward, _side_by_side(self._gains).T, observation, ahead


def modal_shapes(arrays: Mapping[str, Floats], modes: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes that the arrays of a filter of so many modes have; other ones are damaged."""
    rows, coupled = (len(np.atleast_1d(arrays[name])) for name in ("coefficients", "coupling"))
    sources = min(coupled // len(LAGS), modes) if rows > LAGS[-1] else 0
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("coefficients", "gains"), (rows, modes))
    return shapes | {"coupling": (max(len(LAGS) * sources, 1), modes), "predicted_px2": (modes,)}


def _side_by_side(values: Floats) -> Floats:
    """Return diagonal matrices side by side, (m, order m), of values (order, m)."""
    return np.hstack([np.diag(row) for row in values])


def modal_filter(power: Floats, noise_px2: Floats, orders: ArrayLike, rows: int = 0) -> dict[str, Floats]:
    """Return the arrays of a `ModalPredictor` of modes that are independent of each other.

    The spectrum without its noise gives autocovariances, these an autoregression (Yule-Walker). The gains of
    the steady state follow from the factor of the spectrum, noise included, that is causal with its inverse
    (Kailath, Sayed & Hassibi 2000, Linear Estimation, chapter 8), by its cepstrum.

    Parameters
    ----------
    power : (frequencies, m) array
        Power spectra of modes at all frequencies of a discrete Fourier transform, half of them negative;
        white noise has its variance.
    noise_px2 : (m,) array
        Variance of the white noise.
    orders : int or (m,) array of int
    rows : int
        Frames of the past in the state, if more than the largest order.

    Returns
    -------
    dict
        coefficients, gains (rows or largest order, m); coupling (1, m): none; variance_px2, predicted_px2
        (m,): of noise, and of the prediction's error.
    """
    of_modes = np.broadcast_to(orders, noise_px2.shape)
    rows = max(rows, int(of_modes.max()))
    coefficients, gains = np.zeros((2, rows, len(of_modes)))
    predicted = np.zeros(len(of_modes))
    for mode, (spectrum, noise, order) in enumerate(zip(power.T, noise_px2, of_modes, strict=True)):
        moments = np.fft.ifft(np.maximum(spectrum - noise, _LEAST_SIGNAL * noise)).real[: order + 1]
        lags = moments[:-1] + _RIDGE * moments[0] * np.eye(1, order)[0]
        weights = solve_toeplitz(lags, moments[1:])
        driving = max(float(moments[0] - weights @ moments[1:]), _LEAST_DRIVING * float(moments[0]))
        signal = driving / np.abs(np.fft.fft(np.append(1.0, -weights), _FREQUENCIES)) ** 2
        cepstrum = np.fft.ifft(np.log(signal + noise)).real
        total = math.exp(cepstrum[0])
        cepstrum[_FREQUENCIES // 2 :] = cepstrum[0] = 0.0
        factor = np.exp(np.fft.fft(cepstrum))
        coefficients[:order, mode], predicted[mode] = weights, max(total - noise, 0.0)
        gains[:, mode] = np.fft.fft(signal / factor.conj()).real[:rows] / _FREQUENCIES / total
    uncoupled = np.zeros((1, len(of_modes)))
    return dict(zip(ARRAYS, (coefficients, gains, uncoupled, noise_px2, predicted), strict=True))


def prediction_errors(arrays: Mapping[str, Floats], modes: Floats, frames: int) -> Floats:
    """Return modes minus their prediction a number of frames before, (frames, m); the state begins at 0.

    Parameters
    ----------
    arrays : mapping
        Of modes that are independent of each other.
    modes : (frames, m) array
        Open-loop modes.
    frames : int
        At least 1.
    """
    predictor, order = ModalPredictor(arrays), len(arrays["gains"])
    later = [(predictor.weights_ahead(k) * arrays["gains"]).sum(axis=0) for k in range(1, order + frames + 1)]
    replies = np.vstack([np.ones(modes.shape[1]), later])  # of predictions so many frames ahead to a surprise
    errors = modes.copy()
    for mode, values in enumerate(modes.T):
        whitening = np.append(1.0, -arrays["coefficients"][:, mode])
        surprises = np.convolve(whitening, replies[:, mode])[: order + 1]
        ahead = np.convolve(whitening, replies[frames:, mode])[:order]
        errors[frames:, mode] -= lfilter(ahead, surprises, values)[:-frames]
    return errors
