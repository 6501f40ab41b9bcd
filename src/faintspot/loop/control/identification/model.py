"""Model of the predictive Kalman filter, which can be saved to a file, and the controllers made from it."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from scipy import sparse

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.files import read_arrays, save_arrays, write_atomically
from faintspot.io.fits_units import write_images
from faintspot.loop.control.base import (
    KALMAN,
    CommandDelayLine,
    OpenLoopTelemetry,
    mean_residual,
    usual_noise,
)
from faintspot.loop.control.integrator import LoopPlant, settled
from faintspot.loop.control.kalman.compiled import CompiledKalman, Predictive
from faintspot.loop.control.kalman.guarded import GuardedController
from faintspot.loop.control.kalman.local_model import STEPS, slopes_ahead, state_of_state, state_of_surprise
from faintspot.loop.control.kalman.local_predictor import LocalPredictor, local_filter, local_shapes
from faintspot.loop.control.kalman.modal_predictor import ARRAYS as MODAL
from faintspot.loop.control.kalman.modal_predictor import LargeGuarded, ModalPredictor, modal_shapes
from faintspot.loop.control.kalman.predictor import MOST_SLOPES, SlopeModel, SlopePredictor, steady_covariance

if TYPE_CHECKING:
    from faintspot.loop.control.identification.layers import Identified


_LAYERS = "first", "second", "driving_px2"
_NOISE = "variance_px2", "covariance_xy_px2"
_LOCAL = "near", "around", "weights", "corrections", "variance_px2", "predicted_px2", "share"
_DENSE_FORM, _LOCAL_FORM, _MODAL_FORM = KALMAN, f"local {KALMAN}", f"modal {KALMAN}"
_FORMS = {_DENSE_FORM: (*_LAYERS, *_NOISE), _LOCAL_FORM: _LOCAL, _MODAL_FORM: MODAL}
"""Names in files, and the arrays of each."""
_NUMBERS, _GAIN = ("plain_gain", "noise_factor", "left", "phase_of_commands"), "centroid_gain"
_ANY, _COVARIANCE_PX2 = (-1e6, 1e6), (-1e8, 1e8)
_RANGES = {
    "plain_gain": (0.0, 2.0),
    "noise_factor": (1e-6, 1e6),
    _GAIN: (1e-3, 1e3),
    **dict.fromkeys(("first", "second", "weights", "corrections", *MODAL[:3]), _ANY),
    **dict.fromkeys(("driving_px2", "covariance_xy_px2"), _COVARIANCE_PX2),  # those of slopes of 1e4 px
    "variance_px2": (1e-12, 1e8),
    "predicted_px2": (0.0, 1e8),
    "share": (0.0, 1.0),
}
"""Accepted ranges of arrays; other values are damaged or in another unit, and products may overflow."""


@dataclass(frozen=True, eq=False)
class Kalman:
    """Kalman filter of open-loop slopes, learnt from telemetry, of frozen flow where winds were found.

    Its arrays are layers first, second, driving_px2 (layers, m, m), and the noise of slopes: variance_px2
    (m,) and covariance_xy_px2 (m / 2,). For large sensors, in which only near sub-apertures interact, they
    are those of `local_filter`, and for modes, in place of slopes, those of `modal_filter`.
    """

    arrays: Mapping[str, Floats]
    """Those of its form in files."""
    plain_gain: float
    """Gain of the fallback integrator."""
    noise_factor: float
    """Factor on the variances of standard errors."""
    left: tuple[float, float]
    """Residual phase variance of the filter and the integrator on the telemetry, noise included."""
    phase_of_commands: Floats
    """(commands, commands): matrix of the measure that compares both; see `phase_of_commands`."""
    description: str = ""
    centroid_gain: float = 1.0
    """Centroid gain of the slopes, by which they are divided before they come to the controller."""
    covariance: Floats | None = None
    """(states, states) px^2: as from `steady_covariance`, where it is known already."""
    identified: Identified | None = None
    """Turbulence that the model follows from; None for models read from a file."""

    def best_of(
        self,
        plant: LoopPlant,
        telemetry: OpenLoopTelemetry,
        fits: Sequence[Identified],
        progress: Callable[[int, int], None] | None = None,
    ) -> Kalman:
        """Return the filter of the turbulence that leaves least.

        Parameters
        ----------
        plant : LoopPlant
        telemetry : OpenLoopTelemetry
            Frames by which filters are compared.
        fits : sequence of Identified
            Turbulence as identified from all frames, in one way or several.
        progress : callable, optional
            Called with the steps done and their number while filters of many slopes are computed.
        """
        done, total = itertools.count(1), len(fits) * sum(steps for _, steps in STEPS)

        def advance() -> None:
            if progress is not None:
                progress(next(done), total)

        def with_filter(fit: Identified) -> Kalman:
            variance, covariance = usual_noise(telemetry.scaled(fit.noise_factor))
            if len(variance) > MOST_SLOPES:
                arrays = local_filter(fit.layers, 1 / fit.rate_hz, variance, advance, covariance)
            else:
                slopes = fit.slope_model()
                values = slopes.first, slopes.second, slopes.driving, variance, covariance
                arrays = dict(zip((*_LAYERS, *_NOISE), values, strict=True))
            text = f"{fit.summary()}, noise variance x {fit.noise_factor:.2f}"
            model = replace(
                self, arrays=arrays, noise_factor=fit.noise_factor, description=text, identified=fit
            )
            return model.scored(plant, telemetry)

        return min(map(with_filter, fits), key=lambda model: model.left[0])

    def controller(self, plant: LoopPlant, line: CommandDelayLine) -> Predictive:
        """Return the controller, in double precision."""
        filtered, clean = self.predictor(), plant.reconstructor.clean
        return Predictive(line, plant.interaction, filtered, clean, from_latest=self.is_local)

    def guarded(self, plant: LoopPlant, line: CommandDelayLine, **options: Any) -> GuardedController:
        """Return the compiled controller with the integrator beside it; options are those of the guard."""
        options |= {
            "noise_factor": self.noise_factor,
            "prefers_plain": self.left[1] < self.left[0],
            "plain_residual": self.left[1],
        }
        if self._is_dense:
            return self._compiled(plant, line, self.phase(plant), **options)
        return LargeGuarded(line, plant, self.phase_of_commands, self.arrays, self.plain_gain, **options)

    def _compiled(
        self, plant: LoopPlant, line: CommandDelayLine, phase: Floats, **options: Any
    ) -> CompiledKalman:
        return CompiledKalman(line, plant, phase, self.slope_predictor, self.plain_gain, **options)

    def replayed(self, plant: LoopPlant, telemetry: OpenLoopTelemetry, phase: Floats) -> Floats:
        """Return the squared residual that the filter would have left; see `replayed_frames`."""
        if not self._is_dense:
            return plant.replayed(partial(self.controller, plant), telemetry.scaled(self.noise_factor), phase)
        line = CommandDelayLine(plant.interaction.shape[1], plant.delay_frames)
        return self._compiled(plant, line, phase, noise_factor=self.noise_factor).replayed(telemetry)

    def phase(self, plant: LoopPlant) -> Floats:
        """Return the matrix (commands, m) from slopes to what is compared."""
        return np.asarray(self.phase_of_commands @ plant.reconstructor.matrix)

    def scored(self, plant: LoopPlant, telemetry: OpenLoopTelemetry) -> Kalman:
        """Return the filter with its residual on telemetry, and with the covariance that this needed."""
        squares = self.replayed(plant, telemetry, self.phase(plant))
        residual = mean_residual(squares, telemetry, settled(telemetry))
        covariance = self._covariance if self._is_dense else self.covariance
        return replace(self, left=(residual, self.left[1]), covariance=covariance)

    @property
    def is_local(self) -> bool:
        """Whether it is a filter for large sensors, in which only near sub-apertures interact."""
        return "around" in self.arrays

    @property
    def is_modal(self) -> bool:
        """Whether it is a filter of modes that are independent of each other."""
        return MODAL[0] in self.arrays

    @property
    def _is_dense(self) -> bool:
        return not (self.is_local or self.is_modal)

    @property
    def expected_std_px(self) -> Floats:
        """(m,): standard deviations of the predicted slopes."""
        return self.predictor().std_px

    def predictor(self) -> LocalPredictor | ModalPredictor | SlopePredictor:
        """Return the filter itself."""
        if self.is_modal:
            return ModalPredictor(self.arrays)
        return LocalPredictor(self.arrays) if self.is_local else self.slope_predictor

    @property
    def slope_predictor(self) -> SlopePredictor:
        """Filter of a small sensor."""
        return SlopePredictor(self._slopes, *self._noise, covariance=self._covariance)

    def with_noise(self, scale: float) -> Kalman:
        """Return the filter with the noise variances scaled by a factor."""
        if scale == 1.0:
            return self
        arrays = self.arrays
        if self._is_dense:  # others have gains for several variances, or one
            arrays = {**arrays, **{name: scale * arrays[name] for name in _NOISE}}
        text, factor = f"{self.description}, and {scale:g} of that", scale * self.noise_factor
        return replace(self, arrays=arrays, noise_factor=factor, description=text, covariance=None)

    @cached_property
    def _slopes(self) -> SlopeModel:
        return SlopeModel(*(self.arrays[name] for name in _LAYERS))

    @cached_property
    def _covariance(self) -> Floats:
        if self.covariance is not None:
            return self.covariance
        return steady_covariance(self._slopes, *self._noise)

    @property
    def _noise(self) -> tuple[Floats, Floats]:
        """Variances and covariances of the slopes' noise."""
        variance, covariance = (self.arrays[name] for name in _NOISE)
        return variance, covariance

    def save(self, path: str | Path, others: Mapping[str, object] = MappingProxyType({})) -> None:
        """Write the model to a NumPy file (.npz), with other arrays beside it.

        Raises
        ------
        InputError
            When it cannot be written.
        """
        numbers = {name: np.asarray(getattr(self, name), np.float64) for name in (*_NUMBERS, _GAIN)}
        form = _LOCAL_FORM if self.is_local else _MODAL_FORM if self.is_modal else _DENSE_FORM
        save_arrays(path, {"kind": np.array(form), **numbers, **self.arrays, **others})

    @classmethod
    def load(cls, path: str | Path, plant: LoopPlant) -> Self:
        """Read a model for a loop.

        Raises
        ------
        InputError
            When it cannot be read, is of another kind or loop, or has numbers out of range.
        """
        contents = "what control has learnt"
        own = _FORMS[one_of("kind", str(read_arrays(path, contents, ("kind",))["kind"]), list(_FORMS))]
        names = *_NUMBERS, *own, _GAIN
        numbers = _checked(read_arrays(path, contents, names, optional=(_GAIN,)), plant)
        learnt, plain = numbers["left"]
        return cls(
            {name: numbers[name] for name in own},
            float(numbers["plain_gain"]),
            float(numbers["noise_factor"]),
            (float(learnt), float(plain)),
            numbers["phase_of_commands"],
            centroid_gain=float(numbers.get(_GAIN, 1.0)),
        )

    def check(self, plant: LoopPlant) -> None:
        """Refuse a model of another loop, or with numbers out of range.

        Raises
        ------
        InputError
            One line.
        """
        numbers = {name: getattr(self, name) for name in (*_NUMBERS, _GAIN)}
        _checked({**self.arrays, **numbers}, plant)


