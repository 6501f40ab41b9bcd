"""Denoising strength, number of kept pixels and smoothing width computed from flux and camera.

The origin of the formulae, the fit of their constants and their accuracy are given in docs/automatic.md. With

    N = pixels of the window, r = range of positions, side = sqrt(N),
    A = noise-equivalent area of the spot, px^2 (1 / sum of f^2, f = fraction of the flux in a pixel),
    v = read_noise^2 + excess * background, variance of a dark pixel, e-^2,
    C = flux / (A * (sqrt(v) + tail)), contrast of the core to the noise of a dark pixel (`tail`: background
      electrons are few and large, so that their noise has higher peaks than sqrt(v) suggests),
    D = flux / sqrt(A v), signal to noise of a matched filter,
    q = flux / (excess * A), photons in a pixel of the core,

the kept pixels are those whose expected signal exceeds c standard deviations of the noise: A / 2 * ln(C / c)
for a Gaussian spot; for a sinc^2 at most its main lobe, until C is high. The strength is the noise that
denoising can remove: the noise of the dark pixels, less the degrees of freedom that remain, and the photon
noise outside the core. If the spot is lost in the noise (small C), the result is an estimate that stays near
the centre of the window; if the noise exceeds the range of positions, the image is not denoised.
"""

from typing import NamedTuple, Required, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.slopes.estimators.automatic_constants import FEW, KEPT, SMOOTHING, STRENGTH, Constants

_Values = np.float64 | NDArray[np.float64]  # one number, or an array
_Truths = np.bool_ | NDArray[np.bool_]

METHODS = ("tv", "none", "smoothed")
PROFILES = ("diffraction", "gaussian")

SMALLEST_FWHM_PX = 0.05
_LARGEST = 1e12
_SMALLEST_VARIANCE = 1e-4  # e-^2, if there is neither read noise nor background
# Noise-equivalent area / FWHM^2; A is (3 size)^2 for both profiles, FWHM is 1.772 size and 2 size (px).
_AREA_OF_SQUARED_FWHM = {"diffraction": 2.866, "gaussian": 2.25}


class Conditions(TypedDict, total=False):
    """Window, spot and camera, for which settings are computed."""

    pixels: Required[ArrayLike]
    """Number of pixels of the window (256 for 16 x 16), which is assumed to be square."""
    spot_fwhm_px: Required[ArrayLike]
    """Full width at half maximum of the optical spot (without the blur of the pixels) [px], at least 0.05;
    for an elongated spot the geometric mean of both axes."""
    elongation: ArrayLike
    """Ratio of the widths along the long and the short axis, at least 1 [default: 1]."""
    excess_noise: ArrayLike
    """Factor on the variance of the photon noise: 2 for an EMCCD at high gain [default: 1]."""
    background_e: ArrayLike
    """Background per pixel [photo-electrons] [default: 0]; its mean is subtracted, its noise remains."""
    position_range_px: ArrayLike
    """Maximum distance of positions from the centre of the window on each axis [default: 1]."""
    profile: str
    """Spot with the wings of a square lenslet's sinc^2, "diffraction" (default), or without, "gaussian"."""


def automatic_strength(
    flux_e: ArrayLike, read_noise_e: ArrayLike, **conditions: Unpack[Conditions]
) -> NDArray[np.float64]:
    """Return the strength of TV denoising (`noise_std`), e-; 0 where denoising does not help.

    sqrt(a^2 v C^(-2 d) (1 - M / N) + w exp(-z A / N) excess flux / N), at most the noise of a mean pixel.
    The first term is the noise of dark pixels, less the part kept by the M degrees of freedom of the
    denoised image; the second is the photon noise outside the core (zero for a Gaussian spot).

    All arguments except `profile` broadcast, so that each sub-aperture may have its own values.

    Parameters
    ----------
    flux_e : float or array
        Photo-electrons of one spot within its window in one frame.
    read_noise_e : float or array
        Standard deviation of the read noise in photo-electrons (for an EMCCD: divided by its gain).
    **conditions
        Values of `Conditions`, of which `pixels` and `spot_fwhm_px` are required.

    Returns
    -------
    float64 array
        Strength, in the common shape of the arguments.

    Raises
    ------
    InputError
        If values are not finite or out of range, shapes do not broadcast, or the profile is unknown.

    Notes
    -----
    Source: authors' Monte-Carlo study, docs/automatic.md; the form follows A. G. Basden et al. 2015 (MNRAS;
    arXiv:1503.06043), where the strength is the noise of the image.
    """
    sensor = _sensor(flux_e, read_noise_e, **conditions)
    lost, off = _lost_and_off(sensor, KEPT["tv"])
    gain = STRENGTH[sensor.profile]
    wings = 0.0 if sensor.profile == "gaussian" else STRENGTH["wings"]
    matched = sensor.matched_squared
    freedom = 1 + (matched / STRENGTH["noise_freedom_at"] ** 2) ** (STRENGTH["noise_freedom_exponent"] / 2)
    freedom = STRENGTH["core_freedom"] * sensor.area + STRENGTH["noise_freedom"] / freedom
    noise = np.sqrt(sensor.variance)
    contrast = np.maximum(sensor.flux / (sensor.area * noise), 1e-3)
    dark = (
        gain * (noise + STRENGTH["tail"] * sensor.excess * sensor.counted) * contrast ** -STRENGTH["decline"]
    )
    dark = dark**2 * np.maximum(1 - freedom / sensor.pixels, 0.1)
    flux = sensor.excess * sensor.flux / sensor.pixels
    outside_core = wings * np.exp(-STRENGTH["wings_window"] * sensor.area / sensor.pixels)
    found = np.minimum(np.sqrt(dark + outside_core * flux), np.sqrt(sensor.variance + flux))
    strength = np.where(lost, STRENGTH["lost"] * noise, found)
    result: NDArray[np.float64] = np.where(off, 0.0, strength)[()]
    return result


