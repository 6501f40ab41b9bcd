"""Gain and read noise of a camera from spots that move: photon transfer about spots fitted to the images."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import image_stack, number_between
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.psf_learning import LearntPSF, learn_psf_from_images

_ROUNDS = 2  # of learning the PSF: the noise found in one weights the pixels of the next
_ITERATIONS = 10
_GROUPS = 16  # of images, for standard errors
_STEP_PX = 0.05  # of the PSF's derivatives
_LARGEST_EXCESS = 100.0  # times the expected variance: pixels above that are left out as flickering
_FAINTEST = 8.0  # median flux of a spot in standard errors: below, its own noise spoils the line
_LARGEST_LIKENESS = 0.04  # correlation of neighbouring pixels where there is light
_LIT = 0.1  # of the peak


@dataclass(frozen=True)
class SpotTransfer:
    """Result of `measure_on_spots`; each error is one standard error."""

    gain_e_per_adu: float
    gain_e_per_adu_error: float
    read_noise_adu: float
    """0 where the noise of dark pixels is not above that of their flux."""
    background_adu: float
    """Constant level left in the images."""
    problem: str | None
    """Reason why the gain is not reliable, or None."""


@dataclass(frozen=True)
class _Noise:
    """Variance of a pixel in ADU^2: `dark` + `slope` * its flux in ADU."""

    dark: float
    slope: float

    def of(self, flux: Floats) -> Floats:
        return self.dark + self.slope * np.maximum(flux, 0.0)


@dataclass(frozen=True)
class _Residuals:
    """Residuals of fits to the images, (n, ny, nx) each."""

    scaled: Floats
    """Residuals, divided by the root of `share`."""
    share: Floats
    """Fraction of a pixel's variance that the fit leaves."""
    flux: Floats
    neighbours: Floats
    """(n, ny, nx - 1) product of neighbouring pixels of `left`, less what the fit makes of white noise."""
    significance: Floats
    """(n,) light over its standard error."""

    def part(self, chosen: NDArray[np.bool_]) -> _Residuals:
        return _Residuals(*(getattr(self, field.name)[chosen] for field in fields(self)))


def measure_on_spots(
    images: ArrayLike, *, em_gain: float = 1.0, rng: np.random.Generator | None = None
) -> SpotTransfer:
    """Measure gain and read noise on images of single spots at any positions.

    A PSF is learnt from all images and fitted to each, with position, flux and background of its own. What
    is left has, pixel by pixel, the variance read noise^2 + light / gain, less what the fit takes away, so
    that movements from image to image do not count, however large. Pixels without flux tell the read noise.

    Parameters
    ----------
    images : (n, ny, nx) array, ADU
        Images less the known dark level.
    em_gain : float
        Mean gain of the multiplication register, 1 without.
    rng : numpy.random.Generator, optional

    Returns
    -------
    SpotTransfer

    Raises
    ------
    InputError
        As `training.learn_psf_from_images`: for fewer than 20 spots that tell their position.
    """
    stack = image_stack("images", images).astype(np.float64)
    # Variance in ADU^2 for each ADU of flux, times the gain.
    excess = (2.0 if em_gain > 1 else 1.0) * number_between("em_gain", em_gain, 1.0)
    first_row = stack[:, 0]
    noise = _Noise(float(np.median(np.square(first_row - np.median(first_row)))) + 1e-9, excess)
    for _ in range(_ROUNDS):
        psf, positions, flux, background = _fitted_psf(stack, noise, excess, em_gain, rng)
        for _ in range(2):  # the fit's weights are those of the noise found
            residuals = _residuals(stack - background, psf, positions, flux, noise)
            noise = _line(residuals, noise)
    groups = np.arange(len(stack)) * _GROUPS // len(stack)
    without = [_line(residuals.part(groups != left_out), noise).slope for left_out in range(_GROUPS)]
    slope, error = noise.slope, float(np.std(without)) * (_GROUPS - 1) ** 0.5
    return SpotTransfer(
        excess / slope,
        excess / slope * error / slope,
        noise.dark**0.5,
        background,
        _problem(residuals, noise, error),
    )


def _fitted_psf(
    images: Floats, noise: _Noise, excess: float, em_gain: float, rng: np.random.Generator | None
) -> tuple[PSF, Floats, Floats, float]:
    """Learn the PSF; return it with positions, light (ADU) of the spots and the background (ADU)."""
    gain = excess / noise.slope
    calibration = Calibration(gain_e_per_adu=gain, em_gain=em_gain, read_noise_e=noise.dark**0.5 * gain)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about few sub-pixel positions: repeated where the PSF is kept
        learnt = learn_psf_from_images(images, calibration=calibration, rng=rng)
    adu = em_gain / gain
    return learnt.psf, learnt.positions, learnt.flux_e * adu, float(learnt.background_e[0]) * adu