def _checked(arrays: Mapping[str, object], plant: LoopPlant) -> dict[str, Floats]:
    """Return a model's arrays as float64, with checked shapes and ranges."""
    slopes, commands = plant.interaction.shape
    ranges = {**_RANGES, **dict.fromkeys(("near", "around"), (0, slopes // 2))}
    numbers = {name: numbers_between(name, value, *ranges.get(name, ())) for name, value in arrays.items()}
    shapes = {"left": (2,), "phase_of_commands": (commands, commands), "variance_px2": (slopes,)}
    if "around" in numbers:
        shapes |= local_shapes(numbers, slopes)
    elif MODAL[0] in numbers:
        shapes |= modal_shapes(numbers, slopes)
    else:
        layers = len(numbers["first"]) if numbers["first"].ndim == 3 else 1
        shapes |= {**dict.fromkeys(_LAYERS, (layers, slopes, slopes)), "covariance_xy_px2": (slopes // 2,)}
    for name, array in numbers.items():
        check_shape(name, array, shapes.get(name, ()))
    return numbers


Matrices = dict[str, Any]

_ENDINGS = (".npz", ".mat", ".fits")


def state_space(model: Kalman, plant: LoopPlant, scale: Floats | float, sign: float) -> Matrices:
    """Return the matrices of a frame's command and of the next state, without the guard.

    With the slopes s of a frame, the commands u that the mirror holds during it, and the state x, 0 first::

        command = command_of_state x + command_of_slopes s + command_of_mirror u
        x = state_of_state x + state_of_slopes s + state_of_mirror u

    Of a large sensor, with the latest command v, all matrices of state and surprise sparse::

        surprise = s - slopes_of_state x - slopes_of_mirror u
        command = v - command_of_ahead (ahead_of_state x + slopes_of_mirror v) + command_of_surprise surprise
        x = state_of_state (x + state_of_surprise surprise)

    Parameters
    ----------
    model : Kalman
    plant : LoopPlant
    scale : float, (2 n,) or (modes, m) array
        The model's slopes in a unit of s; or the matrix from s to modes.
    sign : float
        -1 where commands are subtracted from the turbulence.
    """
    predictor = model.predictor()
    if isinstance(predictor, LocalPredictor):
        return _sparse(model.arrays, plant, scale, sign)
    transition, gain, observation, ahead = predictor.matrices(plant.delay_frames)
    rest = np.eye(len(transition)) - gain @ observation
    command = -sign * plant.reconstructor.clean @ ahead
    matrices = {}
    for name, onward in (("command", command), ("state", transition)):
        answer = onward @ gain
        matrices[f"{name}_of_state"] = onward @ rest
        matrices[f"{name}_of_slopes"] = answer @ scale if np.ndim(scale) == 2 else answer * scale
        matrices[f"{name}_of_mirror"] = -sign * onward @ gain @ plant.interaction
    return matrices


def _sparse(arrays: Mapping[str, Floats], plant: LoopPlant, scale: Floats | float, sign: float) -> Matrices:
    """Return the matrices of a large sensor in float32, as its filter has them."""
    scale = np.broadcast_to(scale, len(plant.interaction))
    to_unit = sparse.diags(1 / scale).tocsr()
    ahead = slopes_ahead(arrays, plant.delay_frames)
    corrections = state_of_surprise(arrays) @ sparse.diags(scale).tocsr()
    clean = sign * plant.reconstructor.clean
    matrices = {
        "state_of_state": state_of_state(arrays),
        "state_of_surprise": corrections,
        "slopes_of_state": to_unit @ slopes_ahead(arrays, 0),
        "ahead_of_state": to_unit @ ahead,
        "slopes_of_mirror": sign * plant.interaction / scale[:, None],
        "command_of_ahead": scale * clean,
        "command_of_surprise": -((ahead @ corrections).T @ clean.T).T,
    }
    return {name: matrix.astype(np.float32) for name, matrix in matrices.items()}


def write_matrices(path: str | Path, arrays: Matrices) -> None:
    """Write arrays to a file whose ending says the format: .npz, .mat (MATLAB 5) or .fits (one image each).

    A sparse matrix NAME is one of MATLAB's, or has its compressed rows as NAME_data, NAME_indices,
    NAME_indptr and NAME_shape, for `scipy.sparse.csr_matrix`.

    Raises
    ------
    InputError
        When the ending is another one, or the file cannot be written.
    MissingExtraError
        When astropy is not installed, for FITS.
    """
    path = Path(path)
    if path.suffix == ".npz":
        save_arrays(path, _plain(arrays))
    elif path.suffix == ".mat":
        from scipy.io import savemat

        doubles = {name: array.astype(np.float64) for name, array in arrays.items()}  # all that MATLAB's have
        write_atomically(path, lambda stream: savemat(stream, doubles))
    elif path.suffix == ".fits":
        write_images(path, {name.upper(): array for name, array in _plain(arrays).items()})
    else:
        raise InputError(f"{path}: expected a name that ends in {', '.join(_ENDINGS)}")


def _plain(arrays: Matrices) -> Matrices:
    """Return the arrays with sparse ones in parts."""
    plain: Matrices = {}
    for name, array in arrays.items():
        if sparse.issparse(array):
            parts = {"data": array.data, "indices": array.indices, "indptr": array.indptr}
            parts["shape"] = np.array(array.shape)
            plain |= {f"{name}_{part}": values for part, values in parts.items()}
        else:
            plain[name] = array
    return plain
