"""Table [control] of faintspot.toml: controller, matrices and limits; their form in recordings."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array
from faintspot.base.errors import InputError, errors_within
from faintspot.base.tables import Tables, save_tables
from faintspot.base.text_files import check_keys
from faintspot.loop.control.base import CONTROLS, INTEGRATOR, KALMAN, CommandDelayLine, Controller
from faintspot.loop.control.integrator import CompiledIntegrator
from faintspot.loop.control.options import (
    BEYOND_ALL,
    CONTROLLER,
    NONE,
    STREAM,
    TABLE,
    TIP_TILT_FOCUS,
    ControlOptions,
)
from faintspot.loop.control.reconstructor import Reconstructor, make_reconstructor
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.configuration import Configuration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from faintspot.loop.control.identification.model import Kalman
    from faintspot.loop.control.integrator import LoopPlant
    from faintspot.loop.control.removed_modes import RemovedModes


INTERACTION, REFERENCE = "interaction_matrix", "reference_slopes"
MODEL = "model"
FILES = (INTERACTION, REFERENCE, MODEL)
PRIOR = "prior_std_px"
_LARGEST_SLOPE_PX = 1e4


@dataclass(frozen=True, eq=False)
class Control:
    """Controller, matrices and limits with which an engine computes commands; checked on creation.

    Parameters
    ----------
    interaction : (2 n, commands) array
        Slopes [px] (all x, then all y) that one unit of each command adds.
    reference : (2 n,) or (n, 2) array, optional
        Reference slopes [px] from each sub-aperture's centre. Default: 0.
    options : ControlOptions
    model : path, optional
        Learnt model of the controller, a file written by `Kalman.save`. The integrator ignores it.
    positions : (n, 2) array, optional
        x and y of the sub-apertures in any unit, if focus is removed from the slopes.

    Raises
    ------
    InputError
        If the model or the shapes do not fit, numbers are not finite, or the slopes cannot control the
        mirror.
    """

    interaction: Any
    reference: Any = None
    options: ControlOptions = field(default_factory=ControlOptions)
    model: Any = None
    positions: Any = None

    def __post_init__(self) -> None:
        matrix = finite_array(INTERACTION, self.interaction).astype(np.float64)
        if matrix.ndim != 2 or len(matrix) % 2:
            raise InputError(f"expected shape (2 n, commands), got {matrix.shape}", name=INTERACTION)
        if matrix.shape[1] > len(matrix):
            raise InputError(
                f"expected (2 n, commands), no more commands than slopes, got {matrix.shape}",
                name=INTERACTION,
            )
        reference = self.reference
        if reference is not None:
            reference = finite_array(REFERENCE, reference).astype(np.float64)
            if reference.shape == (len(matrix) // 2, 2):
                reference = reference.T.reshape(-1)
            check_shape(REFERENCE, reference, (len(matrix),))
            if np.abs(reference).max() > _LARGEST_SLOPE_PX:
                raise InputError(f"expected positions up to {_LARGEST_SLOPE_PX:g} px", name=REFERENCE)
        object.__setattr__(self, "interaction", matrix)
        object.__setattr__(self, "reference", reference)
        _ = self.reconstructor  # refuses a matrix that cannot be inverted
        object.__setattr__(self, "model", self._checked_model())

    def _checked_model(self) -> object:
        kind = self.options.controller
        if self.removed_modes and kind != INTEGRATOR:
            raise InputError(
                f"expected an integrator, as the model of {kind!r} has all modes",
                name="removed_modes",
                value=self.removed_modes.name,
            )
        if kind == KALMAN and self.options.prediction == STREAM:
            raise InputError(
                'expected "controller", as a Kalman filter predicts itself', name="prediction", value=STREAM
            )
        if kind == INTEGRATOR:
            return self.model  # kept for `with_controller`
        if self.model is None:
            raise InputError(f"expected a file with the model of {CONTROLS[kind]}, got none", name=MODEL)
        from faintspot.loop.control.identification.model import Kalman  # an integrator needs no filters

        model = self.model
        if not isinstance(model, Kalman):
            model = Kalman.load(model, self.plant)
        model.check(self.plant)
        return model

    @cached_property
    def removed_modes(self) -> RemovedModes:
        """Modes that are removed from the slopes before reconstruction."""
        from faintspot.loop.control.removed_modes import RemovedModes  # a recording's control needs none

        return RemovedModes(self.options.removed_modes, self.positions)

    @cached_property
    def controlled(self) -> Floats:
        """Interaction matrix without the removed modes, whose reconstructor does not drive them."""
        return self.removed_modes.removed(self.interaction)

    @cached_property
    def reconstructor(self) -> Reconstructor:
        """Reconstructor from slopes to the commands that cause them."""
        return make_reconstructor(self.controlled, self.options.largest_condition)

    @property
    def plant(self) -> LoopPlant:
        """Loop properties that learnt controllers use."""
        from faintspot.loop.control.integrator import LoopPlant  # an integrator needs no replays

        options = self.options
        return LoopPlant(self.controlled, self.reconstructor, options.delay_frames, options.leak)

    @property
    def centroid_gain(self) -> float:
        """Centroid gain by which slopes are divided: the configured one times that in a learnt model."""
        learnt = 1.0 if self.options.controller == INTEGRATOR else float(self.model.centroid_gain)
        return self.options.centroid_gain * learnt

    @property
    def prediction(self) -> str:
        """Source of predictions: NONE, CONTROLLER or STREAM."""
        usual = CONTROLLER if self.options.controller == KALMAN else NONE
        return self.options.prediction or usual

    def with_controller(self, kind: str) -> Control:
        """Return the same configuration with another controller.

        Raises
        ------
        InputError
            If the model belongs to another controller.
        """
        if kind == self.options.controller:
            return self
        return replace(self, options=self.options.replaced({"controller": kind}))

    def with_model(self, model: Kalman) -> Control:
        """Return the same configuration with a learnt controller.

        Raises
        ------
        InputError
            If the model belongs to another loop.
        """
        return replace(self, options=self.options.replaced({"controller": KALMAN}), model=model)

    @property
    def commands(self) -> int:
        """Number of commands."""
        return int(self.interaction.shape[1])

    def check_fits(self, n: int) -> None:
        """Check the number of sub-apertures against the interaction matrix.

        Raises
        ------
        InputError
            If it differs.
        """
        slopes = len(self.interaction)
        if slopes != 2 * n:
            raise InputError(
                f"{TABLE}.{INTERACTION}: expected {2 * n} rows for {n} sub-apertures (all x, then all y), "
                f"got {slopes}"
            )

    def check_errors(self, calibration: Calibration, kind: str | None = None) -> None:
        """Refuse a camera without read noise if the controller needs standard errors of the slopes.

        Parameters
        ----------
        calibration : Calibration
        kind : str, optional
            Of the controller. Default: the one that is set.

        Raises
        ------
        InputError
            It says what is missing.
        """
        kind = kind or self.options.controller
        if kind == KALMAN and calibration.read_noise_photoelectrons is None:
            raise InputError(
                f"{TABLE}.controller = {kind!r}: expected standard errors of the slopes, which need the "
                "camera's read noise: calibration.read_noise_e"
            )

    def line(self) -> CommandDelayLine:
        """Return the delay line of commands to a flat mirror."""
        options = self.options
        return CommandDelayLine(self.commands, options.delay_frames, options.largest_command or BEYOND_ALL)

    def controller(self, line: CommandDelayLine) -> Controller:
        """Return the controller, which sends its commands along `line`."""
        options, matrix = self.options, self.reconstructor.matrix
        if options.controller == INTEGRATOR:
            return CompiledIntegrator(line, self.controlled, matrix, options.gain, options.leak)
        learnt: Controller = self.model.guarded(self.plant, line)
        return learnt

    def rehearse(self) -> None:
        """Compile the controller and run it on test frames, the last without a valid slope.

        Raises
        ------
        InputError
            When its commands, or the slopes that it expects, are not finite numbers.
        """
        slopes_px = np.resize([1.0, -1.0], len(self.interaction))
        line = self.line()
        try:
            with np.errstate(all="ignore"):
                controller = self.controller(line)
                for error_px in (0.1, 1.0, np.inf):
                    controller.update(slopes_px * np.isfinite(error_px), np.full_like(slopes_px, error_px))
                    expected = controller.expected()
                finite_array("expected slopes", expected.mean_px)
                if expected.std_px is not None:
                    finite_array("their errors", expected.std_px)
        except (ArithmeticError, ValueError) as error:  # also of NumPy's linear algebra, and InputError
            reason = str(error).split("\n")[0]
            raise InputError(
                f"{TABLE}.controller = {self.options.controller!r}: cannot compute commands with these "
                f"{INTERACTION} and {MODEL} ({reason}); measure the matrix, or learn the model, again"
            ) from None


def prior_std_px(settings: Settings, layout: Layout) -> Floats | None:
    """Return the standard deviations of an estimator's prior, (2 n,); None without a prior."""
    if not settings.estimator.takes_prior or PRIOR not in settings.declared():
        return None
    std_px = settings.values(PRIOR, len(layout), layout.pixels).astype(np.float64)
    return np.tile(std_px, 2) if np.isfinite(std_px).all() else None


