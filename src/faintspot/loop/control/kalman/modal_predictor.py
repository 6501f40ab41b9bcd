"""Kalman filters of modes: autoregressions seen through white noise; guarded control of large sensors.

What the past of the strongest modes tells beyond that of each mode is added to its prediction: turbulence
that the wind carries is in some modes before it is in others. No geometry of the sensor is known.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.linalg import solve_toeplitz

from faintspot.base.arrays import Floats
from faintspot.loop.control.base import CommandDelayLine, ExpectedSlopes, without_prior
from faintspot.loop.control.integrator import LoopPlant, SlopeProduct
from faintspot.loop.control.kalman.guard import SURPRISE
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.kalman.local_predictor import LocalPredictor
from faintspot.loop.control.kalman.predictor import LARGEST_VARIANCE_PX2
from faintspot.slopes.kernels.products import ProductPart

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
        errors[frames:, mode] -= scipy.signal.lfilter(ahead, surprises, values)[:-frames]
    return errors


_LEARNT, _PLAIN = range(2)


class _Frame(NamedTuple):
    """A frame's slopes, and those that commands of both lines cause."""

    open_loop: Floats
    surprise: Floats
    """Open-loop slopes minus their prediction."""
    variance: Floats
    trust: Floats
    by_learnt: Floats
    by_plain: Floats
    by_latest_plain: Floats

    @property
    def residuals(self) -> tuple[Floats, Floats]:
        """Residual slopes that both controllers leave."""
        return self.trust * (self.open_loop + self.by_learnt), self.trust * (self.open_loop + self.by_plain)

    @property
    def missing(self) -> Floats:
        """Addition by the integrator's estimator to what it leaves, where it trusts its prior."""
        return (1 - self.trust) * (self.by_plain - self.by_latest_plain)