def _residuals(images: Floats, psf: PSF, positions: Floats, flux: Floats, noise: _Noise) -> _Residuals:
    """Fit position, flux and background of every image by weighted least squares; return what is left."""
    n, shape = len(images), images.shape[1:]

    def spots(*step: float) -> Floats:
        return psf.images(positions + step, shape, flux).reshape(n, -1)

    model = spots(0.0, 0.0)
    slopes = [
        (spots(dx, dy) - spots(-dx, -dy)) / (2 * _STEP_PX) for dx, dy in ((_STEP_PX, 0.0), (0.0, _STEP_PX))
    ]
    terms = np.stack([*slopes, model, np.ones_like(model)], axis=-1)
    size = np.linalg.norm(terms, axis=1, keepdims=True) + 1e-300
    terms /= size
    weighted = terms / noise.of(model)[..., None]
    inverse = np.linalg.pinv(np.einsum("npa,npb->nab", weighted, terms), hermitian=True)
    residual = images.reshape(n, -1) - model
    residual -= np.einsum("npa,nab,nqb,nq->np", terms, inverse, weighted, residual, optimize=True)
    share = 1 - np.einsum("npa,nab,npb->np", terms, inverse, weighted, optimize=True)
    share = np.maximum(share, 1e-3)
    significance = size[:, 0, 2] / np.sqrt(np.maximum(inverse[:, 2, 2], 1e-300))
    residual, share, model = (part.reshape(n, *shape) for part in (residual / np.sqrt(share), share, model))
    terms = (terms / np.sqrt(share).reshape(n, -1, 1)).reshape(n, *shape, -1)
    expected = -np.einsum("nyxa,nab,nyxb->nyx", terms[:, :, 1:], inverse, terms[:, :, :-1], optimize=True)
    neighbours = residual[:, :, 1:] * residual[:, :, :-1] - expected
    return _Residuals(residual, share, model, neighbours, significance)


def _line(residuals: _Residuals, noise: _Noise) -> _Noise:
    """Fit variance = dark + slope * flux; pixels count by what the fit has left of them."""
    variance, flux = np.square(residuals.scaled), residuals.flux
    for _ in range(_ITERATIONS):
        expected = noise.of(flux)
        weight = residuals.share * (variance < _LARGEST_EXCESS * expected) / np.square(expected)
        total, first, second = (float(np.sum(weight * flux**power)) for power in range(3))
        zeroth, moment = float(np.sum(weight * variance)), float(np.sum(weight * variance * flux))
        spread = total * second - first**2
        if spread <= 0:
            break
        slope = (total * moment - first * zeroth) / spread
        dark = (zeroth - slope * first) / total
        noise = _Noise(max(dark, 1e-6 * noise.dark), max(slope, 1e-6 * noise.slope))
    return noise


def _problem(residuals: _Residuals, noise: _Noise, error: float) -> str | None:
    """Return the reason why the gain is not reliable, or None.

    Noise differs from pixel to pixel; what is left of a spot of another shape is alike in neighbours.
    """
    if noise.slope <= 3 * error or np.median(residuals.significance) < _FAINTEST:
        return "the spots are too faint: more flux or more frames are needed"
    scale = np.sqrt(noise.of(residuals.flux))
    illuminated = _illuminated(residuals.flux)
    alike = float(
        np.mean((residuals.neighbours / (scale[:, :, 1:] * scale[:, :, :-1]))[illuminated[:, :, 1:]])
    )
    if alike > _LARGEST_LIKENESS:
        return "the spots' shape changes from frame to frame or from one to the next, or pixels are saturated"
    return None


def _illuminated(flux: Floats) -> NDArray[np.bool_]:
    """Return the mask of pixels with a good part of the peak's flux."""
    return flux >= _LIT * flux.max(axis=(1, 2), keepdims=True)  # type: ignore[no-any-return]


def variance_over_expected(
    images_e: Floats, fitted: LearntPSF, *, dark_variance_e2: float, excess_noise: float
) -> float:
    """Return the variance of lit pixels about fitted spots, over what is expected of them.

    Parameters
    ----------
    images_e : (n, ny, nx) array
        Photo-electrons.
    fitted : LearntPSF
        The spots in them.
    dark_variance_e2, excess_noise : float
        A pixel's variance is expected to be `dark_variance_e2` + `excess_noise` * flux, electrons squared.
    """
    noise = _Noise(max(dark_variance_e2, 1e-6), excess_noise)
    images = np.asarray(images_e, np.float64) - fitted.background_e[0]
    residuals = _residuals(images, fitted.psf, fitted.positions, fitted.flux_e, noise)
    ratio = np.square(residuals.scaled) / noise.of(residuals.flux)
    usual = (ratio < _LARGEST_EXCESS) & _illuminated(residuals.flux)
    return float(np.sum((ratio * residuals.share)[usual]) / np.sum(residuals.share[usual]))
