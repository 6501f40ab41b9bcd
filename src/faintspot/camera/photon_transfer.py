"""Read noise and gain of a camera, from dark frames and from frames with constant flux."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import spline_filter1d
from scipy.stats import chi2

from faintspot.base.checks import finite_array, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.camera.dark_frames import DarkPixels, dark_pixels
from faintspot.sensor.layout import Layout

Floats = NDArray[np.float64]

_BY_DARKS = "read noise and dark level: dark frames, median pixel"
_TILE = 16  # side of the parts of a frame that are assumed to move together, px
_GROUPS = 16  # of pixels, for standard errors
_ITERATIONS = 20
_LARGEST_EXCESS = 10.0  # times the expected variance: pixels above it are ignored as flickering
_LARGEST_SCATTER = 3.0  # mean square of bright pixels' variances about the line, over the expected one
_LARGEST_SECOND_ORDER = 0.15  # largest relative change of the slope by second derivatives
_LARGEST_CURVATURE = 0.25  # relative difference of the gains from faint and bright pixels
_DARKEST_FOR_NOISE = 0.05  # fraction of pixels whose noise is used as read noise, without dark frames
_DARKEST = 0.01  # fraction of pixels whose level is used as dark level if it is unknown


@dataclass(frozen=True)
class DetectorMeasurement:
    """Result of `measure_detector`; None for values that could not be measured. Errors are standard errors.

    Parameters
    ----------
    read_noise_adu, read_noise_adu_error : float
        Standard deviation of a typical pixel in the dark.
    gain_e_per_adu, gain_e_per_adu_error : float or None
        Electrons (after multiplication) per ADU.
    dark_level_adu, dark_level_adu_error : float
        Level of a typical pixel in the dark.
    read_noise_e, read_noise_e_error : float or None
        Read noise in electrons at the camera's output, as in `faintspot.simulate.Detector`.
    faint_gain_e_per_adu, bright_gain_e_per_adu : float or None
        Gain from the pixels with the fainter and the brighter half of the flux separately.
    reliable : bool
        False if the gain is not reliable: the variance is not linear in the mean, does not increase with the
        flux, or the flux moves too much. The last of `notes` gives the reason.
    notes : tuple of str
        Method used for each value, and problems found.
    pixels : DarkPixels or None
        Dark level and noise [ADU] of each pixel, and the pixels that blink or are hot, from dark frames.
    """

    read_noise_adu: float
    read_noise_adu_error: float
    gain_e_per_adu: float | None
    gain_e_per_adu_error: float | None
    dark_level_adu: float
    dark_level_adu_error: float
    read_noise_e: float | None
    read_noise_e_error: float | None
    faint_gain_e_per_adu: float | None
    bright_gain_e_per_adu: float | None
    reliable: bool
    notes: tuple[str, ...]
    pixels: DarkPixels | None = None


class _Dark(NamedTuple):
    """Dark level of each pixel or of all, and of a typical pixel."""

    level: Any
    typical: float
    typical_error: float
    pixels: DarkPixels | None = None


class _Value(NamedTuple):
    """Value and standard error."""

    value: float
    error: float


class _Curve(NamedTuple):
    """Photon-transfer curve, one point per pixel: expected variance = intercept * share + slope * flux."""

    variance: Floats
    share: Floats  # fraction of its own variance left after common changes are removed
    flux: Floats  # mean above the dark level, weighted likewise
    mean: Floats  # plain mean above the dark level
    degrees: float  # degrees of freedom of each variance


class _Line(NamedTuple):
    slope: float
    slope_error: float
    scatter: float  # mean square of bright pixels about the line, 1 for normal noise


def measure_detector(
    frames: ArrayLike | None = None,
    darks: ArrayLike | None = None,
    *,
    layout: Layout | None = None,
    em_gain: float = 1.0,
    dark_level_adu: float | None = None,
    range_adu: tuple[float, float] | None = None,
) -> DetectorMeasurement:
    """Measure the read noise and the gain of a camera.

    The read noise is the temporal standard deviation of the median pixel of dark frames (insensitive to hot
    pixels), after subtracting the median of each frame. The gain is obtained by photon transfer (Janesick
    2007, Photon Transfer), as the slope of the variance of a pixel against its mean in frames with constant
    flux. The variance is half the mean square of the difference between successive frames, so that slow
    drifts have no effect. Changes of brightness and small movements common to a sub-aperture (without
    `layout`: to an area of 16 x 16 px) are fitted and removed, in proportion to the mean image and its
    first and second derivatives.

    Parameters
    ----------
    frames : (n, h, w) array, optional
        Frames [ADU], at least 2 consecutive ones, with flux that moves by less than about 0.2 px.
    darks : (n, h, w) array, optional
        Frames without flux [ADU], at least 2. They also give dark level and noise of each pixel, and from 10
        frames on the pixels that blink. The noise of their dark current is included in the read noise.
        Without them, the read noise is that of the darkest pixels of `frames`, to about 10 % if these get
        some flux.
    layout : Layout, optional
        Sub-apertures of `frames` to use, each of which moves separately, instead of the whole frame.
    em_gain : float
        Mean gain of the multiplication register, 1 without one. Above 1 the variance of electrons is twice
        that of photons (see `faintspot.simulate.Detector.excess_noise_factor`).
    dark_level_adu : float, optional
        Dark level, if there are no `darks`. Default: that of the darkest percent of the pixels of the frames,
        which includes stray light.
    range_adu : (float, float), optional
        Range of the mean above the dark level in which pixels are used: below saturation, or within one of
        two gains of a camera.

    Raises
    ------
    InputError
        If neither frames nor darks are given, or arrays are not finite or inconsistent.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> rng = np.random.default_rng(1)
    >>> camera = fs.simulate.Detector(read_noise_e=3.0, gain_e_per_adu=0.5, offset_adu=100.0)
    >>> darks = camera.expose(np.zeros((20, 64, 64)), rng)
    >>> lit = camera.expose(np.tile(np.linspace(10.0, 400.0, 64), (100, 64, 1)), rng)
    >>> found = fs.measure_detector(lit, darks)
    >>> print(f"read noise {found.read_noise_e:.1f} e-, gain {found.gain_e_per_adu:.2f} e-/ADU")
    read noise 3.0 e-, gain 0.50 e-/ADU
    """
    multiplication = number_between("em_gain", em_gain, 1.0)
    if frames is None:
        if darks is None:
            raise InputError("frames, darks: expected at least one of them, got neither")
        dark, read_noise = _measure_dark(_frames("darks", darks))
        return _result(dark, read_noise, None, (None, None), multiplication, [_BY_DARKS])
    stack = _frames("frames", frames)
    if darks is None:
        dark, note = _dark_without_darks(stack, dark_level_adu)
        notes = [note, "read noise: darkest pixels of the frames, less their photon noise"]
    else:
        dark, read_noise = _measure_dark(_frames("darks", darks))
        notes = [_BY_DARKS]
        if np.shape(dark.level) != stack.shape[1:]:
            raise InputError(f"darks: expected frames of {stack.shape[1:]}, got {np.shape(dark.level)}")
    everything = _photon_transfer(stack, dark.level, layout)
    curve = _within(everything, range_adu)
    line = _fit(curve)
    if darks is None:
        read_noise = _read_noise_without_darks(everything, line)
    coarse = _fit(_within(_photon_transfer(stack, dark.level, layout, order=1), range_adu))
    halves = tuple(_fit(half) for half in _halves(curve))
    notes.append("gain: slope of variance against mean")
    problem = _problem(line, coarse, halves)
    return _result(dark, read_noise, line, halves, multiplication, notes, problem)


def _frames(name: str, value: Any) -> Floats:
    frames: Floats = finite_array(name, value, minimum_dimensions=3).astype(np.float64)
    if frames.ndim != 3 or len(frames) < 2 or min(frames.shape[1:]) < 4:
        raise InputError(f"{name}: expected at least 2 frames of 4 x 4 pixels or more, got {frames.shape}")
    return frames


def _measure_dark(darks: Floats) -> tuple[_Dark, _Value]:
    """Measure the dark level of each pixel and the read noise of the median pixel."""
    level = darks.mean(axis=0)
    drift = np.median(darks - level, axis=(1, 2))
    residuals = darks - level - drift[:, None, None]
    variance = np.var(residuals, axis=0, ddof=1)
    degrees = len(darks) - 1
    # The median of a chi-squared distribution lies below its mean.
    read_noise = math.sqrt(float(np.median(variance)) * degrees / float(chi2.median(degrees)))
    # Variance of the median of many variances: 1.25 times that of their mean.
    relative = 1.25 * math.sqrt(2 / (degrees * level.size))
    spread = 1.25 * 1.4826 * float(np.median(np.abs(level - np.median(level)))) / math.sqrt(level.size)
    dark = _Dark(level, float(np.median(level)), spread, dark_pixels(level, residuals))
    return dark, _Value(read_noise, 0.5 * relative * read_noise)


def _dark_without_darks(frames: Floats, dark_level_adu: float | None) -> tuple[_Dark, str]:
    if dark_level_adu is not None:
        level = number_between("dark_level_adu", dark_level_adu)
        return _Dark(level, level, 0.0), "dark level: given"
    mean = frames.mean(axis=0)
    level = float(np.quantile(mean, _DARKEST))
    noise = math.sqrt(float(np.median(np.square(np.diff(frames, axis=0)))) / len(frames))
    return _Dark(level, level, noise), "dark level: darkest percent of the frames, with stray light"


def _read_noise_without_darks(curve: _Curve, line: _Line | None) -> _Value:
    """Estimate the read noise from the darkest pixels, less the photon noise that the line gives."""
    darkest = curve.mean <= np.quantile(curve.mean, _DARKEST_FOR_NOISE)
    # The median of a chi-squared distribution lies below its mean.
    correction = curve.degrees / float(chi2.median(curve.degrees))
    total = float(np.median((curve.variance / np.maximum(curve.share, 0.1))[darkest])) * correction
    photons = 0.0 if line is None else max(line.slope, 0.0) * float(np.mean(curve.mean[darkest]))
    # If photon noise alone would explain the variance, the line is not valid for these pixels.
    variance = total - photons if 0 < photons < total else total
    relative = 1.25 * math.sqrt(2 / (curve.degrees * np.count_nonzero(darkest)))
    read_noise = math.sqrt(variance)
    return _Value(read_noise, 0.5 * relative * total / read_noise if read_noise else 0.0)


def _photon_transfer(frames: Floats, dark_level: Any, layout: Layout | None, order: int = 2) -> _Curve:
    """Return the variance of each pixel after removal of the common changes of its tile.

    The residual of a fit with orthonormal modes Q has the variance sum_j (1 - Q Q')_ij^2 v_j, which is
    computed for v = 1 (`share`) and v = flux.
    """
    mean = frames.mean(axis=0)
    flux = np.broadcast_to(mean - dark_level, mean.shape)
    slope_y, slope_x = _derivative(mean, 0), _derivative(mean, 1)
    seconds = [_derivative(slope_y, 0), _derivative(slope_y, 1), _derivative(slope_x, 1)]
    maps = np.stack([flux, slope_x, slope_y, *seconds][: 3 * order], axis=-1)
    differences = np.diff(frames, axis=0)
    parts = []
    for tile in _tiles(mean.shape, layout):
        here = flux[tile].ravel()
        left, size, _ = np.linalg.svd(maps[tile].reshape(len(here), -1), full_matrices=False)
        modes = left[:, size > 1e-9 * max(float(size[0]), 1e-300)]
        change = differences[(slice(None), *tile)].reshape(len(differences), -1)
        residual = change - (change @ modes) @ modes.T
        leverage = np.sum(np.square(modes), axis=1)
        spread = np.sum((modes @ (modes.T @ (here[:, None] * modes))) * modes, axis=1)
        variance = 0.5 * np.mean(np.square(residual), axis=0)
        parts.append((variance, 1 - leverage, here * (1 - 2 * leverage) + spread, here))
    n = len(differences)
    # Successive differences share a frame: their squares are correlated by 1/4.
    variance, share, weighted, plain = (np.concatenate(values) for values in zip(*parts, strict=True))
    return _Curve(variance, share, weighted, plain, n**2 / (1.5 * n - 0.5))


def _derivative(image: Floats, axis: int) -> Floats:
    """Return the derivative per pixel of a quintic spline, which suits critically sampled spots."""
    coefficients = np.moveaxis(spline_filter1d(image, 5, axis=axis, mode="mirror"), axis, 0)
    c = np.pad(coefficients, ((2, 2), (0, 0)), mode="reflect")
    slope: Floats = (10 * (c[3:-1] - c[1:-3]) + c[4:] - c[:-4]) / 24
    return np.moveaxis(slope, 0, axis)


def _tiles(shape: tuple[int, ...], layout: Layout | None) -> list[tuple[slice, slice]]:
    """Return the windows of the layout, or tiles that cover the frame."""
    if layout is not None:
        if layout.frame_shape != shape:
            raise InputError(f"frames: expected the layout's shape {layout.frame_shape}, got {shape}")
        height, width = layout.window
        return [(slice(r, r + height), slice(c, c + width)) for r, c in layout.corners]
    rows, columns = (np.linspace(0, side, max(1, side // _TILE) + 1).astype(int) for side in shape)
    return [
        (slice(top, bottom), slice(start, stop))
        for top, bottom in pairwise(rows)
        for start, stop in pairwise(columns)
    ]


def _within(curve: _Curve, range_adu: tuple[float, float] | None) -> _Curve:
    if range_adu is None:
        return curve
    limits = numbers_between("range_adu", range_adu)
    if limits.shape != (2,) or limits[0] >= limits[1]:
        raise InputError(f"range_adu: expected (lowest, highest), got {range_adu!r}")
    inside = (curve.mean >= limits[0]) & (curve.mean <= limits[1])
    if np.count_nonzero(inside) < 2 * _GROUPS:
        raise InputError(f"range_adu = {range_adu!r}: expected at least {2 * _GROUPS} pixels in it")
    return _chosen(curve, inside)


def _chosen(curve: _Curve, pixels: NDArray[np.bool_]) -> _Curve:
    variance, share, flux, mean = (values[pixels] for values in curve[:4])
    return _Curve(variance, share, flux, mean, curve.degrees)


def _halves(curve: _Curve) -> tuple[_Curve, _Curve]:
    """Split the pixels so that the fainter ones have half of the flux."""
    order = np.argsort(curve.mean)
    collected = np.cumsum(np.maximum(curve.mean[order], 0.0))
    split = curve.mean[order][np.searchsorted(collected, 0.5 * collected[-1])]
    return _chosen(curve, curve.mean < split), _chosen(curve, curve.mean >= split)


def _fit(curve: _Curve) -> _Line | None:
    """Fit variance = intercept * share + slope * flux; standard errors by jackknife over groups of pixels."""
    terms = np.stack([curve.share, curve.flux], axis=1)
    n = len(terms)
    if n < 2 * _GROUPS or np.ptp(curve.mean) == 0:
        return None
    # Weights must not follow the noise of faint pixels: below the typical flux they are equal.
    bright = max(float(np.sum(np.square(curve.mean)) / max(np.sum(np.abs(curve.mean)), 1e-300)), 0.0)
    typical = np.maximum(curve.mean, bright)
    model: Any = np.full(n, np.inf)
    scale: Any = np.ones(n)
    for _ in range(_ITERATIONS):
        good = (curve.variance > 0) & (curve.variance < _LARGEST_EXCESS * model)
        weight = good / np.square(scale)
        solution = _solve(terms * weight[:, None], terms, curve.variance)
        smallest = 0.1 * float(np.median(curve.variance)) + 1e-300
        model = np.maximum(terms @ solution, smallest)
        scale = np.maximum(solution[0] + solution[1] * typical, smallest)
    weighted = terms * weight[:, None]
    group = np.arange(n) * _GROUPS // n
    others = [group != left_out for left_out in range(_GROUPS)]
    without = np.array([_solve(weighted[k], terms[k], curve.variance[k]) for k in others])
    error = math.sqrt((_GROUPS - 1) * float(np.var(without[:, 1])))
    counted = good & (curve.mean >= bright)
    scatter = np.mean(np.square(curve.variance / model - 1)[counted]) if counted.any() else 0.0
    return _Line(float(solution[1]), error, float(scatter) * curve.degrees / 2)


def _solve(weighted: Floats, terms: Floats, variance: Floats) -> Floats:
    solution = np.linalg.lstsq(weighted.T @ terms, weighted.T @ variance, rcond=None)[0]
    return np.asarray(solution, dtype=np.float64)


def _result(
    dark: _Dark,
    read_noise: _Value,
    line: _Line | None,
    halves: tuple[_Line | None, ...],
    em_gain: float,
    notes: list[str],
    problem: str | None = None,
) -> DetectorMeasurement:
    """Combine the parts; without frames there are no lines."""
    gain = _gain(line, em_gain)
    faint, bright = (_gain(half, em_gain) for half in halves)
    in_electrons = None
    if gain is not None:
        error = math.hypot(read_noise.error * gain.value, read_noise.value * gain.error)
        in_electrons = _Value(read_noise.value * gain.value, error)
    return DetectorMeasurement(
        read_noise_adu=read_noise.value,
        read_noise_adu_error=read_noise.error,
        gain_e_per_adu=gain and gain.value,
        gain_e_per_adu_error=gain and gain.error,
        dark_level_adu=dark.typical,
        dark_level_adu_error=dark.typical_error,
        read_noise_e=in_electrons and in_electrons.value,
        read_noise_e_error=in_electrons and in_electrons.error,
        faint_gain_e_per_adu=faint and faint.value,
        bright_gain_e_per_adu=bright and bright.value,
        reliable=problem is None,
        notes=tuple(notes) if problem is None else (*notes, problem),
        pixels=dark.pixels,
    )


def _gain(line: _Line | None, em_gain: float) -> _Value | None:
    """Return electrons per ADU and its error: the variance in ADU is excess * em_gain * flux / gain."""
    if line is None or line.slope <= 0:
        return None
    gain = (2.0 * em_gain if em_gain > 1 else 1.0) / line.slope
    return _Value(gain, gain * line.slope_error / line.slope)


def _problem(line: _Line | None, coarse: _Line | None, halves: tuple[_Line | None, ...]) -> str | None:
    """Return the reason why the gain is not reliable, or None.

    If second derivatives of the image affect the residuals of movements, third ones may do so, too.
    """
    if line is None or coarse is None or line.slope <= 3 * line.slope_error:
        return "the variance does not increase with the flux: use more flux or more frames"
    second_order = coarse.slope - line.slope
    moving = second_order > max(_LARGEST_SECOND_ORDER * line.slope, 4 * line.slope_error)
    if moving or line.scatter > _LARGEST_SCATTER:
        return "the flux moves too much between frames: the gain is too low"
    faint, bright = halves
    if faint is None or bright is None:
        return None
    difference = abs(bright.slope - faint.slope)
    noise = math.hypot(bright.slope_error, faint.slope_error)
    if difference <= max(4 * noise, _LARGEST_CURVATURE * line.slope):
        return None
    return (
        "gains from faint and bright pixels disagree: the flux moves or fluctuates too much, "
        "pixels saturate or are clipped, or the camera has two gains"
    )
