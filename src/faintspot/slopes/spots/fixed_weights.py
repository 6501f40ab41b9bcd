"""Fixed weights: slopes as linear combinations of the pixels of a sub-aperture, for estimator "window"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.slopes.spots.psf import PSF, Indexed

STEP_PX = 0.01
"""Step of the differences for a PSF: a small part of a pixel, far above the rounding of the images."""


def images_with_derivatives(
    render: Callable[[Floats], Floats], positions: Floats, step_px: float = STEP_PX
) -> tuple[Floats, Floats, Floats]:
    """Return images and their derivatives along x and y by four-point differences, accurate to 1e-7.

    Parameters
    ----------
    render : callable
        Returns images (n, ny, nx) of spots at positions (n, 2).
    positions : (n, 2) array
    step_px : float
        Step of the differences.

    Returns
    -------
    images, along_x, along_y : (n, ny, nx) array
    """

    def derivative(step: Floats) -> Floats:
        near, far = (render(positions + k * step) - render(positions - k * step) for k in (1, 2))
        return (8 * near - far) / (12 * step_px)

    along_x, along_y = (derivative(step) for step in step_px * np.eye(2))
    return render(positions), along_x, along_y


_LARGEST = 1e6  # px, or fractions of the flux, for one pixel: above it, float32 sums are meaningless
_SMALLEST_GAIN = 0.02
_LEAST_WEIGHT = 1e-4  # of the largest: less counts nothing, and need not be read
_RIDGE = 1e-6  # of the mean variance of a pixel: keeps the solution finite without noise


@dataclass(frozen=True, eq=False)
class FixedWeights(Indexed):
    """Weights of the pixels of a sub-aperture whose sums are its slopes; immutable.

    A spot with image g, in fractions of its flux, is at ``sum x (g - mean_spot)`` px from its reference
    position, and correspondingly in y. Hand-made weights, quad cells and the best linear estimate for a
    known distribution of spots are all of this form.

    Parameters
    ----------
    x, y : (n_kinds, ny, nx) array, or (ny, nx)
        Weights [px] for fractions of the flux.
    mean_spot : (n_kinds, ny, nx) array
        Fraction of the flux in each pixel, for a spot at the reference position.
    flux : (n_kinds, ny, nx) array, optional
        Weights whose sum is the flux. Default: 1 in every pixel with a weight in x or y, divided by the
        part of the mean spot in these pixels.
    index : (n_subapertures,) array of int, optional
        Kind of each sub-aperture. Default: one kind for all.

    Raises
    ------
    InputError
        If a value is out of range, shapes differ, or the mean spot has no flux in pixels with weights.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> cell = np.array([[-1.0, 1.0], [-1.0, 1.0]])
    >>> quad_cell = fs.FixedWeights(0.8 * cell, 0.8 * cell.T, np.full((2, 2), 0.25))
    """

    NAME, WHAT = "weights", "fixed weights"
    FIELDS = ("x", "y", "mean_spot", "flux", "index")
    OPTIONAL = ("flux", "index")

    x: Any
    y: Any
    mean_spot: Any
    flux: Any = None
    index: Any = None

    def __post_init__(self) -> None:
        values: dict[str, Any] = {}
        for name in ("x", "y", "mean_spot", "flux"):
            if name == "flux" and self.flux is None:
                values["flux"] = _flux_weights(values)
                continue
            maps = numbers_between(f"weights.{name}", getattr(self, name), -_LARGEST, _LARGEST)
            maps = maps[None] if maps.ndim == 2 else maps
            check_shape(f"weights.{name}", maps, ("n_kinds", "ny", "nx"))
            values[name] = maps.astype(np.float64)
            if maps.shape != values["x"].shape:
                raise InputError(f"weights.{name}: expected shape {values['x'].shape} as x, got {maps.shape}")
        for name, array in values.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        self._check_index(len(values["x"]))

    @property
    def window(self) -> tuple[int, int]:
        """Height and width of the sub-apertures [px]."""
        return int(self.x.shape[1]), int(self.x.shape[2])

    @classmethod
    def best_linear(
        cls,
        images: ArrayLike,
        positions: ArrayLike,
        *,
        flux_e: float,
        read_noise_e: ArrayLike,
        excess_noise: float = 1.0,
        background_e: float = 0.0,
    ) -> FixedWeights:
        """Return the weights with the least mean square error among all linear estimates.

        Compute the linear minimum-mean-square estimate (e.g. Kay 1993, chapter 12) of the position for a
        sample of spots, and divide it by its gain, so that a displacement of 1 px gives a slope of 1 px for
        these spots. A Gaussian window of any width is a special case.

        Parameters
        ----------
        images : (n_spots, ny, nx) array
            Images with little or no noise, in any unit: simulated from residual wavefronts, or recorded at
            high flux.
        positions : (n_spots, 2) array
            Positions of these spots, px from the reference: the slopes to be measured.
        flux_e : float
            Flux of a spot for which the weights are optimised [photo-electrons].
        read_noise_e : float or (ny, nx) array
            Read noise, the same in all pixels or that of each [photo-electrons].
        excess_noise : float
            Factor on the variance of the photon noise.
        background_e : float
            Background per pixel [photo-electrons], whose mean is subtracted and whose noise remains.

        Raises
        ------
        InputError
            If there are fewer than two spots, images have no flux, arrays are inconsistent, or positions do
            not vary.
        """
        spots = finite_array("images", images).astype(np.float64)
        truth = finite_array("positions", positions).astype(np.float64)
        if spots.ndim != 3 or len(spots) < 2 or truth.shape != (len(spots), 2):
            raise InputError(
                "images, positions: expected shapes (n, ny, nx) and (n, 2), "
                f"got {spots.shape} and {truth.shape}"
            )
        expected = number_between("flux_e", flux_e, 0.0, low_open=True)
        noise = numbers_between("read_noise_e", read_noise_e, 0.0)
        if noise.shape not in ((), spots.shape[1:]):
            raise InputError(f"read_noise_e: expected shape {spots.shape[1:]}, got {noise.shape}")
        dark = noise.ravel() ** 2 + excess_noise * number_between("background_e", background_e, 0.0)
        total = spots.sum(axis=(1, 2)).mean()
        if total <= 0:
            raise InputError(f"images: expected flux, got a mean sum of {total:g}")
        flat = spots.reshape(len(spots), -1) / total
        mean = flat.mean(axis=0)
        away, moved = flat - mean, truth - truth.mean(axis=0)
        if not np.all(moved.std(axis=0) > 0):
            raise InputError("positions: expected spots that move in x and y, got identical positions")
        variance = dark + excess_noise * expected * np.maximum(mean, 0.0)
        covariance = expected**2 * (away.T @ away) / len(flat)
        covariance[np.diag_indices_from(covariance)] += variance + _RIDGE * variance.mean()
        crossed = expected * away.T @ moved / len(flat)
        weights = expected * np.linalg.solve(covariance, crossed)
        gain = ((away @ weights) * moved).mean(axis=0) / moved.var(axis=0)
        weights /= np.maximum(gain, _SMALLEST_GAIN)
        shape = spots.shape[1:]
        weights[np.abs(weights) < _LEAST_WEIGHT * np.abs(weights).max()] = 0.0
        along, across = weights.T.reshape(2, *shape)
        return cls(along, across, mean.reshape(shape), _best_flux(mean, variance).reshape(shape))

    @classmethod
    def matched(
        cls,
        psf: PSF,
        shape: tuple[int, int],
        *,
        flux_e: ArrayLike,
        read_noise_e: ArrayLike,
        excess_noise: float = 1.0,
        background_e: float = 0.0,
    ) -> FixedWeights:
        """Return the noise-weighted matched filter of each PSF of a sensor, linear in the pixels.

        The least-squares fit of position and flux near a position of 0 with the variance of each pixel as
        weight (Gilles & Ellerbroek 2006, Appl. Opt. 45, 6568). Its error is the Cramer-Rao bound as long as
        spots move by less than about half their width.

        Parameters
        ----------
        psf : PSF
            One PSF, or those of the sub-apertures: see `LaserGuideStar.psf`.
        shape : (int, int)
            Rows and columns of the windows.
        flux_e : float or (n_psfs,) array
            Flux of a spot for which the weights are optimised [photo-electrons].
        read_noise_e : float or (n_psfs, ny, nx) array
            Read noise [photo-electrons].
        excess_noise : float
            Factor on the variance of the photon noise.
        background_e : float
            Background per pixel [photo-electrons], whose mean is subtracted and whose noise remains.

        Raises
        ------
        InputError
            If a value is out of range, shapes differ, or a spot has no flux in its window.
        """
        spot, along_x, along_y = _spot_and_gradients(psf, shape)
        flux = numbers_between("flux_e", flux_e, 0.0, low_open=True)
        noise = numbers_between("read_noise_e", read_noise_e, 0.0)
        if flux.shape not in ((), (len(spot),)) or noise.shape not in ((), spot.shape):
            raise InputError(
                f"flux_e, read_noise_e: expected numbers or shapes ({len(spot)},) and {spot.shape}, "
                f"got {flux.shape} and {noise.shape}"
            )
        dark = noise**2 + excess_noise * number_between("background_e", background_e, 0.0)
        variance = dark + excess_noise * flux[..., None, None] * np.maximum(spot, 0.0)
        variance = np.maximum(variance, _RIDGE * variance.max(axis=(1, 2), keepdims=True))
        maps = np.stack([along_x, along_y, spot]) / variance
        return cls._unbiased(maps, spot, along_x, along_y, psf.index)

    @classmethod
    def shaped(cls, psf: PSF, shape: tuple[int, int], *, power: float = 1.0) -> FixedWeights:
        """Return a centre of gravity weighted with the shape of each PSF, elongated and rotated.

        Parameters
        ----------
        psf : PSF
            One PSF, or those of the sub-apertures.
        shape : (int, int)
            Rows and columns of the windows.
        power : float
            The weight is this power of the spot's image: below 1 wider, above 1 narrower than the spot.

        Raises
        ------
        InputError
            If a value is out of range, or a spot has no flux in its window.
        """
        spot, along_x, along_y = _spot_and_gradients(psf, shape)
        peak = spot.max(axis=(1, 2), keepdims=True)
        weight = (np.maximum(spot, 0.0) / peak) ** number_between("power", power, 0.0, 10.0)
        rows, columns = (np.arange(side) - 0.5 * (side - 1) for side in shape)
        maps = np.stack([weight * columns, weight * rows[:, None], weight])
        return cls._unbiased(maps, spot, along_x, along_y, psf.index)

    @classmethod
    def _unbiased(
        cls, maps: Floats, spot: Floats, along_x: Floats, along_y: Floats, index: object
    ) -> FixedWeights:
        """Combine three maps per kind so that x, y and flux of a spot that moves little are right."""
        n, ny, nx = spot.shape
        rows = np.moveaxis(maps, 0, 1).reshape(n, 3, -1)
        changes = np.stack([along_x, along_y, spot], axis=1).reshape(n, 3, -1)
        response = rows @ changes.swapaxes(1, 2)
        if not np.all(np.linalg.cond(response) < 1 / np.finfo(np.float32).eps):
            raise InputError("psf: expected spots whose motion shows in their windows, got others")
        x, y, flux = (np.linalg.inv(response) @ rows).reshape(n, 3, ny, nx).swapaxes(0, 1)
        return cls(x, y, spot, flux, index)


def _spot_and_gradients(psf: PSF, shape: tuple[int, int]) -> tuple[Floats, Floats, Floats]:
    """Return images (n_psfs, ny, nx) of spots at 0 and their derivatives in the position."""
    psfs = np.arange(len(psf.samples))
    render = partial(psf.images, shape=shape, which=psfs)
    spot, along_x, along_y = images_with_derivatives(render, np.zeros((len(psfs), 2)))
    if not np.all(spot.max(axis=(1, 2)) > 0):
        raise InputError("psf: expected spots with flux in their windows, got none")
    return spot, along_x, along_y


def _flux_weights(values: dict[str, Any]) -> Floats:
    """Return 1 in pixels with a weight in x or y, divided by the part of the mean spot in them."""
    counted = ((values["x"] != 0) | (values["y"] != 0)).astype(np.float64)
    flux_share = (counted * values["mean_spot"]).sum(axis=(1, 2), keepdims=True)
    if np.any(flux_share <= 0):
        raise InputError("weights.mean_spot: expected flux in the pixels with weights, got none")
    flux: Floats = counted / flux_share
    return flux


def _best_flux(mean: Floats, variance: Floats) -> Floats:
    """Return the weights of the flux with the least noise, for a spot at its mean position."""
    weights = np.maximum(mean, 0.0) / variance
    flux: Floats = weights / (weights @ mean)
    return flux
