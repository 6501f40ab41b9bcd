"""pyRTC's modal predictors on the slopes of any loop, with the matrix as calibrated or its gain corrected."""

import importlib.util
import itertools
from collections import deque
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from benchmarks.loops.foreign.base import Floats, ForeignLoop, Observed
from faintspot.loop.control.flattening import residual_phase
from faintspot.loop.control.reconstructor import make_reconstructor

GRIDS: dict[str, dict[str, tuple[Any, ...]]] = {
    "least_squares": {"order": (8, 16, 32, 64), "regularization": (1e-5, 1e-4, 1e-3, 1e-2, 1e-1)},
    "ar_kalman": {"noise_band": (0.05, 0.1, 0.2, 0.4, 0.6, 0.8)},
}
_GAINS = (0.3, 0.5, 0.7, 1.0)


def available() -> bool:
    """Return whether pyRTC is installed."""
    return importlib.util.find_spec("pyrtc") is not None


class Predicted:
    """Control that follows the predictions of a modal predictor."""

    def __init__(
        self, loop: ForeignLoop, centroid_gain: float, to_modes: Floats, predictor: Any, gain: float
    ) -> None:
        self._matrix, self._centroid_gain = loop.sign * loop.interaction, centroid_gain
        self._modes = make_reconstructor(self._matrix).modes
        self._to_modes, self._predictor, self._gain = to_modes, predictor, gain
        self._command = np.zeros(self._matrix.shape[1])
        self._waiting = deque(np.zeros((loop.delay_frames, len(self._command))))
        predictor.reset()

    def __call__(self, slopes: Floats) -> Floats:
        """Return the command to send."""
        open_loop = slopes / self._centroid_gain - self._matrix @ self._waiting.popleft()
        self._predictor.update(self._to_modes @ open_loop)
        wanted = self._modes @ np.asarray(self._predictor.predict(), np.float64)
        self._command = (1 - self._gain) * self._command - self._gain * wanted
        self._waiting.append(self._command)
        return self._command


def candidates(
    name: str, loop: ForeignLoop, learning: Observed, tuning: Observed, centroid_gain: float
) -> list[tuple[str, partial[Predicted]]]:
    """Return predictors with all options and gains, those first that leave the least phase in a replay."""
    matrix = loop.sign * loop.interaction
    phase = residual_phase(make_reconstructor(matrix).matrix, matrix, loop.cells)
    open_loop = _open_loop(loop, tuning, centroid_gain)
    made = [
        (_left(make(), open_loop, matrix, loop.delay_frames, centroid_gain, phase), label, make)
        for label, make in _predictors(name, loop, learning, centroid_gain)
    ]
    return [(label, make) for _, label, make in sorted(made, key=lambda item: item[0])]


def _open_loop(loop: ForeignLoop, observed: Observed, centroid_gain: float) -> Floats:
    late = np.zeros_like(observed.commands)
    late[loop.delay_frames :] = observed.commands[: -loop.delay_frames]
    open_loop: Floats = observed.slopes / centroid_gain - loop.sign * late @ loop.interaction.T
    return open_loop


def _predictors(
    name: str, loop: ForeignLoop, learning: Observed, centroid_gain: float
) -> Iterator[tuple[str, partial[Predicted]]]:
    from pyrtc.predictive import make_predictor  # type: ignore[import-untyped, unused-ignore]

    reconstructor = make_reconstructor(loop.sign * loop.interaction)
    to_modes = reconstructor.modes.T @ reconstructor.matrix
    history = _open_loop(loop, learning, centroid_gain) @ to_modes.T
    for values in itertools.product(*GRIDS[name].values()):
        options = dict(zip(GRIDS[name], values, strict=True))
        chosen = {"type": name, "horizon": loop.delay_frames, **options}
        predictor = make_predictor(chosen, len(to_modes)).fit(history)
        for gain in _GAINS:
            yield (
                f"{options}, gain {gain:g}",
                partial(Predicted, loop, centroid_gain, to_modes, predictor, gain),
            )


def _left(
    control: Predicted, open_loop: Floats, matrix: Floats, delay: int, centroid_gain: float, phase: Floats
) -> float:
    """Return the mean squared phase in a replay of open-loop slopes."""
    waiting, total = deque(np.zeros((delay, matrix.shape[1]))), 0.0
    for number, slopes in enumerate(open_loop):
        residual = slopes + matrix @ waiting.popleft()
        if number >= len(open_loop) // 4:
            total += float(np.square(phase @ residual).sum())
        waiting.append(control(centroid_gain * residual))
    return total if np.isfinite(total) else np.inf
