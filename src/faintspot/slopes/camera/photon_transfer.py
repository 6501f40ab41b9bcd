"""Read noise and gain of a camera, from dark frames and from frames with constant flux."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats
from faintspot.base.checks import finite_array, number_between
from faintspot.base.errors import InputError
from faintspot.base.statistics import UNKNOWN, Estimate, mad_std
from faintspot.slopes.camera.dark_frames import DarkPixels, dark_pixels
from faintspot.slopes.camera.frame_checks import are_repeated
from faintspot.slopes.camera.transfer_curve import LineFit, TransferCurve, fit_line, photon_transfer
from faintspot.slopes.sensor.layout import Layout

_LARGEST_SCATTER = 3.0  # mean square of bright pixels' variances about the line, over the expected one
_LARGEST_SECOND_ORDER = 0.15  # largest relative change of the slope by second derivatives
_LARGEST_CURVATURE = 0.25  # relative difference of the gains from faint and bright pixels
_DARKEST_FOR_NOISE = 0.05  # fraction of pixels whose noise is used as read noise, without dark frames
_DARKEST = 0.01  # fraction of pixels whose level is used as dark level if it is unknown


@dataclass(frozen=True)
class DetectorMeasurement:
    """Result of `measure_detector`, with standard errors; NaN for values that could not be measured.

    Parameters
    ----------
    read_noise_adu : Estimate
        Standard deviation of a typical pixel in the dark.
    dark_level_adu : Estimate
        Level of a typical pixel in the dark.
    gain_e_per_adu : Estimate
        Electrons (after multiplication) per ADU.
    reliable : bool
        False if the gain is not reliable: the variance is not linear in the mean, does not increase with the
        flux, or the flux moves too much. The last of `notes` gives the reason.
    notes : tuple of str
        Method used for each value, and problems found.
    pixels : DarkPixels or None
        Dark level and noise [ADU] of each pixel, and the pixels that blink or are hot, from dark frames.
    """

    read_noise_adu: Estimate
    dark_level_adu: Estimate
    gain_e_per_adu: Estimate
    reliable: bool
    notes: tuple[str, ...]
    pixels: DarkPixels | None = None

    @property
    def read_noise_e(self) -> Estimate:
        """Read noise in electrons at the camera's output, as in `faintspot.slopes.simulate.Detector`."""
        noise, gain = self.read_noise_adu, self.gain_e_per_adu
        error = math.hypot(noise.standard_error * gain.value, noise.value * gain.standard_error)
        return Estimate(noise.value * gain.value, error)