class LargeGuarded(GuardedController):
    """Guard of `Predictive` and the integrator, for large sensors and for modes.

    Reading matrices takes most of the time of a frame. They are kept in float32. The predictive command is
    linear in what the slopes differ from their prediction; the matrix of that is computed beforehand, and so
    is the command for slopes as predicted. When slopes arrive, one product is left, which can be begun while
    they are measured. Four more follow with the next frame, or when somebody asks what is expected.

    Parameters
    ----------
    line : CommandDelayLine
        To the mirror.
    plant : LoopPlant
    phase_of_commands : (commands, commands) array
        From commands to the compared amplitudes, see `phase.phase_of_commands`.
    arrays : mapping
        Of the filter, as from `local_filter` or `modal_filter`.
    plain_gain : float
        Of the integrator.
    options
        As for `GuardedController`.
    """

    settle_frames = 0  # a frame has no time for two filters

    def __init__(
        self,
        line: CommandDelayLine,
        plant: LoopPlant,
        phase_of_commands: Floats,
        arrays: Mapping[str, Any],
        plain_gain: float,
        **options: Any,
    ) -> None:
        interaction, reconstructor = plant.interaction, plant.reconstructor
        super().__init__(line, interaction, **options)
        self._predictor = LocalPredictor(arrays) if "around" in arrays else ModalPredictor(arrays)
        self._integrator = plant.integrator(plain_gain, self._lines[_PLAIN])
        self._product, self._reconstruct = SlopeProduct(interaction), SlopeProduct(reconstructor.matrix)
        self._clean, self._compare = SlopeProduct(reconstructor.clean), SlopeProduct(phase_of_commands)
        matrices = self._predictor.replies(line.delay_frames)
        self._replies = [SlopeProduct((matrix.T @ reconstructor.clean.T).T) for matrix in matrices]
        self._caused = np.zeros((2, len(line.rows), len(interaction)))
        """Slopes that the commands of both lines cause, row by row."""
        self._held, self._held_at = np.zeros(len(interaction)), -1
        """Slopes that the mirror adds."""
        self._mean, self._predicted = np.zeros((2, len(interaction)))
        """Predicted slopes of the open loop, and with what the mirror adds."""
        self._level = len(self._replies) // 2
        """Gains of the latest frame."""
        self._if_as_predicted = np.zeros(interaction.shape[1])
        """The predictive command for slopes as predicted."""
        self._frame: _Frame | None = None
        """The previous frame, while it is not complete."""
        self._restarted = True

    def set_plain_gain(self, gain: float) -> None:
        """See `GuardedController`."""
        self._integrator.gain = gain

    def expected(self) -> ExpectedSlopes:
        """See `Controller`."""
        self.complete()
        if self._chosen == _PLAIN:
            return ExpectedSlopes(self._held - self._of_latest(_PLAIN), None)
        return ExpectedSlopes(self._predicted, self._predictor.std_px)

    def begin(self) -> None:
        """See `Controller`; open-loop slopes are assumed to equal the mirror's correction."""
        super().begin()
        self._predictor.begin(-(self._interaction @ self.line.latest))
        self._frame, self._restarted = None, True

    def update(
        self, slopes_px: Floats, standard_error_px: Floats, covariance_xy_px2: Floats | None = None
    ) -> None:
        """See `Controller`; the gains have the usual covariances of x and y."""
        expected = self.expected().mean_px
        errors = self._errors_to_use(slopes_px, standard_error_px)
        slopes, variance, trust = without_prior(slopes_px, errors, expected, self.prior_std_px)
        caused = self._of_acting(_LEARNT), self._of_acting(_PLAIN), self._of_latest(_PLAIN)
        open_loop, surprise = slopes - self._held, slopes - self._predicted
        self._frame = frame = _Frame(open_loop, surprise, self._noise_factor * variance, trust, *caused)
        if self._chosen == _LEARNT:
            self._predict(frame)
        else:
            residual = trust * (slopes - (self._held - frame.by_plain))
            self._integrator.follow(self._reconstruct(residual + frame.missing))
        self._send()

    def begin_product(self, threads: int, scale: float) -> Sequence[ProductPart]:
        """See `Controller`; there are none before a frame is complete, and of estimators with a prior."""
        if self._frame is not None or self._held_at != self.line.next_row or self.prior_std_px is not None:
            return ()
        if self._chosen == _PLAIN:
            return self._reconstruct.parts(threads, scale, self._held - self._of_acting(_PLAIN))
        return self._replies[self._level].parts(threads, scale, self._predicted)

    def _predict(self, frame: _Frame) -> None:
        """Compute the predictive command."""
        surprise, self._level = self._predictor.surprise(frame.surprise, frame.variance)
        self._lines[_LEARNT].put(self._if_as_predicted - self._replies[self._level](surprise))

    def complete(self) -> None:
        """See `Controller`; also compute what does not need the slopes of the next frame."""
        frame, self._frame = self._frame, None
        if frame is not None:
            learnt, plain = self._compare.several(*self._follow_up(frame))
            self._guard["measures"][SURPRISE] = self._predictor.failure(frame.surprise, frame.variance)
            self._predictor.correct(frame.open_loop, frame.variance)
            self._predictor.advance()
            if self._choose(float(learnt @ learnt), float(plain @ plain)):
                self._caused[_PLAIN] = self._product.several(*self._lines[_PLAIN].rows)
        if frame is not None or self._restarted or self._held_at != self.line.next_row:
            self._follow_mirror(is_new=frame is not None or self._restarted)

    def _follow_up(self, frame: _Frame) -> Floats:
        """Compute the command that was not sent; return the wavefronts that both leave, as commands."""
        residuals, missing = frame.residuals, frame.missing
        if self._chosen == _PLAIN:
            self._predict(frame)
            return self._reconstruct.several(*residuals)
        if not missing.any():
            wavefronts = self._reconstruct.several(*residuals)
            self._integrator.follow(wavefronts[_PLAIN])
            return wavefronts
        wavefronts = self._reconstruct.several(*residuals, missing)
        self._integrator.follow(wavefronts[_PLAIN] + wavefronts[-1])
        return wavefronts[:-1]

    def _follow_mirror(self, *, is_new: bool) -> None:
        """Compute the slopes that commands cause and, if the latest are new, the prediction."""
        lines, mirror = self._lines, self.line
        commands = [line.latest for line in lines] if is_new else []
        equal = (k for k, line in enumerate(lines) if np.array_equal(line.acting, mirror.acting))
        followed = next(equal, None)
        if followed is None:
            commands.append(mirror.acting)
        new_slopes = self._product.several(*commands) if commands else np.zeros((0, 0))
        if is_new:
            for caused, line, newest in zip(self._caused, lines, new_slopes, strict=False):
                caused[slice(None) if self._restarted else line.next_row - 1] = newest
            self._restarted = False
            self._mean = self._predictor.mean_px
            open_loop = self._predictor.ahead(lines[_LEARNT].delay_frames) + self._of_latest(_LEARNT)
            self._if_as_predicted = lines[_LEARNT].latest - self._clean(open_loop)
        # Those of the mirror's own commands are the last, after those of both lines.
        self._held = new_slopes[-1] if followed is None else self._of_acting(followed)
        self._held_at, self._predicted = mirror.next_row, self._held + self._mean

    def _of_latest(self, line: int) -> Floats:
        """Return the slopes that the latest command of a line causes."""
        return np.asarray(self._caused[line, self._lines[line].next_row - 1])

    def _of_acting(self, line: int) -> Floats:
        """Return the slopes that the command of a line that acts in this frame causes."""
        rows = self._caused[line]
        return np.asarray(rows[(self._lines[line].next_row + 1) % len(rows)])
