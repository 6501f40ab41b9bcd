"""Modes that are removed from slopes before reconstruction: those that a laser guide star does not show."""

from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, one_of
from faintspot.base.errors import InputError
from faintspot.base.flags import UNMEASURED
from faintspot.loop.control.integrator import MEAN_SQUARE
from faintspot.loop.control.options import NO_MODES, REMOVED_MODES, TIP_TILT_FOCUS
from faintspot.slopes.kernels.compiling import Direct, compiled_with

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
    >>> from faintspot.loop.control.removed_modes import RemovedModes
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
    check_shape("positions", centred, ("n", 2))
    centred = centred - centred.mean(axis=0)
    size = float(np.abs(centred).max(initial=0.0))
    if not size > _LEAST_SPREAD:
        raise InputError("positions: expected sub-apertures at different places, to remove focus")
    focus: Floats = (centred / size).T.ravel()
    return focus
