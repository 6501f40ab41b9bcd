"""Recorded loop: frames of slopes and commands in any unit and of either sign, and the system they are of."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import (
    check_shape,
    finite_array,
    increasing,
    number_between,
    numbers_between,
    real_array,
    strings_of,
)
from faintspot.base.errors import InputError, drawn
from faintspot.base.options import Option
from faintspot.loop.slope_covariance import SlopeTurbulence

OFFSETS = "reference_slopes", "flat_command"
_OF_SLOPES = {
    **dict.fromkeys(("slopes", "interaction_matrix", "standard_errors", "prior_std", "reference_slopes"), 1),
    "covariance_xy": 2,
}
"""Arrays in the unit of the slopes, and its power."""
_MOST_CELLS = 1000  # rows or columns of the lenslet array
_LARGEST = 1e30  # whose square is a number


def _number(meaning: str, unit: str, low: float, high: float, *, whole: bool = False) -> Option:
    return Option(meaning, unit, low, high, whole=whole, per_subaperture=False, optional=True)


NUMBERS = {
    "frame_rate_hz": _number("Frame rate.", "Hz", 1e-3, 1e6),
    "subaperture_m": _number("Side of a sub-aperture.", "m", 1e-3, 100.0),
    "diameter_m": _number("Diameter of the pupil.", "m", 1e-4, 1000.0),
    "pixel_scale_arcsec": _number("Angle of one unit of the slopes.", "arcsec", 1e-9, 1e9),
    "delay_frames": _number("Delay of the loop.", "frames", 1e-3, 100.0),
    "largest_command": _number("Limit of a command.", "", 1e-30, 1e30),
    "gain_error": _number("Relative error of the centroid gain of an open loop.", "", 1e-6, 10.0),
    "outer_scale_m": _number("Outer scale of the turbulence.", "m", 1e-2, 1e6),
    "science_wavelength_m": _number("Wavelength of the Strehl ratio.", "m", 1e-8, 1e-3),
    "command_sign": _number("1: commands add to the slopes; -1: they are subtracted.", "", -1, 1, whole=True),
    "sent_after_frames": _number("Frames from a command's slopes to its row.", "", 0, 100, whole=True),
}
"""Numbers that describe a recording, by name."""


@dataclass(frozen=True, eq=False, repr=False)
class LoopFrames:
    """Values of each frame of a recorded loop; None if unknown."""

    slopes: Any
    """(frames, 2 n): residual slopes in any unit, all x, then all y; NaN (or infinite) where not measured.
    Without `cells`, (frames, m) in any order."""
    commands: Any
    """(frames, commands): one row for each frame; see `sent_after_frames`."""
    _: KW_ONLY
    frame: Any = None
    """(frames,): number of each frame; missing ones were lost. Default: none was lost."""
    standard_errors: Any = None
    """(frames, 2 n): of the slopes. Default: their noise is measured, the same in all frames."""
    covariance_xy: Any = None
    """(frames, n): covariance of the errors of x and y. Default: 0."""
    flux: Any = None
    """(frames, n): flux of each sub-aperture, any unit. Default: not recorded."""


@dataclass(frozen=True, eq=False, repr=False)
class LoopSystem:
    """Sensor, mirror and timing of a recorded loop; None if unknown."""

    interaction_matrix: Any
    """(2 n, commands): slopes for a unit of each command, in the unit of `slopes`."""
    cells: Any
    """(n, 2): row and column of each sub-aperture in the lenslet array; or a mask of the array. None: a
    sensor without sub-apertures (tip-tilt, pyramid, modes), or of unknown geometry."""
    frame_rate_hz: float
    _: KW_ONLY
    subaperture_m: float | None = None
    pixel_scale_arcsec: float | None = None
    """Angle of one unit of `slopes`; only r0 and lengths in nm depend on it."""
    delay_frames: float | None = None
    """The command computed from frame k acts first during frame k + delay. Default: measured."""
    sent_after_frames: int | None = None
    """Row k holds the command computed from frame k minus this: 0 before a delay line, more after it.
    Default: found from the steps of the commands, which follow the slopes."""
    command_sign: float | None = None
    """1 where commands add to the slopes of the turbulence, -1 where they are subtracted. Default: found."""
    prior_std: Any = None
    """(2 n,): width of the estimator's prior, of which the slopes have been freed. Default: it had none."""
    reference_slopes: Any = None
    """(2 n,): slopes at which the loop holds. Default: the mean of a closed loop if clearly not 0."""
    flat_command: Any = None
    """(commands,): command about which the mirror is controlled. Default: as of the reference slopes."""
    largest_command: float | None = None
    """Limit of all commands as recorded, either way."""
    gain_error: float | None = None
    """Relative error of the centroid gain of an open loop, which is 1. Default: 0."""
    outer_scale_m: float | None = None
    science_wavelength_m: float = 1.65e-6
    is_closed: bool = True
    slope_unit: str = ""
    unit: float = 1.0
    """Number of `slope_unit` in a unit of `slopes`."""

    def __post_init__(self) -> None:
        values: dict[str, Any] = {
            name: declared.checked(name, getattr(self, name))
            for name, declared in NUMBERS.items()
            if hasattr(self, name)
        }
        if values["command_sign"] == 0:
            raise InputError("expected 1 or -1", name="command_sign", value=0)
        for name in ("frame_rate_hz", "science_wavelength_m"):
            if values[name] is None:
                raise InputError("expected a number", name=name, value=None)
        values["unit"] = number_between("unit", self.unit, 1 / _LARGEST, _LARGEST)
        if not isinstance(self.is_closed, bool | np.bool_):
            raise InputError("expected true or false", name="is_closed", value=self.is_closed)
        values["interaction_matrix"] = _matrix("interaction_matrix", self.interaction_matrix)
        values["prior_std"] = _array("prior_std", self.prior_std, is_positive=True)
        values |= {name: _array(name, getattr(self, name), is_finite=True) for name in OFFSETS}
        vars(self).update(values)

    @property
    def site(self) -> SlopeTurbulence:
        """Geometry; an unknown pixel scale is 1 arcsec, an unknown sub-aperture the unit of length."""
        unit = "m" if self.subaperture_m else "sub-apertures"
        side, scale = self.subaperture_m or 1.0, self.pixel_scale_arcsec or 1.0
        return SlopeTurbulence.unmeasured(self.cells, side, scale, self.outer_scale_m, unit)

    def scaled(self, unit: float) -> Self:
        """Return the same with slopes in another unit, so many of the present one."""
        arrays = {name: getattr(self, name, None) for name in _OF_SLOPES}
        scaled = {
            name: array / unit ** _OF_SLOPES[name] for name, array in arrays.items() if array is not None
        }
        scale = self.pixel_scale_arcsec
        scaled["pixel_scale_arcsec"] = None if scale is None else scale * unit
        return replace(self, unit=self.unit * unit, **scaled)


