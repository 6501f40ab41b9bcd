"""The effective PSF in plain NumPy: a cubic spline, or what tables make of it."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import spline_filter

from faintspot.slopes.spots.psf import PSF

Floats = NDArray[np.float64]
PHASES = 16


def pixel_centres(n: int) -> Floats:
    """Where the n pixels of an axis are, px from its middle."""
    return np.array([i - (n - 1) / 2 for i in range(n)], np.float64)


def b_spline(t: Floats) -> Floats:
    """The cubic B-spline of unit node distance."""
    a = np.abs(t)
    return np.where(a < 1, 2 / 3 - a**2 + a**3 / 2, np.where(a < 2, (2 - a) ** 3 / 6, 0.0))


def b_spline_derivative(t: Floats) -> Floats:
    a = np.abs(t)
    steepness = np.where(a < 1, 1.5 * a**2 - 2 * a, np.where(a < 2, -((2 - a) ** 2) / 2, 0.0))
    return steepness * np.sign(t)


def window(n: int, place: float, std: float) -> Floats:
    """A Gaussian of height 1 along one axis, continued from the nearest of its table."""
    tabulated = nearest_phase(n, place)
    away = pixel_centres(n) - tabulated
    value = np.exp(-0.5 * (away / std) ** 2)
    return np.asarray(value + (place - tabulated) * value * away / std**2)


def nearest_phase(n: int, place: float) -> float:
    """The place nearest to this one that a table holds."""
    first = -(n - 1) / 2
    return first - math.floor((first - place) * PHASES + 0.5) / PHASES


def phase_margins(x: float, y: float, shape: tuple[int, int]) -> list[float]:
    """How far x and y are from where the nearest phase changes, phases."""
    return [abs((((n - 1) / 2 + place) * PHASES) % 1.0 - 0.5) for n, place in ((shape[1], x), (shape[0], y))]


class Spot:
    """One effective PSF (rows, columns): the cubic spline through its nodes, zero outside.

    If tabulated, what a table of its profiles holds: spline and derivatives at PHASES places a pixel; at
    others the value is continued from the nearest by the derivative, which itself is taken as it is there.
    """

    def __init__(self, samples: ArrayLike, oversampling: int, is_tabulated: bool) -> None:
        self.coefficients = spline_filter(np.pad(np.asarray(samples, np.float64), 2), 3, mode="mirror")
        self.oversampling = oversampling
        self.is_tabulated = is_tabulated

    def _axis(self, n: int, place: float, count: int) -> tuple[Any, Floats, Floats]:
        """The four nodes that matter to each of n pixels; factors for the value and the derivative."""
        tabulated = nearest_phase(n, place) if self.is_tabulated else place
        at = self.oversampling * (pixel_centres(n) - tabulated) + (count - 1) / 2
        nodes = np.floor(at).astype(int)[:, None] + np.arange(-1, 3)
        t = at[:, None] - nodes
        there = (nodes >= 0) & (nodes < count)
        derivative = -self.oversampling * b_spline_derivative(t) * there
        value = b_spline(t) * there + (place - tabulated) * derivative
        return np.clip(nodes, 0, count - 1), value, derivative

    def images(self, x: float, y: float, shape: tuple[int, int]) -> tuple[Floats, Floats, Floats]:
        """Fraction of the flux in every pixel for a spot at (x, y); its derivatives by x and by y."""
        rows, value_y, slope_y = self._axis(shape[0], y, self.coefficients.shape[0])
        columns, value_x, slope_x = self._axis(shape[1], x, self.coefficients.shape[1])
        c = self.coefficients[rows[:, :, None, None], columns]
        value, by_x, by_y = (
            np.einsum("jaib,ja,ib->ji", c, along_y, along_x)
            for along_y, along_x in ((value_y, value_x), (value_y, slope_x), (slope_y, value_x))
        )
        return value, by_x, by_y


def spots_of(psf: PSF, *, tabulated: bool = False) -> list[Spot]:
    """All PSFs of a sensor; or what stands for them in the kernels: tables of few separable terms."""
    samples = psf.samples
    if tabulated:
        along_x, along_y = psf.separable_terms
        samples = np.einsum("kti,ktj->kij", along_y, along_x)
    return [Spot(plane, psf.oversampling, tabulated) for plane in samples]