def load_control(configuration: str | Path | Configuration) -> Control | None:
    """Read [control] of a configuration file and the files that it names; None without such a table.

    Raises
    ------
    InputError
        When something cannot be read, is unknown or does not fit.
    """
    if not isinstance(configuration, Configuration):
        configuration = Configuration(configuration)
    if TABLE not in configuration:
        return None
    with errors_within(configuration.path):
        return _of_table(configuration, configuration[TABLE])


def _of_table(configuration: Configuration, values: Mapping[str, Any]) -> Control:
    declared, path = ControlOptions.declared(), configuration.path
    check_keys(f"{TABLE}.", values, [*FILES, *declared], required=[INTERACTION])
    arrays = {name: _read(path, name, values[name]) for name in FILES[:2] if name in values}
    model = values.get(MODEL)
    if model is not None and not isinstance(model, str):
        raise InputError(f"expected the name of a file, found {model!r:.80}", name=f"{TABLE}.{MODEL}")
    options = ControlOptions(**{name: value for name, value in values.items() if name in declared})
    centres = configuration.layout.centres if options.removed_modes == TIP_TILT_FOCUS else None
    file = None if model is None else path.parent / model
    with errors_within("", f"{TABLE}."):
        return Control(arrays[INTERACTION], arrays.get(REFERENCE), options, file, centres)