def automatic_smoothing(
    flux_e: ArrayLike, read_noise_e: ArrayLike, **conditions: Unpack[Conditions]
) -> NDArray[np.float64]:
    """Return the standard deviation of Gaussian smoothing [px]; 0 where smoothing does not help.

    b (A / 9)^p (1 + g (3 / C)^h) (1 + photon noise of the core / v)^s: about half a pixel, more for faint
    spots.

    Parameters and errors are those of `automatic_strength`.

    Returns
    -------
    float64 array
        Width, in the common shape of the arguments.

    Notes
    -----
    Source: authors' Monte-Carlo study, docs/automatic.md.
    """
    sensor = _sensor(flux_e, read_noise_e, **conditions)
    lost, off = _lost_and_off(sensor, KEPT["smoothed"])
    base, exponent = SMOOTHING[sensor.profile], SMOOTHING[f"photons_{sensor.profile}"]
    noise = np.sqrt(sensor.variance) + SMOOTHING["tail"] * sensor.excess * sensor.counted
    contrast = np.maximum(sensor.flux / (sensor.area * noise), 1e-3)
    found = base * (1 + SMOOTHING["faint"] * (3.0 / contrast) ** SMOOTHING["faint_exponent"])
    found = found * (1 + sensor.core_photon_variance) ** exponent
    scale = (sensor.area / 9.0) ** SMOOTHING["area_exponent"]
    result: NDArray[np.float64] = np.where(off, 0.0, scale * np.where(lost, SMOOTHING["lost"], found))[()]
    return result


def automatic_kept_pixels(
    flux_e: ArrayLike, read_noise_e: ArrayLike, *, method: str = "tv", **conditions: Unpack[Conditions]
) -> NDArray[np.int64]:
    """Return the number of brightest pixels to keep (`keep_brightest`, rule "subtract_next").

    Pixels are kept if their expected signal exceeds c standard deviations: A * m * ln(1 + C / c) pixels.
    For "diffraction" they are limited to the main lobe until C is high. They must fit between the farthest
    position and the edge of the window. If the spot is lost in noise, N exp(-b (D^2 r^2 / N)^p) pixels are
    kept: many pixels hold the estimate near the centre.

    Parameters and errors are those of `automatic_strength`, and

    Parameters
    ----------
    method : {"tv", "none", "smoothed"}
        Preceding step: TV denoising with `automatic_strength`, none, or Gaussian smoothing with
        `automatic_smoothing`.

    Returns
    -------
    int64 array
        Number of pixels from 1 to pixels - 1, in the common shape of the arguments.

    Notes
    -----
    Source: authors' Monte-Carlo study, docs/automatic.md.
    """
    one_of("method", method, METHODS)
    sensor = _sensor(flux_e, read_noise_e, **conditions)
    _, off = _lost_and_off(sensor, KEPT[method])
    kept = np.where(off, _kept(sensor, KEPT["none"]), _kept(sensor, KEPT[method]))
    # At least one pixel is left for the background.
    whole: NDArray[np.int64] = np.minimum(np.maximum(np.rint(kept), 1), sensor.pixels - 1).astype(np.int64)
    return whole


class _Sensor(NamedTuple):
    """Flux, camera and window in electrons and pixels; each a number or an array."""

    flux: _Values
    excess: _Values
    variance: _Values  # of a dark pixel
    counted: _Values  # the part of it due to the background
    pixels: _Values
    area: _Values
    elongation: _Values
    range_px: _Values
    profile: str

    @property
    def matched_squared(self) -> _Values:
        """Return D^2."""
        return self.flux**2 / (self.area * self.variance)

    @property
    def core_photons(self) -> _Values:
        """Return q."""
        return self.flux / (self.excess * self.area)

    @property
    def core_photon_variance(self) -> _Values:
        """Photon noise of a pixel of the core, divided by the variance of a dark pixel."""
        return self.excess * self.flux / (self.area * self.variance)

    @property
    def prior_signal(self) -> _Values:
        """D^2 r^2 / N: range of the spots over the noise of the centre of gravity of the whole window."""
        return self.matched_squared * self.range_px**2 / self.pixels

    def contrast(self, constants: Constants) -> _Values:
        """Return C."""
        tail = constants["tail"] * self.excess * self.counted
        return self.flux / (self.area * (np.sqrt(self.variance) + tail))


