"""Sodium profile learnt from the mean images of a laser guide star's sub-apertures; spots that follow."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, not_none, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.sensor import PIXEL_BLUR_PX2
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.laser import LaserGuideStar, gaussian_spot
from faintspot.slopes.spots.laser_spots import psf_in_window
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.sodium import SodiumProfile

_ROUNDS = 3  # fluxes and weights follow the profile
_RIDGE = 1e-9  # relative to the mean information on an altitude
_CENTRED = 1e4  # information that the spots are centred, relative to that of the images
_NEGLIGIBLE = 1e-6  # relative weight of a pixel, or relative chi-square
_LEAST_VARIANCE = 1e-6  # relative to the mean of the images
_SMOOTHNESS = 0.1  # expected second difference of the density, relative to its peak
_LARGEST_BLUR_FWHM = 2.0
_SIGNIFICANT = 3.0  # ratio of mean squares (F test) by which spots must fit better than constant images


class SodiumFit(NamedTuple):
    """Sodium profile and flux of each sub-aperture; see `fit_sodium_profile`."""

    profile: SodiumProfile
    flux_e: Floats
    """Flux of the whole spots [electrons], (n,)."""
    chi_square: float
    """Sum of the squared deviations of the mean images, in units of their variance."""
    significance: float
    """Decrease of chi-square by the spots for each free value, relative to what is left for each pixel.

    Relative to constant images; about 1 for images of noise alone."""


@dataclass(frozen=True, eq=False)
class MeanImages:
    """Running mean of images of all sub-apertures and of their slopes; immutable.

    Parameters
    ----------
    images_e : (n, ny, nx) or (n_frames, n, ny, nx) array
        Calibrated images [electrons] of one frame, or of several, which are averaged.
    slopes_px : (n, 2) or (n_frames, n, 2) array
        x and y of the spots in these frames, px from the window centres.
    time_constant_frames : float
        Number of frames after which the weight of a frame has decreased by a factor of e.
    frames : float
        Number of frames averaged. Default: that of `images_e`.

    Raises
    ------
    InputError
        If values are not finite, or shapes differ.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.training import MeanImages
    >>> mean = MeanImages(np.zeros((4, 8, 8)), np.zeros((4, 2)))
    >>> float(mean.updated(np.ones((4, 8, 8)), np.zeros((4, 2))).images_e.mean())
    0.5
    """

    images_e: Any
    slopes_px: Any
    time_constant_frames: float = 10000.0
    frames: float | None = None

    def __post_init__(self) -> None:
        images, slopes = finite_array("images_e", self.images_e), finite_array("slopes_px", self.slopes_px)
        if images.ndim not in (3, 4) or slopes.shape != (*images.shape[:-2], 2):
            raise InputError(
                "images_e, slopes_px: expected shapes (n, ny, nx) and (n, 2), "
                f"got {images.shape} and {slopes.shape}"
            )
        number_between("time_constant_frames", self.time_constant_frames, 1.0)
        count = 1 if images.ndim == 3 else len(images)
        frames = number_between("frames", count if self.frames is None else self.frames, 0.0, low_open=True)
        for name, values, usual in (("images_e", images, 3), ("slopes_px", slopes, 2)):
            mean = (
                values.astype(np.float64) if values.ndim == usual else values.mean(axis=0, dtype=np.float64)
            )
            object.__setattr__(self, name, mean)
        object.__setattr__(self, "frames", float(frames))

    def updated(
        self, images_e: ArrayLike, slopes_px: ArrayLike, *, frames: float | None = None
    ) -> MeanImages:
        """Return the mean with one further frame, with several, or with the mean of `frames` of them.

        Raises
        ------
        InputError
            As for the class.
        """
        new = MeanImages(images_e, slopes_px, frames=frames)
        check_shape("images_e", new.images_e, self.images_e.shape)
        frames = not_none(new.frames)
        part = max(
            frames / (not_none(self.frames) + frames), 1.0 - np.exp(-frames / self.time_constant_frames)
        )
        return replace(
            self,
            images_e=self.images_e + part * (new.images_e - self.images_e),
            slopes_px=self.slopes_px + part * (new.slopes_px - self.slopes_px),
            frames=frames / part,
        )


def fit_sodium_profile(
    mean: MeanImages, star: LaserGuideStar, profile: SodiumProfile, *, dark_variance_e2: ArrayLike = 0.0
) -> SodiumFit:
    """Return the sodium profile that all sub-apertures see, from their mean images.

    The images are linear in the profile: non-negative least squares with the variance of each pixel as
    weight, the spots' centre of gravity at the focus, and a little smoothness. Call it every few seconds with
    the last result to follow the layer.

    Parameters
    ----------
    mean : MeanImages
    star : LaserGuideStar
        Its spot includes the motion of the spots during the mean: see `fit_spot`.
    profile : SodiumProfile
        The profile so far, whose altitudes are kept. It gives the first weights.
    dark_variance_e2 : float or (n, ny, nx) array
        Variance of a dark pixel in one frame [electrons^2]; large for pixels to be ignored.

    Raises
    ------
    InputError
        If shapes differ, a value is out of range, or the images show no spots.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.training import MeanImages, fit_sodium_profile
    >>> star = fs.LaserGuideStar(
    ...     [[0.0, 0.0], [4.0, 0.0]], [-4.0, 0.0], pixel_arcsec=0.5, spot=fs.PSF.analytic("gaussian")
    ... )
    >>> true = star.focused(fs.SodiumProfile.peaks([87e3, 93e3], [4e3, 4e3], [1.0, 1.0]))
    >>> mean = MeanImages(100.0 * star.images(true, (12, 12)), np.zeros((2, 2)), frames=1000)
    >>> found = fit_sodium_profile(mean, star, fs.SodiumProfile.gaussian())
    >>> print(f"{true.std_m / 1e3:.1f} km, {found.profile.std_m / 1e3:.1f} km")
    3.5 km, 3.5 km
    """
    return _constrained(_fitted(mean, star, profile, dark_variance_e2))


def _fitted(
    mean: MeanImages, star: LaserGuideStar, profile: SodiumProfile, dark_variance_e2: ArrayLike
) -> SodiumFit:
    """Return the profile, also where nothing constrains it."""
    dark = numbers_between("dark_variance_e2", dark_variance_e2, 0.0)
    data, shape = mean.images_e, mean.images_e.shape
    if len(star) != len(data):
        raise InputError(f"images_e: expected {len(star)} sub-apertures as the star, got {len(data)}")
    if dark.shape not in ((), shape):
        raise InputError(f"dark_variance_e2: expected one number or shape {shape}, got {dark.shape}")
    if not data.sum() > 0:
        raise InputError(f"images_e: expected flux, got a sum of {data.sum():g}")
    responses = star.responses(profile.altitudes_m, shape[1:], mean.slopes_px)
    flat = responses.reshape(len(data), -1, responses.shape[-1])
    measured = data.reshape(len(data), -1)
    variance = np.broadcast_to(dark, shape).reshape(measured.shape)
    density, centred = profile.density, star.defocus(profile.altitudes_m)
    for _ in range(_ROUNDS):
        shapes = flat @ density
        flux = np.maximum(measured.sum(axis=1) / np.maximum(shapes.sum(axis=1), 1e-3), 0.0)
        weights = _weights(flux, shapes, variance, measured, mean.frames)
        above, below = (weights * shapes * measured).sum(axis=1), (weights * shapes**2).sum(axis=1)
        flux = np.maximum(np.divide(above, below, out=np.zeros_like(above), where=below > 0), 0.0)
        per_density = flux[:, None, None] * flat
        weighted = (weights[:, :, None] * per_density).reshape(-1, per_density.shape[-1])
        normal = weighted.T @ per_density.reshape(weighted.shape)
        right = weighted.T @ measured.ravel()
        density = _solved(normal, right, centred, _SMOOTHNESS * density.max())
        density = SodiumProfile(profile.altitudes_m, density).density
    shapes = flat @ density
    residual = measured - flux[:, None] * shapes
    weights = _weights(flux, shapes, variance, measured, mean.frames)
    chi_square = float((weights * residual**2).sum())
    significance = _significance(weights, measured, chi_square, len(flux) + int(np.count_nonzero(density)))
    return SodiumFit(SodiumProfile(profile.altitudes_m, density), flux, chi_square, significance)


def _significance(weights: Floats, measured: Floats, chi_square: float, free: int) -> float:
    """Return the F ratio of spots relative to constant images."""
    constant = (weights * measured).sum(axis=1) / weights.sum(axis=1)
    without = float((weights * (measured - constant[:, None]) ** 2).sum())
    pixels = int(np.count_nonzero(weights > _NEGLIGIBLE * weights.max()))
    left = max(chi_square, _NEGLIGIBLE * without) / max(pixels - free, 1)
    return float((without - chi_square) / free / left) if left > 0 else 0.0


def _constrained(fit: SodiumFit) -> SodiumFit:
    """Return a fit; refuse one that the images do not constrain."""
    if not fit.significance > _SIGNIFICANT:
        raise InputError(
            "images_e: expected images of spots, got ones that constant images fit as well "
            f"(F ratio {fit.significance:.2g}, expected above {_SIGNIFICANT:g})"
        )
    return fit


def fit_spot(
    mean: MeanImages, star: LaserGuideStar, profile: SodiumProfile, *, dark_variance_e2: ArrayLike = 0.0
) -> tuple[LaserGuideStar, SodiumFit]:
    """Return the star with its spot blurred as much as the mean images show, and the profile.

    Parameters are those of `fit_sodium_profile`; the star's spot is the narrowest possible one.

    Raises
    ------
    InputError
        As for `fit_sodium_profile`.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.training import MeanImages, fit_spot
    >>> profile, known = fs.SodiumProfile.gaussian(), {"pixel_arcsec": 0.5}
    >>> star = fs.LaserGuideStar(
    ...     [[0.0, 0.0], [4.0, 0.0]], [-4.0, 0.0], spot=fs.PSF.analytic("gaussian", size=1.2), **known
    ... )
    >>> mean = MeanImages(100.0 * star.images(profile, (12, 12)), np.zeros((2, 2)), frames=1000)
    >>> narrow = replace(star, spot=fs.PSF.analytic("gaussian", size=0.8))
    >>> found, _ = fit_spot(mean, narrow, profile)
    >>> print(star.spot.fwhm_px.round(1), found.spot.fwhm_px.round(1))
    [[2.5 2.5]] [[2.5 2.5]]
    """
    from scipy.optimize import minimize_scalar

    def blurred(blur_px: float) -> LaserGuideStar:
        return replace(star, spot=star.spot.blurred(blur_px))

    def fitted(blur_px: float) -> SodiumFit:
        return _fitted(mean, blurred(blur_px), profile, dark_variance_e2)

    widest = _LARGEST_BLUR_FWHM * float(star.spot.fwhm_px.mean())
    best = minimize_scalar(
        lambda blur: fitted(blur).chi_square, bounds=(0.0, widest), method="bounded", options={"xatol": 0.01}
    )
    return blurred(float(best.x)), _constrained(fitted(float(best.x)))


def _weights(flux: Floats, shapes: Floats, dark: Floats, measured: Floats, frames: float | None) -> Floats:
    """Return the inverse variance of each pixel of the mean images."""
    least = _LEAST_VARIANCE * float(measured.mean())
    frames = not_none(frames)
    weights: Floats = frames / np.maximum(flux[:, None] * shapes + dark, least)
    return weights


def _solved(normal: Floats, right: Floats, centred: Floats, second_difference: float) -> Floats:
    """Return the non-negative solution of normal equations whose spots are centred, and smooth."""
    from scipy.linalg import solve_triangular
    from scipy.optimize import nnls

    count = len(right)
    scale = float(np.trace(normal)) / count
    curvature = np.diff(np.eye(count), 2, axis=0) / second_difference
    total = normal + curvature.T @ curvature + _RIDGE * scale * np.eye(count)
    centred = centred / np.abs(centred).max()
    total += _CENTRED * scale * np.outer(centred, centred)
    try:
        root = np.linalg.cholesky(total)
        solution: Floats = nnls(root.T, solve_triangular(root, right, lower=True), maxiter=30 * count)[0]
    except (RuntimeError, np.linalg.LinAlgError):
        raise InputError("images_e: expected images of spots, got ones that no profile fits") from None
    return solution


_NARROWEST_PX = 1.2  # spot from which the fit begins
_FEWEST_ALTITUDES, _ALTITUDES = 20, 41
IGNORED_E2 = 1e12
"""Variance of pixels that do not count [electrons^2]."""


@dataclass(frozen=True, eq=False)
class KnownSodium:
    """Profile, spot and fluxes that mean images have shown."""

    star: LaserGuideStar
    """Laser guide star; its spot includes turbulence and the motion of the spots."""
    fit: SodiumFit

    @classmethod
    def learnt(
        cls, mean: MeanImages, star: LaserGuideStar, profile: SodiumProfile, dark_variance_e2: ArrayLike
    ) -> KnownSodium:
        """Return profile and width of the spot, both fitted to mean images.

        Parameters
        ----------
        mean : MeanImages
        star : LaserGuideStar
            The width of its spot does not count.
        profile : SodiumProfile
            First estimate, whose range of altitudes is kept.
        dark_variance_e2 : float or (n, ny, nx) array
            As for `fit_sodium_profile`.

        Raises
        ------
        InputError
            As for `fit_sodium_profile`.
        """
        altitudes = profile.altitudes_m
        if len(altitudes) < _FEWEST_ALTITUDES:
            altitudes = np.linspace(altitudes[0], altitudes[-1], _ALTITUDES)
        narrow = replace(star, spot=gaussian_spot(_NARROWEST_PX))
        star_and_fit = fit_spot(mean, narrow, profile.at(altitudes), dark_variance_e2=dark_variance_e2)
        return cls(*star_and_fit)

    def psf(self, window: tuple[int, int]) -> PSF:
        """Return the PSF of every sub-aperture, for windows (ny, nx)."""
        return psf_in_window(self.star, self.fit.profile, window)

    @property
    def spot_fwhm_arcsec(self) -> float:
        """Full width at half maximum of the spot at a single altitude, without the pixel."""
        width_px = float(self.star.spot.fwhm_px.mean())  # exact for Gaussian spots
        return math.sqrt(max(width_px**2 - PIXEL_BLUR_PX2, 0.0)) * self.star.pixel_arcsec


def calibrated_images(
    frames: ArrayLike, layout: Layout, calibration: Calibration
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return images of every sub-aperture [electrons], 0 in bad pixels, and which pixels are bad.

    Parameters
    ----------
    frames : (h, w) or (n, h, w) array
        In ADU.
    layout : Layout
    calibration : Calibration

    Returns
    -------
    (..., n_subapertures, ny, nx) array, (n_subapertures, ny, nx) array
    """
    dark, electrons_per_adu = layout.images(calibration.maps(layout.frame_shape))
    images = (layout.images(np.asarray(frames)) - dark) * electrons_per_adu
    bad = ~np.isfinite(dark * electrons_per_adu)
    return np.where(np.isfinite(images), images, np.float32(0.0)).astype(np.float32), bad


def dark_variance_e2(layout: Layout, calibration: Calibration) -> Floats:
    """Return the variance of a dark pixel in one frame [electrons^2], (n_subapertures, ny, nx).

    That of bad pixels is so large that they do not count; without a known read noise it is 1.
    """
    noise = calibration.read_noise_map(layout.frame_shape)
    if noise is None:
        noise_e = calibration.read_noise_photoelectrons
        noise = np.full(layout.frame_shape, 1.0 if noise_e is None else noise_e)
    bad = ~np.isfinite(calibration.maps(layout.frame_shape)).all(axis=0)
    variance: Floats = layout.images(np.where(bad, IGNORED_E2, np.nan_to_num(noise) ** 2))
    return variance