def _read(path: Path, name: str, location: object) -> NDArray[np.generic]:
    """Read an array from the file that the table names, relative to the configuration."""
    from faintspot.io.frames import read_array  # few configurations name matrices

    if not isinstance(location, str):
        raise InputError(f"expected the name of a file, found {location!r:.80}", name=f"{TABLE}.{name}")
    with errors_within(f"{TABLE}.{name}"):
        return read_array(f"{path.parent / location}")


def save_control(path: str | Path, **values: object) -> None:
    """Write values into [control] of a configuration file; the rest of the file stays.

    Raises
    ------
    InputError
        When the file exists and cannot be understood, or cannot be written.
    """
    path = Path(path)
    before = Tables(path).tables.get(TABLE, {}) if path.exists() else {}
    save_tables(path, {TABLE: {**before, **values}})


_MOST_BYTES = 1 << 20
_SHAPE, _TYPE = "shape", "<f4"


class RecordedControl(NamedTuple):
    """Control as a recording describes it."""

    interaction: NDArray[np.float64]
    """(2 n, commands): slopes [px] that one unit of each command adds."""
    options: ControlOptions


def packed_control(control: Control | None) -> dict[str, Any] | None:
    """Return matrix and options as JSON values; None without control, or if they exceed 1 MiB."""
    if control is None or control.interaction.size * np.dtype(_TYPE).itemsize > _MOST_BYTES:
        return None
    text = base64.b64encode(control.interaction.astype(_TYPE).tobytes()).decode()
    return {INTERACTION: text, _SHAPE: list(control.interaction.shape), **control.options.chosen()}


def unpacked_control(attributes: Mapping[str, Any]) -> RecordedControl | None:
    """Return the control from the attributes of a recording; None where it is not recorded.

    Raises
    ------
    InputError
        When it is damaged.
    """
    if not attributes.get(TABLE):
        return None
    try:
        options = dict(attributes[TABLE])
        values = np.frombuffer(base64.b64decode(options.pop(INTERACTION), validate=True), _TYPE)
        matrix = values.reshape(options.pop(_SHAPE)).astype(np.float64)
        return RecordedControl(matrix, ControlOptions(**options))
    except (KeyError, TypeError, ValueError) as error:  # InputError is a ValueError
        raise InputError(f"{TABLE}: the recorded control is damaged ({error})") from None
