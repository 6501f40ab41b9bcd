"""Reconstruction of commands from slopes and their noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, number_between
from faintspot.base.errors import InputError

LARGEST_CORRELATION = 0.99  # of x and y: a narrower ellipse is not known from one frame


def add_noise(matrix_px2: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None) -> None:
    """Add the covariance matrix of the slopes' noise, in place.

    Parameters
    ----------
    matrix_px2 : (2 n, 2 n) array
        All x, then all y; written.
    variance_px2 : (2 n,) array
    covariance_xy_px2 : (n,) array, optional
        Covariance of x and y of each sub-aperture. Default: 0.
    """
    every = np.arange(len(matrix_px2))
    matrix_px2[every, every] += variance_px2
    if covariance_xy_px2 is not None:
        x, y = np.split(every, 2)
        matrix_px2[x, y] += covariance_xy_px2
        matrix_px2[y, x] += covariance_xy_px2


def weighted_slopes(slopes: Floats, variance_px2: Floats, covariance_xy_px2: Floats | None = None) -> Floats:
    """Return the product of the inverse covariance matrix of the noise and columns of slopes, (2 n, k).

    Parameters
    ----------
    slopes : (2 n, k) array
    variance_px2 : (2 n,) array
        A slope whose variance is 0, infinite or NaN has no weight.
    covariance_xy_px2 : (n,) array, optional
        As for `add_noise`; correlations above 0.99 count as 0.99.
    """
    measured = np.isfinite(variance_px2) & (variance_px2 > 0)
    root = np.where(measured, 1 / np.sqrt(np.where(measured, variance_px2, 1.0)), 0.0)[:, None]
    scaled = root * slopes
    if covariance_xy_px2 is not None:
        (of_x, of_y), (x, y) = np.split(root, 2), np.split(scaled, 2)
        rho = np.clip(covariance_xy_px2[:, None] * of_x * of_y, -LARGEST_CORRELATION, LARGEST_CORRELATION)
        scaled = np.concatenate([x - rho * y, y - rho * x]) / np.tile(1 - rho**2, (2, 1))
    weighted: Floats = root * scaled
    return weighted


_LARGEST_ANSWER_PX = 1e-12, 1e12
"""Range of the largest element of an interaction matrix; its square is far from the limits of float64."""
_RIDGE = 3e-2  # of the mean square of the driven combinations' slopes: weak ones move less, noise does too
_RIDGE_CLEAN = 3e-3  # of slopes that a filter has freed of most of their noise
_RIDGE_OF_MANY = 11.0  # at most, divided by the number of combinations: low orders of many move slopes less


@dataclass(frozen=True, eq=False)
class Reconstructor:
    """Reconstructor from slopes to commands, for the modes that slopes can see."""

    matrix: Floats
    """(commands, 2 n): regularised least squares with equal weights."""
    modes: Floats
    """(commands, modes): controlled modes, orthonormal."""
    slopes_of_modes: Floats
    """(2 n, modes)"""
    clean: Floats
    """(commands, 2 n): as `matrix`, hardly regularised, for slopes with little noise."""
    damping: float = 0.0
    """Weight of the square of the command in what `clean` minimises, beside the squares of the slopes."""

    def __call__(self, slopes: Floats) -> Floats:
        """Return the commands in the unit of the interaction matrix."""
        return self.matrix @ slopes

    def weighted(self, slopes: Floats, standard_error: Floats, covariance_xy: Floats | None = None) -> Floats:
        """Return the commands by weighted least squares, weighted with the inverse covariance of the noise.

        Regularised like `matrix`, which it is where all errors are the same.

        Parameters
        ----------
        slopes, standard_error : (2 n,) array
            All x, then all y; a slope whose error is not finite or 0 does not count.
        covariance_xy : (n,) array, optional
            Covariance of x and y of each sub-aperture. Default: 0.
        """
        variance = np.square(standard_error)
        usable = np.isfinite(variance) & (variance > 0)
        if not usable.any():
            return np.zeros(len(self.modes))
        weighted = weighted_slopes(self.slopes_of_modes, variance, covariance_xy)
        weighted *= usable.size / np.sum(1 / variance[usable])  # as many slopes as without weights
        return self.modes @ (_estimator(self.slopes_of_modes, weighted) @ slopes)


def make_reconstructor(
    interaction: ArrayLike, largest_condition: float = 30.0, measured: NDArray[np.bool_] | None = None
) -> Reconstructor:
    """Return the reconstructor of an interaction matrix, by truncated and damped singular values.

    Parameters
    ----------
    interaction : (2 n, commands) array
        Slopes for a unit of each command.
    largest_condition : float
        Combinations whose slopes are smaller than the largest's by more than this are not driven: piston,
        what looks like waffle, and what tip-tilt mirror and actuators could do against each other.
    measured : (2 n,) array of bool, optional
        Slopes that `matrix` uses; `clean` is for predicted slopes and uses all. Default: all.

    Raises
    ------
    InputError
        When there are more commands than slopes, no command moves a slope, or the elements are too small or
        too large to compute with.
    """
    matrix: Floats = finite_array("interaction", interaction).astype(np.float64)
    check_shape("interaction", matrix, ("2 n", "commands"))
    slopes, commands = matrix.shape
    check_controllable(commands, slopes)
    limit = number_between("largest_condition", largest_condition, 1)
    largest, (smallest_px, largest_px) = np.abs(matrix).max(initial=0.0), _LARGEST_ANSWER_PX
    if largest == 0:
        raise InputError("interaction: expected slopes that follow the commands, got zeros only")
    if not smallest_px <= largest <= largest_px:
        raise InputError(
            f"interaction: expected a largest element of {smallest_px:g} to {largest_px:g} px for a unit of "
            f"the command, got {largest:.3g}; express the commands in another unit"
        )
    left, size, right = np.linalg.svd(matrix, full_matrices=False)
    driven = size * limit >= size[0]
    modes, modal_slopes = right[driven].T, left[:, driven] * size[driven]
    used = modal_slopes if measured is None else measured[:, None] * modal_slopes
    plain = modes @ _estimator(modal_slopes, used)
    clean = modes @ _estimator(modal_slopes, modal_slopes, _RIDGE_CLEAN)
    return Reconstructor(
        plain, modes, modal_slopes, clean, _damping(modal_slopes.T @ modal_slopes, _RIDGE_CLEAN)
    )


def _estimator(slopes_of_modes: Floats, weighted: Floats, largest_ridge: float = _RIDGE) -> Floats:
    """Return (modes, 2 n): modes from slopes, by least squares with a ridge; `weighted_slopes` or equal."""
    normal = weighted.T @ slopes_of_modes
    normal[np.diag_indices_from(normal)] += _damping(normal, largest_ridge)
    return np.asarray(np.linalg.solve(normal, weighted.T))


def _damping(normal: Floats, largest_ridge: float) -> float:
    """Return what to add to the diagonal of the normal equations."""
    return float(min(largest_ridge, _RIDGE_OF_MANY / len(normal)) * np.trace(normal) / len(normal))


def check_controllable(commands: int, slopes: int) -> None:
    """Raise InputError when there are more commands than slopes."""
    if commands > slopes:
        raise InputError(
            f"mirror.actuators: {commands} commands (actuators, tip and tilt) are more than {slopes} slopes "
            "of the lit sub-apertures can control"
        )
