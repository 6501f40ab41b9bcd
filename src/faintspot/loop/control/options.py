"""Options of the table [control] of faintspot.toml, and modes that are removed from slopes."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, one_of
from faintspot.base.errors import InputError
from faintspot.base.flags import UNMEASURED
from faintspot.base.options import Options, setting
from faintspot.loop.control.base import CONTROLS, INTEGRATOR
from faintspot.loop.control.integrator import MEAN_SQUARE
from faintspot.slopes.kernels.compiling import Direct, compiled_with

Floats = NDArray[np.float64]

NO_MODES, TIP_TILT, TIP_TILT_FOCUS = "none", "tip_tilt", "tip_tilt_focus"
REMOVED_MODES = NO_MODES, TIP_TILT, TIP_TILT_FOCUS
_LEAST_SPREAD = 1e-9  # of the positions, relative to their size: less has no focus
_UNMEASURED = int(UNMEASURED)
_compiled = partial(compiled_with, source=__file__)


@_compiled
def _mean(values: Floats, flags: NDArray[np.uint8]) -> float:
    """Return the mean over valid sub-apertures; 0 without any."""
    total, valid = 0.0, 0
    for s in range(flags.shape[0]):
        if flags[s] & _UNMEASURED == 0:
            total += values[s]
            valid += 1
    return total / max(valid, 1)


@_compiled
def _remove(flags: NDArray[np.uint8], focus: Floats, slopes: Floats, statistics: Floats) -> None:
    """Subtract the modes, fitted to valid slopes by least squares; write the mean square that is left."""
    n = flags.shape[0]
    product, square, residual, valid = 0.0, 0.0, 0.0, 0
    for first in (0, n):
        middle = _mean(slopes[first : first + n], flags)
        curved = focus.shape[0] > 0
        centre = _mean(focus[first : first + n], flags) if curved else 0.0
        for s in range(n):
            if flags[s] & _UNMEASURED == 0:
                slopes[first + s] -= middle
                valid += 1
                if curved:
                    curvature = focus[first + s] - centre
                    product += curvature * slopes[first + s]
                    square += curvature * curvature
    amount = product / square if square > 0.0 else 0.0
    for first in (0, n):
        centre = _mean(focus[first : first + n], flags) if amount != 0.0 else 0.0
        for s in range(n):
            if flags[s] & _UNMEASURED == 0:
                if amount != 0.0:
                    slopes[first + s] -= amount * (focus[first + s] - centre)
                residual += slopes[first + s] * slopes[first + s]
    statistics[MEAN_SQUARE] = residual / max(valid, 1)


class RemovedModes:
    """Modes that are removed from the slopes before reconstruction.

    The beam of a laser guide star moves with the turbulence on its way up, so that the mean slope does not
    show the wavefront's tilt; the altitude of the sodium layer shows as focus. Both are fitted to the valid
    slopes of a frame and subtracted.

    Parameters
    ----------
    name : str
        One of `REMOVED_MODES`.
    positions : (n, 2) array, optional
        x and y of the sub-apertures in any unit, for focus.

    Raises
    ------
    InputError
        If the name is unknown, or focus is to be removed and positions are missing or all the same.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.loop.control.options import RemovedModes
    >>> modes = RemovedModes("tip_tilt_focus", [[-1, -1], [1, -1], [-1, 1], [1, 1]])
    >>> slopes = np.array([-1.0, 1.0, -1.0, 1.0, 2.0, 2.0, 4.0, 4.0]) + 5.0
    >>> modes.removed(slopes).round(12).tolist()
    [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """

    def __init__(self, name: str = NO_MODES, positions: ArrayLike | None = None) -> None:
        self.name = one_of("removed_modes", name, REMOVED_MODES)
        self._focus = _focus(positions) if name == TIP_TILT_FOCUS else np.zeros(0)
        self._kernel = Direct(_remove)

    def __bool__(self) -> bool:
        """Return whether any mode is removed."""
        return self.name != NO_MODES

    def remove(self, flags: NDArray[np.uint8], slopes: Floats, statistics: Floats) -> None:
        """Remove the modes from slopes of a frame, in place; those of invalid sub-apertures stay.

        Parameters
        ----------
        flags : (n,) uint8 array
            As in `faintspot.Slopes`.
        slopes : (2 n,) float64 array
            All x, then all y.
        statistics : (2,) float64 array
            Summary of `true_slopes`, whose mean square becomes that of the slopes that are left.
        """
        self._kernel(flags, self._focus, slopes, statistics)

    def removed(self, slopes: ArrayLike, flags: NDArray[np.uint8] | None = None) -> Floats:
        """Return slopes (2 n,), or a matrix (2 n, k) of them, without the modes.

        Parameters
        ----------
        slopes : (2 n,) or (2 n, k) array
        flags : (n,) uint8 array, optional
            Default: all sub-apertures are valid.
        """
        rows = np.array(slopes, np.float64).T
        if not self:
            return rows.T
        residual = np.ascontiguousarray(np.atleast_2d(rows))
        flags_ = np.zeros(residual.shape[1] // 2, np.uint8) if flags is None else flags
        for row in residual:
            self.remove(flags_, row, np.zeros(2))
        return residual.reshape(rows.shape).T


def _focus(positions: ArrayLike | None) -> Floats:
    """Return the slopes of focus (2 n,), in an arbitrary unit."""
    if positions is None:
        raise InputError("removed_modes: expected the positions of the sub-apertures, to remove focus")
    centred = finite_array("positions", positions).astype(np.float64)
    if centred.ndim != 2 or centred.shape[1] != 2:
        raise InputError(f"positions: expected shape (n, 2), got {centred.shape}")
    centred = centred - centred.mean(axis=0)
    size = float(np.abs(centred).max(initial=0.0))
    if not size > _LEAST_SPREAD:
        raise InputError("positions: expected sub-apertures at different places, to remove focus")
    focus: Floats = (centred / size).T.ravel()
    return focus


TABLE = "control"
NONE, CONTROLLER, STREAM = "none", "controller", "stream"
"""Sources of predictions."""
BEYOND_ALL = 1e30
"""Largest command without a limit: finite in float32, too."""


@dataclass(frozen=True, eq=False)
class ControlOptions(Options, table=TABLE):
    """Options of the table [control]."""

    controller: str = setting(
        INTEGRATOR,
        "Controller that turns slopes into commands; all but the integrator need a `model`.",
        choices=tuple(CONTROLS),
    )
    gain: float = setting(0.4, "Loop gain of the integrator.", low=0, high=2)
    leak: float = setting(0.01, "Fraction by which commands decay in each frame.", low=0, high=1)
    delay_frames: int = setting(
        2,
        "Delay: the command computed from frame k first acts during the exposure of frame k + delay_frames.",
        low=1,
        high=100,
        whole=True,
    )
    largest_command: float | None = setting(
        None,
        "Stroke limit, in the unit of the interaction matrix; clipped commands do not accumulate "
        "(anti-windup). Default: no limit.",
        low=0,
        high=BEYOND_ALL,
        low_open=True,
    )
    largest_condition: float = setting(
        30.0,
        "Largest condition number of the reconstructor: modes of the mirror with smaller singular values are "
        "not controlled.",
        low=1,
        high=1e6,
    )
    centroid_gain: float = setting(
        1.0,
        "Centroid gain relative to the interaction matrix; slopes are divided by it. 1 for a matrix measured "
        "with the same estimator at the same flux.",
        low=0.01,
        high=100,
    )
    removed_modes: str = setting(
        REMOVED_MODES[0],
        'Modes that slopes of a laser guide star do not show: "tip_tilt" or "tip_tilt_focus". They are '
        "removed before reconstruction and are not controlled; for integrators.",
        choices=REMOVED_MODES,
    )
    prediction: str | None = setting(
        None,
        'Source of the predicted slopes for estimators with a prior: "controller"; "stream", another program '
        'by the stream NAME_prediction; or "none". Default: "controller" for a Kalman filter, else "none".',
        choices=(NONE, CONTROLLER, STREAM),
    )
    learn_every_s: float = setting(
        10.0,
        "Time between two learnings of a Kalman filter while the engine runs, each from the telemetry since "
        "the one before; 0: never.",
        unit="s",
        low=0,
        high=3600,
    )
    guard_frames: int = setting(
        50,
        "Number of frames over which the guard averages.",
        low=1,
        high=1_000_000,
        whole=True,
    )
    most_invalid: float = setting(
        0.5,
        "Fraction of invalid slopes above which the guard opens the loop; 1: never.",
        low=0,
        high=1,
    )
    largest_residual_px: float | None = setting(
        None,
        "Rms of the slopes above which the guard opens the loop. Default: 1.25 times the open-loop rms, if "
        "the loop was open for `guard_frames` before; else a quarter of a window's side.",
        unit="px",
        low=0,
        high=BEYOND_ALL,
        low_open=True,
    )
    most_at_limit: float = setting(
        0.5,
        "Fraction of commands at `largest_command` above which the guard opens the loop; 1: never.",
        low=0,
        high=1,
    )
    proven_frames: int = setting(
        1000,
        "Number of frames after which a closed loop counts as proven. If the guard opens a proven loop, it "
        "closes it again after `guard_frames`, with a learnt controller's integrator; 0: never.",
        low=0,
        high=1_000_000,
        whole=True,
    )