@dataclass(frozen=True, eq=False, repr=False)
class Recording(LoopSystem, LoopFrames):
    """Slopes and commands of consecutive frames of a loop, and its system; None if unknown.

    With `cells`, the slopes are those of n sub-apertures; without, any measurements of the wavefront, such as
    those of a pyramid.

    Raises
    ------
    InputError
        When shapes do not fit together or numbers are out of range.
    """

    _: KW_ONLY
    name: str = "recording"
    remarks: tuple[str, ...] = ()
    """Assumptions made."""

    def __post_init__(self) -> None:
        super().__post_init__()
        slopes = _array("slopes", () if self.slopes is None else self.slopes, dimensions=2)
        slopes[np.isinf(slopes)] = np.nan
        slopes = rows_of_slopes(slopes)
        if slopes.ndim != 2 or (slopes.shape[1] % 2 and self.cells is not None):
            expected = "(frames, 2 n)" if self.cells is not None else "(frames, m)"
            raise InputError(f"slopes: expected shape {expected}, got {slopes.shape}")
        frame = np.arange(len(slopes))
        if self.frame is not None:
            frame = increasing("frame", self.frame, len(slopes), integer=True)
        vars(self).update(
            slopes=slopes,
            commands=_matrix("commands", self.commands),
            frame=frame,
            standard_errors=_array("standard_errors", self.standard_errors, is_positive=True),
            covariance_xy=_array("covariance_xy", self.covariance_xy),
            flux=_array("flux", self.flux),
            cells=None if self.cells is None else cells_of(self.cells, slopes.shape[1] // 2),
            remarks=strings_of("remarks", self.remarks),
        )
        self._check_shapes()

    def _check_shapes(self) -> None:
        if self.commands is not None and len(self.commands) != len(self.slopes):
            raise InputError(
                f"commands: expected {len(self.slopes)} frames, as of the slopes, got {len(self.commands)}"
            )
        frames, slopes = self.slopes.shape
        for name in ("covariance_xy", "flux", "prior_std") if self.cells is None else ():
            if getattr(self, name) is not None:
                raise InputError(f"{name}: expected none without cells, got an array; give cells")
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("prior_std", "reference_slopes"), (slopes,))
        shapes |= dict.fromkeys(("covariance_xy", "flux"), (frames, slopes // 2))
        shapes |= {"standard_errors": (frames, slopes)}
        if self.commands is not None:
            shapes |= {"flat_command": self.commands.shape[1:]}
        for name, shape in shapes.items():
            if getattr(self, name) is not None:
                check_shape(name, getattr(self, name), shape)
        if self.commands is None or self.interaction_matrix is None:
            return
        expected, shape = (slopes, self.commands.shape[1]), self.interaction_matrix.shape
        if shape != expected:
            raise InputError(f"interaction_matrix: expected shape {expected}, got {shape}")

    def __repr__(self) -> str:
        """Return the numbers of frames, slopes and commands, the rate, and how many slopes were measured."""
        frames, slopes = self.slopes.shape
        state, unit = "closed" if self.is_closed else "open", self.slope_unit or "unit not stated"
        commands = "no" if self.commands is None else f"{self.commands.shape[1]}"
        return (
            f"Recording({self.name!r}, {state}, {frames} frames at {self.frame_rate_hz:.6g} Hz, {slopes} "
            f"slopes ({unit}), {np.isfinite(self.slopes).mean():.1%} measured, {commands} commands)"
        )

    def plot(self, axes: Any = None) -> Any:
        """Draw the noise of each sub-aperture's slopes, as the page of `faintspot telemetry` does.

        Parameters
        ----------
        axes : (2,) array of matplotlib Axes, optional
            Default: new ones.

        Returns
        -------
        (2,) array of Axes
            Of x and y.

        Raises
        ------
        InputError
            If the noise cannot be measured, or there are no cells.
        MissingExtraError
            If matplotlib is not installed.
        """
        return drawn("loop.telemetry.page:plot_recording", self, axes)

    def part(self, rows: slice | NDArray[np.bool_]) -> Recording:
        """Return some of the frames."""
        arrays = {item.name: getattr(self, item.name) for item in fields(LoopFrames)}
        return replace(self, **{name: array[rows] for name, array in arrays.items() if array is not None})

    @property
    def system(self) -> LoopSystem:
        """The same without frames."""
        return LoopSystem(**{item.name: getattr(self, item.name) for item in fields(LoopSystem)})


def _array(
    name: str, stated: Any, *, dimensions: int = 0, is_finite: bool = False, is_positive: bool = False
) -> Any:
    """Return an array of float64, or None; refuse numbers whose squares are not finite."""
    if stated is None:
        return None
    check = finite_array if is_finite else real_array
    array = check(name, stated, minimum_dimensions=dimensions).astype(np.float64)
    if is_positive and (array < 0.0).any():
        raise InputError(f"{name}: expected no negative numbers")
    sizes = np.abs(array)
    if (sizes[sizes < np.inf] > _LARGEST).any():
        raise InputError(f"{name}: expected numbers of at most {_LARGEST:g}")
    return array


def _matrix(name: str, stated: Any) -> Any:
    array = _array(name, stated, dimensions=2, is_finite=True)
    return None if array is None else array.reshape(len(array), -1)


def rows_of_slopes(slopes: Floats) -> Floats:
    """Return slopes of each frame in one row, all x, then all y where they are (n, 2) or (2, n)."""
    if slopes.ndim == 3 and slopes.shape[2] == 2 != slopes.shape[1]:
        slopes = slopes.swapaxes(1, 2)
    return slopes.reshape(len(slopes), -1) if slopes.ndim > 2 else slopes


def cells_of(stated: object, n: int) -> NDArray[np.int64]:
    """Return row and column of n sub-apertures, from a list, a mask, or (None) a full square.

    Raises
    ------
    InputError
        When it is none of these.
    """
    if stated is None:
        side = round(n**0.5)
        if side * side != n:
            raise InputError(
                f"cells: expected row and column of the {n} sub-apertures; give them with --system"
            )
        return np.argwhere(np.ones((side, side)))
    cells = finite_array("cells", stated)
    if cells.shape == (n, 2):
        whole = numbers_between("cells", cells, -(2**31), 2**31, integer=True)
        if len(np.unique(whole, axis=0)) < n:
            raise InputError("cells: expected another row or column for each sub-aperture, got one twice")
        if np.ptp(whole, axis=0).max() >= _MOST_CELLS:
            raise InputError(
                f"cells: expected at most {_MOST_CELLS} rows and columns, got {np.ptp(whole, axis=0) + 1}"
            )
        return whole
    if cells.ndim == 2 and max(cells.shape) <= _MOST_CELLS and np.count_nonzero(cells > 0) == n:  # a mask
        return np.argwhere(cells > 0)
    raise InputError(f"cells: expected shape ({n}, 2), or a mask with {n} sub-apertures, got {cells.shape}")
