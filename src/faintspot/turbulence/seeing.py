"""The Fried parameter r0 from the variance of open-loop slopes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.turbulence.von_karman import R0_WAVELENGTH_M, SPECTRUM

Floats = NDArray[np.float64]

KOLMOGOROV = math.inf
"""Outer scale of the Kolmogorov spectrum."""

_FEWEST_FRAMES = 20
_FREQUENCIES = 600
_ANGLES = 96
_LOWEST, _HIGHEST = 1e-5, 60.0  # frequencies, in cycles per sub-aperture


@dataclass(frozen=True)
class Seeing:
    """Atmospheric parameters estimated from the slopes of a sequence of frames."""

    r0_m: float
    """Fried parameter at 500 nm; NaN if the slopes vary no more than their noise."""
    r0_x_m: float
    """Fried parameter from the slopes along x alone."""
    r0_y_m: float
    r0_kolmogorov_m: float
    """Fried parameter from the same slopes with an infinite outer scale."""
    noise_std_px: float
    """Standard deviation of the slope noise."""
    frames: int


def slope_variance(
    subaperture_m: float,
    outer_scale_m: float,
    *,
    baseline_m: float | None = None,
    positions: ArrayLike | None = None,
    along: ArrayLike = (1.0, 0.0),
) -> float:
    """Return the variance of the wavefront's mean gradient over square sub-apertures for r0 = 1 m, rad^2.

    The power spectral density of the phase of von Karman turbulence is 0.0229 r0^(-5/3) (f^2 + 1 /
    L0^2)^(-11/6); for another r0 (at 500 nm) multiply by r0^(-5/3). The gradient of the optical path does
    not depend on the wavelength.

    Parameters
    ----------
    subaperture_m : float
    outer_scale_m : float
        L0; infinite for the Kolmogorov spectrum, which is truncated at 1e5 sub-apertures.
    baseline_m : float, optional
        Distance over which the gradient is taken. Default: the side of the sub-aperture. In a simulation
        with n points across it is (n - 1) / n of the side, since there are n - 1 steps between them.
    positions : (n, 2) array, optional
        Centres x, y of n sub-apertures [m]: the result is the variance about their mean in each frame,
        averaged over them. Default: the variance of one slope.
    along : two numbers
        Direction of the gradient, along a side of the sub-apertures.

    Raises
    ------
    InputError
        If sizes are not above 0, or positions have another shape.
    """
    side = number_between("subaperture_m", subaperture_m, 0, low_open=True)
    if math.isnan(outer_scale_m) or outer_scale_m <= 0:
        raise InputError(f"outer_scale_m = {outer_scale_m:g}: expected a number above 0, or infinity")
    direction = np.asarray(along, np.float64)
    places = None
    if positions is not None:
        array = finite_array("positions", positions).astype(np.float64)
        if array.ndim != 2 or array.shape[1] != 2:
            raise InputError(f"positions: expected x and y of each sub-aperture, got shape {array.shape}")
        places = tuple(map(tuple, array.tolist()))
    baseline = side if baseline_m is None else number_between("baseline_m", baseline_m, 0, low_open=True)
    to_x, to_y = (direction / math.hypot(*direction)).tolist()
    return _slope_variance(side, baseline, float(outer_scale_m), places, to_x, to_y)


@lru_cache(maxsize=64)
def _slope_variance(
    side: float,
    baseline: float,
    outer_scale_m: float,
    positions: tuple[tuple[float, ...], ...] | None,
    to_x: float,
    to_y: float,
) -> float:
    frequency = np.geomspace(_LOWEST, _HIGHEST, _FREQUENCIES)[:, None] / side
    angle = (np.arange(_ANGLES) + 0.5) * math.pi / _ANGLES  # half a turn: the other half is the same
    x, y = frequency * np.cos(angle), frequency * np.sin(angle)
    along, across = to_x * x + to_y * y, to_x * y - to_y * x
    gradient = 2 * math.pi * along * np.sinc(along * baseline) * np.sinc(across * side)
    density = SPECTRUM * (frequency**2 + outer_scale_m**-2) ** (-11 / 6) * gradient**2
    if positions is not None:
        density = density * (1 - _array_factor(positions, x, y))
    # d^2 f = f^2 dangle dlog f
    by_frequency = (density * frequency**2).mean(axis=1) * 2 * math.pi
    in_radians = float(np.trapezoid(by_frequency, np.log(frequency[:, 0])))
    return in_radians * (R0_WAVELENGTH_M / (2 * math.pi)) ** 2


def estimate_r0(
    slopes_px: ArrayLike,
    *,
    cells: ArrayLike,
    subaperture_m: float,
    pixel_scale_rad: float,
    outer_scale_m: float,
    baseline_m: float | None = None,
    segment: ArrayLike | None = None,
    static_px: ArrayLike | None = None,
    remove_tip_tilt: bool = True,
) -> Seeing:
    """Return r0 estimated from slopes due to the atmosphere alone, (frames, 2 n) px: all x, then all y.

    The variance of the slopes is equated to `slope_variance`. Noise is independent between frames and is
    removed by means of the covariances C1 and C2 of each slope with itself one and two frames later: the
    variance without noise is their parabolic extrapolation to zero delay, (4 C1 - C2) / 3.

    Parameters
    ----------
    slopes_px : (frames, 2 n) array
        Slopes as returned by `pseudo_open_loop_slopes`.
    cells : (n, 2) array of int
        Row and column of each sub-aperture in the lenslet array.
    subaperture_m : float
        Side of a sub-aperture.
    pixel_scale_rad : float
        Angle on the sky per pixel.
    outer_scale_m : float
        Outer scale; infinite for the Kolmogorov spectrum, which overestimates r0.
    baseline_m : float, optional
        As for `slope_variance`.
    segment : (frames,) array of int, optional
        Number of the continuous segment to which each frame belongs. Default: all frames are one segment.
    static_px : (2 n,) array, optional
        Slopes not due to turbulence, known better from a longer record. Default: mean of the frames.
    remove_tip_tilt : bool
        Whether the mean over all sub-apertures is removed from each frame, and from the theory. It changes
        so slowly that short records have few independent values of it, and it is affected by telescope
        vibration.

    Raises
    ------
    InputError
        If shapes are inconsistent, or there are fewer than 20 frames.
    """
    slopes, places = _checked(slopes_px, cells)
    part = np.zeros(len(slopes), np.int64) if segment is None else np.asarray(segment)
    if part.shape != (len(slopes),):
        raise InputError(
            f"segment: expected a number for each of {len(slopes)} frames, got shape {part.shape}"
        )
    scale = number_between("pixel_scale_rad", pixel_scale_rad, 0, low_open=True)
    axes = slopes.reshape(len(slopes), 2, -1)
    axes = axes - (axes.mean(axis=0) if static_px is None else _checked_static(static_px, axes.shape[2]))
    if remove_tip_tilt:
        axes = axes - axes.mean(axis=2, keepdims=True)
    total = np.square(axes).mean(axis=(0, 2))
    first, second = (_lagged(axes, part, lag) for lag in (1, 2))
    signal = (4 * first - second) / 3
    positions = places[:, ::-1] * subaperture_m if remove_tip_tilt else None
    theory, kolmogorov = (
        np.array(
            [
                slope_variance(
                    subaperture_m, scale_m, baseline_m=baseline_m, positions=positions, along=along
                )
                for along in ((1.0, 0.0), (0.0, 1.0))
            ]
        )
        for scale_m in (outer_scale_m, KOLMOGOROV)
    )
    measured = signal * scale**2
    return Seeing(
        _r0(measured.sum(), theory.sum()),
        _r0(measured[0], theory[0]),
        _r0(measured[1], theory[1]),
        _r0(measured.sum(), kolmogorov.sum()),
        math.sqrt(max(0.0, (total - signal).mean())),
        len(slopes),
    )


def mean_r0(r0_m: ArrayLike) -> float:
    """Return the r0 of constant turbulence with the mean strength, (mean of r0^(-5/3))^(-3/5)."""
    values = numbers_between("r0_m", r0_m, 0, low_open=True)
    return float(np.mean(values ** (-5 / 3)) ** (-3 / 5))


def _array_factor(positions: tuple[tuple[float, ...], ...], x: Floats, y: Floats) -> Floats:
    """Return |mean of exp(2 pi i f r)|^2: the part of the variance common to all sub-apertures."""
    total = np.zeros(x.shape, np.complex128)
    for across, up in positions:
        total += np.exp(2j * math.pi * (across * x + up * y))
    factor: Floats = np.square(np.abs(total / len(positions)))
    return factor


def _checked(slopes_px: ArrayLike, cells: ArrayLike) -> tuple[Floats, Floats]:
    slopes = finite_array("slopes_px", slopes_px).astype(np.float64)
    places = finite_array("cells", cells).astype(np.float64)
    if places.ndim != 2 or places.shape[1] != 2:
        raise InputError(f"cells: expected row and column of each sub-aperture, got shape {places.shape}")
    if slopes.ndim != 2 or slopes.shape[1] != 2 * len(places):
        raise InputError(
            f"slopes_px: expected shape (frames, {2 * len(places)}) for {len(places)} sub-apertures, "
            f"got {slopes.shape}"
        )
    if len(slopes) < _FEWEST_FRAMES:
        raise InputError(f"slopes_px: expected at least {_FEWEST_FRAMES} frames, got {len(slopes)}")
    return slopes, places


def _checked_static(static_px: ArrayLike, n: int) -> Floats:
    static = finite_array("static_px", static_px).astype(np.float64)
    if static.shape != (2 * n,):
        raise InputError(f"static_px: expected {2 * n} slopes, got shape {static.shape}")
    return static.reshape(2, n)


def _lagged(axes: Floats, part: NDArray[np.int64], lag: int) -> Floats:
    """Return the mean product of slopes `lag` frames apart within a segment, for x and y."""
    together = part[lag:] == part[:-lag]
    products: Floats = (axes[lag:][together] * axes[:-lag][together]).mean(axis=(0, 2))
    return products


def _r0(variance: float, theory: float) -> float:
    return float((variance / theory) ** (-3 / 5)) if variance > 0 else math.nan
