"""Strength, number of kept pixels and smoothing width from what is known of the flux and the camera.

Where the formulae come from, how their constants were found and how well they do: docs/automatic.md. With

    N = pixels of the window, r = range of positions, side = sqrt(N),
    A = noise-equivalent area of the spot, px^2 (1 / sum of f^2, f = fraction of the flux in a pixel),
    v = read_noise^2 + excess * background, variance of a dark pixel, e-^2,
    C = flux / (A * (sqrt(v) + tail)), contrast of the core to a dark pixel's noise (`tail`: background
        electrons are few and large, so that their noise has higher peaks than sqrt(v) says),
    D = flux / sqrt(A v), signal to noise of a matched filter,
    q = flux / (excess * A), photons in a pixel of the core,

the kept pixels are those whose expected signal exceeds c noises (of a Gaussian spot A / 2 * ln(C / c), of a
sinc^2 not more than its main lobe until C is high); the strength is the noise that denoising can take away:
that of the dark pixels, less the degrees of freedom that it leaves, and the photon noise outside the core.
Where the spot is lost in the noise (C small), everything falls back to an estimate that stays near the
middle of the window; where the noise is larger than the range of positions, to no denoising.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.algorithms.automatic_constants import FEW, KEPT, SMOOTHING, STRENGTH, Kept
from faintspot.base.checks import numbers_between, one_of
from faintspot.base.errors import InputError

METHODS = ("tv", "none", "smoothed")
PROFILES = ("diffraction", "gaussian")

SMALLEST_FWHM_PX = 0.05
_LARGEST = 1e9
_SMALLEST_VARIANCE = 1e-4  # e-^2, where there is neither read noise nor background
# Noise-equivalent area / FWHM^2, A being (3 size)^2 of both; FWHM is 1.772 size and 2 size (px).
_AREA_OF_SQUARED_FWHM = {"diffraction": 2.866, "gaussian": 2.25}


def automatic_strength(
    flux_e: ArrayLike,
    read_noise_e: ArrayLike,
    *,
    pixels: ArrayLike,
    spot_fwhm_px: ArrayLike,
    elongation: ArrayLike = 1.0,
    excess_noise: ArrayLike = 1.0,
    background_e: ArrayLike = 0.0,
    position_range_px: ArrayLike = 1.0,
    profile: str = "diffraction",
) -> NDArray[np.float64]:
    """Return the strength of TV denoising (`noise_std`), e-; 0 where denoising does not help.

    sqrt(a^2 v C^(-2 d) (1 - M / N) + w exp(-z A / N) excess flux / N), at most the noise of a mean pixel: the
    noise of dark pixels, less what the M degrees of freedom of the denoised image keep of it, and the photon
    noise of the light outside the core (none of a Gaussian spot).

    All arguments but `profile` broadcast against each other, so that each sub-aperture may have its own.

    Parameters
    ----------
    flux_e : float or array
        Photo-electrons of one spot that fall within its window in one frame.
    read_noise_e : float or array
        Standard deviation of the read noise in photo-electrons (for an EMCCD: divided by its gain).
    pixels : int or array
        Number of pixels of the window (16 x 16: 256), which is taken to be square.
    spot_fwhm_px : float or array
        Full width at half maximum of the optical spot (without the pixels' own blur), px, at least 0.05;
        of an elongated one the geometric mean of both axes.
    elongation : float or array
        Width along the long axis over that along the short one, at least 1.
    excess_noise : float or array
        Factor on the photon noise's variance: 2 for an EMCCD at high gain.
    background_e : float or array
        Mean photo-electrons per pixel whose mean is taken off and whose noise stays.
    position_range_px : float or array
        Positions are within plus and minus this of the window's middle on each axis.
    profile : {"diffraction", "gaussian"}
        Whether the spot has the wings of a square lenslet's sinc^2 or none.

    Returns
    -------
    float64 array
        Of the arguments' common shape.

    Raises
    ------
    InputError
        For values that are not finite or out of range, shapes that do not broadcast, an unknown profile.

    Notes
    -----
    Source: own Monte-Carlo study, docs/automatic.md; the form follows A. G. Basden et al. 2015 (MNRAS;
    arXiv:1503.06043), where the strength is the noise of the image.
    """
    sensor = _sensor(
        flux_e,
        read_noise_e,
        pixels,
        spot_fwhm_px,
        elongation,
        excess_noise,
        background_e,
        position_range_px,
        profile,
    )
    lost, off = _lost_and_off(sensor, KEPT["tv"])
    gain = STRENGTH.gaussian if sensor.gaussian else STRENGTH.diffraction
    wings = 0.0 if sensor.gaussian else STRENGTH.wings
    matched = sensor.matched_squared
    freedom = 1 + (matched / STRENGTH.noise_freedom_at**2) ** (STRENGTH.noise_freedom_exponent / 2)
    freedom = STRENGTH.core_freedom * sensor.area + STRENGTH.noise_freedom / freedom
    noise = np.sqrt(sensor.variance)
    contrast = np.maximum(sensor.flux / (sensor.area * noise), 1e-3)
    dark = gain * (noise + STRENGTH.tail * sensor.excess * sensor.counted) * contrast**-STRENGTH.decline
    dark = dark**2 * np.maximum(1 - freedom / sensor.pixels, 0.1)
    flux = sensor.excess * sensor.flux / sensor.pixels
    outside_core = wings * np.exp(-STRENGTH.wings_window * sensor.area / sensor.pixels)
    found = np.minimum(np.sqrt(dark + outside_core * flux), np.sqrt(sensor.variance + flux))
    strength = np.where(lost, STRENGTH.lost * noise, found)
    result: NDArray[np.float64] = np.where(off, 0.0, strength)[()]
    return result


def automatic_smoothing(
    flux_e: ArrayLike,
    read_noise_e: ArrayLike,
    *,
    pixels: ArrayLike,
    spot_fwhm_px: ArrayLike,
    elongation: ArrayLike = 1.0,
    excess_noise: ArrayLike = 1.0,
    background_e: ArrayLike = 0.0,
    position_range_px: ArrayLike = 1.0,
    profile: str = "diffraction",
) -> NDArray[np.float64]:
    """Return the standard deviation of Gaussian smoothing, px; 0 where smoothing does not help.

    b (A / 9)^p (1 + g (3 / C)^h) (1 + photon noise of the core / v)^s: about half a pixel, more for faint
    spots.

    Parameters and errors as `automatic_strength`.

    Returns
    -------
    float64 array
        Of the arguments' common shape.

    Notes
    -----
    Source: own Monte-Carlo study, docs/automatic.md.
    """
    sensor = _sensor(
        flux_e,
        read_noise_e,
        pixels,
        spot_fwhm_px,
        elongation,
        excess_noise,
        background_e,
        position_range_px,
        profile,
    )
    lost, off = _lost_and_off(sensor, KEPT["smoothed"])
    base, exponent = SMOOTHING.diffraction, SMOOTHING.photons_diffraction
    if sensor.gaussian:
        base, exponent = SMOOTHING.gaussian, SMOOTHING.photons_gaussian
    noise = np.sqrt(sensor.variance) + SMOOTHING.tail * sensor.excess * sensor.counted
    contrast = np.maximum(sensor.flux / (sensor.area * noise), 1e-3)
    found = base * (1 + SMOOTHING.faint * (3.0 / contrast) ** SMOOTHING.faint_exponent)
    found = found * (1 + sensor.core_photon_variance) ** exponent
    scale = (sensor.area / 9.0) ** SMOOTHING.area_exponent
    result: NDArray[np.float64] = np.where(off, 0.0, scale * np.where(lost, SMOOTHING.lost, found))[()]
    return result


def automatic_kept_pixels(
    flux_e: ArrayLike,
    read_noise_e: ArrayLike,
    *,
    pixels: ArrayLike,
    spot_fwhm_px: ArrayLike,
    elongation: ArrayLike = 1.0,
    excess_noise: ArrayLike = 1.0,
    background_e: ArrayLike = 0.0,
    position_range_px: ArrayLike = 1.0,
    profile: str = "diffraction",
    method: str = "tv",
) -> NDArray[np.int64]:
    """Return how many brightest pixels to keep (`keep_brightest`, rule "subtract_next").

    Pixels whose expected signal exceeds c noises: A * m * ln(1 + C / c), for "diffraction" at most the main
    lobe until C is high; not more than fit between the farthest position and the window's edge. Where the
    spot is lost in noise, N exp(-b (D^2 r^2 / N)^p): many pixels hold the estimate near the middle.

    Parameters and errors as `automatic_strength`, and

    Parameters
    ----------
    method : {"tv", "none", "smoothed"}
        What is done before: TV denoising of `automatic_strength`, nothing, or Gaussian smoothing of
        `automatic_smoothing`.

    Returns
    -------
    int64 array
        Of the arguments' common shape, from 1 to pixels - 1.

    Notes
    -----
    Source: own Monte-Carlo study, docs/automatic.md.
    """
    one_of("method", method, METHODS)
    sensor = _sensor(
        flux_e,
        read_noise_e,
        pixels,
        spot_fwhm_px,
        elongation,
        excess_noise,
        background_e,
        position_range_px,
        profile,
    )
    if method == "none":
        return _whole(_kept_without_denoising(sensor), sensor)
    constants = KEPT[method]
    lost, off = _lost_and_off(sensor, constants)
    if np.all(off):
        return _whole(_kept_without_denoising(sensor), sensor)
    kept = _found(sensor, constants)
    if np.any(lost):
        scaled = sensor.prior_signal * (9.0 / sensor.area) ** constants.shrink_area
        held = sensor.pixels * np.exp(-constants.shrink * scaled**constants.shrink_exponent)
        kept = np.where(lost, np.maximum(held, kept), kept)
    if np.any(off):
        kept = np.where(off, _kept_without_denoising(sensor), kept)
    return _whole(kept, sensor)


class _Sensor(NamedTuple):
    """Flux, camera and window in electrons and pixels; each a number or an array."""

    flux: Any
    excess: Any
    variance: Any  # of a dark pixel
    counted: Any  # the part of it that is the background's
    pixels: Any
    area: Any
    elongation: Any
    range_px: Any
    gaussian: bool

    @property
    def matched_squared(self) -> Any:
        """Return D^2."""
        return self.flux**2 / (self.area * self.variance)

    @property
    def core_photons(self) -> Any:
        """Return q."""
        return self.flux / (self.excess * self.area)

    @property
    def core_photon_variance(self) -> Any:
        """Photon noise of a pixel of the core over the variance of a dark pixel."""
        return self.excess * self.flux / (self.area * self.variance)

    @property
    def prior_signal(self) -> Any:
        """Return D^2 r^2 / N: how far spots move, over the noise of the whole window's centre of gravity."""
        return self.matched_squared * self.range_px**2 / self.pixels

    def contrast(self, constants: Kept) -> Any:
        """Return C."""
        tail = constants.tail * self.excess * self.counted
        return self.flux / (self.area * (np.sqrt(self.variance) + tail))


def _checked(name: str, value: Any, low: float, low_open: bool = False) -> Any:
    """Return a number or array within the range; plain numbers take the short way (for real time)."""
    if type(value) in (float, int) and low < value <= _LARGEST:
        return np.float64(value)
    return numbers_between(name, value, low, _LARGEST, low_open=low_open)[()]


def _sensor(
    flux_e: Any,
    read_noise_e: Any,
    pixels: Any,
    spot_fwhm_px: Any,
    elongation: Any,
    excess_noise: Any,
    background_e: Any,
    position_range_px: Any,
    profile: str,
) -> _Sensor:
    """Check the arguments."""
    one_of("profile", profile, PROFILES)
    flux = _checked("flux_e", flux_e, 0.0)
    read_noise = _checked("read_noise_e", read_noise_e, 0.0)
    n_pixels = np.rint(_checked("pixels", pixels, 4))
    fwhm = _checked("spot_fwhm_px", spot_fwhm_px, SMALLEST_FWHM_PX)
    excess = _checked("excess_noise", excess_noise, 1.0)
    background = _checked("background_e", background_e, 0.0)
    range_px = _checked("position_range_px", position_range_px, 0.0, low_open=True)
    long_axis = _checked("elongation", elongation, 1.0)
    given = (flux, read_noise, n_pixels, fwhm, excess, background, range_px, long_axis)
    if any(np.ndim(value) for value in given):
        try:
            flux = np.broadcast_to(flux, np.broadcast_shapes(*(np.shape(value) for value in given)))
        except ValueError:
            shapes = ", ".join(str(np.shape(value)) for value in given if np.ndim(value))
            raise InputError(f"automatic settings: arguments of shapes {shapes} do not broadcast") from None
    variance = np.maximum(read_noise**2 + excess * background, _SMALLEST_VARIANCE)
    area = _AREA_OF_SQUARED_FWHM[profile] * fwhm**2
    counted = excess * background / variance
    return _Sensor(
        flux, excess, variance, counted, n_pixels, area, long_axis, range_px, profile == "gaussian"
    )


def _lost(sensor: _Sensor, constants: Kept) -> Any:
    """Return where the spot's core does not stand out of the noise of the window's dark pixels."""
    contrast = sensor.contrast(constants) * (sensor.area / 9.0) ** constants.lost_area
    limit = constants.lost * (sensor.pixels / 256.0) ** constants.lost_window
    return contrast * sensor.range_px**constants.lost_range < limit


def _lost_and_off(sensor: _Sensor, constants: Kept) -> tuple[Any, Any]:
    """Return where the spot is lost, and where it is best not to denoise."""
    lost = _lost(sensor, constants)
    off = lost & (sensor.prior_signal < constants.off_lost)
    signal = _signal_with_photons(sensor) * sensor.range_px**2 / sensor.area
    return lost, off | (signal < constants.off) | (sensor.core_photons < constants.off_photons)


def _signal_with_photons(sensor: _Sensor) -> Any:
    """D^2, the photon noise of the spot itself included."""
    return sensor.matched_squared / (1 + FEW.photons * sensor.core_photon_variance)


def _found(sensor: _Sensor, constants: Kept) -> Any:
    """Kept pixels of a spot that stands out of the noise."""
    threshold = constants.threshold * (1 + sensor.core_photon_variance) ** -constants.threshold_photons
    window = np.log1p(sensor.pixels / sensor.area) / 3.4  # 3.4: size 1 in 16 x 16 px
    signal = sensor.contrast(constants) / (threshold * window**constants.threshold_window)
    level, area = np.log1p(signal), sensor.area
    if sensor.gaussian:
        kept = constants.gaussian * (area + constants.gaussian_px) * level
    else:
        core = constants.core * (area + constants.core_px) * level
        wings = constants.wings * (area + constants.wings_px)
        wings = wings * np.log(np.maximum(signal / constants.wings_from, 1.0))
        kept = np.minimum(core, constants.lobe * area + constants.lobe_px) + wings
    if constants is KEPT["none"]:
        kept = kept + _few_photons(sensor)
    margin = np.maximum(np.sqrt(sensor.pixels) / 2 - sensor.range_px, 1.0)
    limit = constants.edge * area * (margin**2 / (area * sensor.elongation)) ** constants.edge_exponent
    return kept / np.sqrt(1 + (kept / limit) ** 2)


def _few_photons(sensor: _Sensor) -> Any:
    """More pixels where each photon stands out and there are few: all count, wherever they fall."""
    base = FEW.gaussian if sensor.gaussian else FEW.diffraction
    rarity = np.exp(-sensor.core_photons / FEW.rarity)
    seen = 1 / (1 + sensor.variance / FEW.variance)
    return base * sensor.area * rarity * seen * sensor.range_px**-FEW.range_exponent


def _kept_without_denoising(sensor: _Sensor) -> Any:
    constants = KEPT["none"]
    found = _found(sensor, constants)
    signal = _signal_with_photons(sensor) * sensor.range_px**2 / sensor.pixels
    held = sensor.pixels * np.exp(-constants.shrink * signal**constants.shrink_exponent)
    return np.where(_lost(sensor, constants), np.maximum(held, found), found)


def _whole(kept: Any, sensor: _Sensor) -> NDArray[np.int64]:
    """Return whole numbers that leave at least one pixel for the background."""
    whole: NDArray[np.int64] = np.minimum(np.maximum(np.rint(kept), 1), sensor.pixels - 1).astype(np.int64)
    return whole