def _checked(name: str, value: object, low: float, low_open: bool = False) -> _Values:
    """Return a number or array within the range; plain numbers use a fast path (for real time)."""
    if (type(value) is float or type(value) is int) and low < value <= _LARGEST:
        return np.float64(value)
    return numbers_between(name, value, low, _LARGEST, low_open=low_open)[()]


def _sensor(flux_e: ArrayLike, read_noise_e: ArrayLike, **conditions: Unpack[Conditions]) -> _Sensor:
    """Check the arguments and convert them to electrons and pixels."""
    profile = one_of("profile", conditions.get("profile", PROFILES[0]), PROFILES)
    flux = _checked("flux_e", flux_e, 0.0)
    read_noise = _checked("read_noise_e", read_noise_e, 0.0)
    n_pixels = np.rint(_checked("pixels", conditions["pixels"], 4))
    fwhm = _checked("spot_fwhm_px", conditions["spot_fwhm_px"], SMALLEST_FWHM_PX)
    excess = _checked("excess_noise", conditions.get("excess_noise", 1.0), 1.0)
    background = _checked("background_e", conditions.get("background_e", 0.0), 0.0)
    range_px = _checked("position_range_px", conditions.get("position_range_px", 1.0), 0.0, low_open=True)
    long_axis = _checked("elongation", conditions.get("elongation", 1.0), 1.0)
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
    return _Sensor(flux, excess, variance, counted, n_pixels, area, long_axis, range_px, profile)


def _lost(sensor: _Sensor, constants: Constants) -> _Truths:
    """Return where the core of the spot does not stand out of the noise of the dark pixels."""
    contrast = sensor.contrast(constants) * (sensor.area / 9.0) ** constants["lost_area"]
    limit = constants["lost"] * (sensor.pixels / 256.0) ** constants["lost_window"]
    return contrast * sensor.range_px ** constants["lost_range"] < limit


def _lost_and_off(sensor: _Sensor, constants: Constants) -> tuple[_Truths, _Truths]:
    """Return where the spot is lost, and where denoising is better omitted."""
    lost = _lost(sensor, constants)
    off = lost & (sensor.prior_signal < constants["off_lost"])
    signal = _signal_with_photons(sensor) * sensor.range_px**2 / sensor.area
    return lost, off | (signal < constants["off"]) | (sensor.core_photons < constants["off_photons"])


def _signal_with_photons(sensor: _Sensor) -> _Values:
    """Return D^2 including the photon noise of the spot itself."""
    return sensor.matched_squared / (1 + FEW["photons"] * sensor.core_photon_variance)


def _found(sensor: _Sensor, constants: Constants) -> _Values:
    """Return the number of pixels to keep for a spot that stands out of the noise."""
    threshold = constants["threshold"] * (1 + sensor.core_photon_variance) ** -constants["threshold_photons"]
    window = np.log1p(sensor.pixels / sensor.area) / 3.4  # 3.4: size 1 in 16 x 16 px
    signal = sensor.contrast(constants) / (threshold * window ** constants["threshold_window"])
    level, area = np.log1p(signal), sensor.area
    if sensor.profile == "gaussian":
        kept = constants["gaussian"] * (area + constants["gaussian_px"]) * level
    else:
        core = constants["core"] * (area + constants["core_px"]) * level
        wings = constants["wings"] * (area + constants["wings_px"])
        wings = wings * np.log(np.maximum(signal / constants["wings_from"], 1.0))
        kept = np.minimum(core, constants["lobe"] * area + constants["lobe_px"]) + wings
    if constants is KEPT["none"]:
        kept = kept + _few_photons(sensor)
    margin = np.maximum(np.sqrt(sensor.pixels) / 2 - sensor.range_px, 1.0)
    limit = constants["edge"] * area * (margin**2 / (area * sensor.elongation)) ** constants["edge_exponent"]
    return kept / np.sqrt(1 + (kept / limit) ** 2)


def _few_photons(sensor: _Sensor) -> _Values:
    """Increase the number of pixels if photons are few and each stands out: then all of them contribute."""
    rarity = np.exp(-sensor.core_photons / FEW["rarity"])
    seen = 1 / (1 + sensor.variance / FEW["variance"])
    return FEW[sensor.profile] * sensor.area * rarity * seen * sensor.range_px ** -FEW["range_exponent"]


def _kept(sensor: _Sensor, constants: Constants) -> _Values:
    """Return the number of pixels to keep for any spot; many if it is lost in noise."""
    kept = _found(sensor, constants)
    signal = sensor.prior_signal * (9.0 / sensor.area) ** constants["shrink_area"]
    if constants is KEPT["none"]:
        signal = _signal_with_photons(sensor) * sensor.range_px**2 / sensor.pixels
    held = sensor.pixels * np.exp(-constants["shrink"] * signal ** constants["shrink_exponent"])
    return np.where(_lost(sensor, constants), np.maximum(held, kept), kept)