class _Dark(NamedTuple):
    """Dark level of each pixel or of all, and of a typical pixel."""

    level: Any
    typical: Estimate
    pixels: DarkPixels | None = None


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
    first and second derivatives. Frames that are the same as the one before are left out.

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
        that of photons (see `faintspot.slopes.simulate.Detector.excess_noise_factor`).
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
    >>> camera = fs.slopes.simulate.Detector(read_noise_e=3.0, gain_e_per_adu=0.5, offset_adu=100.0)
    >>> darks = camera.expose(np.zeros((20, 64, 64)), rng)
    >>> lit = camera.expose(np.tile(np.linspace(10.0, 400.0, 64), (100, 64, 1)), rng)
    >>> found = fs.measure_detector(lit, darks)
    >>> print(f"read noise {found.read_noise_e.value:.1f} e-, gain {found.gain_e_per_adu.value:.2f} e-/ADU")
    read noise 3.0 e-, gain 0.50 e-/ADU
    """
    multiplication, notes = number_between("em_gain", em_gain, 1.0), list[str]()
    if frames is None and darks is None:
        raise InputError("frames, darks: expected at least one of them, got neither")
    stack = None if frames is None else _frames("frames", frames, notes)
    if darks is not None:
        dark, read_noise = _measure_dark(_frames("darks", darks, notes))
        notes.append("read noise and dark level: dark frames, median pixel")
    if stack is None:
        return DetectorMeasurement(read_noise, dark.typical, UNKNOWN, True, tuple(notes), dark.pixels)
    if darks is None:
        dark, note = _dark_without_darks(stack, dark_level_adu)
        notes += [note, "read noise: darkest pixels of the frames, less their photon noise"]
    elif np.shape(dark.level) != stack.shape[1:]:
        raise InputError(f"darks: expected frames of {stack.shape[1:]}, got {np.shape(dark.level)}")
    everything = photon_transfer(stack, dark.level, layout)
    curve = everything.within(range_adu)
    line = fit_line(curve)
    if darks is None:
        read_noise = _read_noise_without_darks(everything, line)
    coarse = fit_line(photon_transfer(stack, dark.level, layout, order=1).within(range_adu))
    problem = _problem(line, coarse, [fit_line(half) for half in curve.halves()])
    notes += ["gain: slope of variance against mean", *([problem] if problem else [])]
    gain = _gain(line, multiplication)
    return DetectorMeasurement(read_noise, dark.typical, gain, not problem, tuple(notes), dark.pixels)


def _frames(name: str, value: object, notes: list[str]) -> Floats:
    """Return checked frames without repeated ones, whose noise would be zero, and note their number."""
    frames: Floats = finite_array(name, value, minimum_dimensions=3).astype(np.float64)
    if frames.ndim != 3 or len(frames) < 2 or min(frames.shape[1:]) < 4:
        raise InputError(f"{name}: expected at least 2 frames of 4 x 4 pixels or more, got {frames.shape}")
    repeated = are_repeated(frames, None)
    if not repeated.any() or np.count_nonzero(~repeated) < 2:
        return frames
    notes.append(
        f"{name}: {np.count_nonzero(repeated)} of {len(frames)} left out, the same as the one before"
    )
    return frames[~repeated]


def _measure_dark(darks: Floats) -> tuple[_Dark, Estimate]:
    """Measure the dark level of each pixel and the read noise of the median pixel."""
    level = darks.mean(axis=0)
    drift = np.median(darks - level, axis=(1, 2))
    residuals = darks - level - drift[:, None, None]
    variance = np.var(residuals, axis=0, ddof=1)
    degrees = len(darks) - 1
    # The median of a chi-squared distribution lies below its mean.
    read_noise = math.sqrt(float(np.median(variance)) * degrees / float(scipy.special.chdtri(degrees, 0.5)))
    # Variance of the median of many variances: 1.25 times that of their mean.
    relative = 1.25 * math.sqrt(2 / (degrees * level.size))
    spread = 1.25 * mad_std(level) / math.sqrt(level.size)
    typical = Estimate(float(np.median(level)), spread)
    pixels = dark_pixels(level, residuals)
    return _Dark(level, typical, pixels), Estimate(read_noise, 0.5 * relative * read_noise)


def _dark_without_darks(frames: Floats, dark_level_adu: float | None) -> tuple[_Dark, str]:
    if dark_level_adu is not None:
        level = number_between("dark_level_adu", dark_level_adu)
        return _Dark(level, Estimate(level, 0.0)), "dark level: given"
    mean = frames.mean(axis=0)
    level = float(np.quantile(mean, _DARKEST))
    noise = math.sqrt(float(np.median(np.square(np.diff(frames, axis=0)))) / len(frames))
    return _Dark(level, Estimate(level, noise)), "dark level: darkest percent of the frames, with stray light"


def _read_noise_without_darks(curve: TransferCurve, line: LineFit | None) -> Estimate:
    """Estimate the read noise from the darkest pixels, less the photon noise that the line gives."""
    darkest = curve.mean <= np.quantile(curve.mean, _DARKEST_FOR_NOISE)
    # The median of a chi-squared distribution lies below its mean.
    correction = curve.degrees / float(scipy.special.chdtri(curve.degrees, 0.5))
    total = float(np.median((curve.variance / np.maximum(curve.share, 0.1))[darkest])) * correction
    photons = 0.0 if line is None else max(line.slope, 0.0) * float(np.mean(curve.mean[darkest]))
    # If photon noise alone would explain the variance, the line is not valid for these pixels.
    variance = total - photons if 0 < photons < total else total
    relative = 1.25 * math.sqrt(2 / (curve.degrees * np.count_nonzero(darkest)))
    read_noise = math.sqrt(variance)
    return Estimate(read_noise, 0.5 * relative * total / read_noise if read_noise else 0.0)


def _gain(line: LineFit | None, em_gain: float) -> Estimate:
    """Return electrons per ADU and its error: the variance in ADU is excess * em_gain * flux / gain."""
    if line is None or line.slope <= 0:
        return UNKNOWN
    gain = (2.0 * em_gain if em_gain > 1 else 1.0) / line.slope
    return Estimate(gain, gain * line.slope_error / line.slope)


def _problem(line: LineFit | None, coarse: LineFit | None, halves: Sequence[LineFit | None]) -> str:
    """Return the reason why the gain is not reliable, or nothing.

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
        return ""
    difference = abs(bright.slope - faint.slope)
    noise = math.hypot(bright.slope_error, faint.slope_error)
    if difference <= max(4 * noise, _LARGEST_CURVATURE * line.slope):
        return ""
    return (
        "gains from faint and bright pixels disagree: the flux moves or fluctuates too much, "
        "pixels saturate or are clipped, or the camera has two gains"
    )
