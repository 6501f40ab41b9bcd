"""Noise of the pixels, and the denoising strength suggested by it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.statistics import MAD_TO_STD


def suggested_strength(
    read_noise_e: ArrayLike, flux_e: ArrayLike, pixels: int, *, excess_noise: float = 1.0
) -> NDArray[np.float64]:
    """Return a suitable strength (`noise_std`): sqrt(read_noise^2 + 0.25 * excess_noise * flux / pixels).

    The full photon noise, flux / pixels, would smooth the spot itself; a quarter of it was best in
    Monte-Carlo simulations at 0.1 e- of read noise. At 1 e- and more and low flux, 0.85 of the result is
    better. If the size of the spot is known, `estimators.algorithms.automatic.automatic_strength` is closer
    to the optimum.

    Parameters
    ----------
    read_noise_e : float or array
        Standard deviation of the read noise in electrons (for an EMCCD: divided by its gain).
    flux_e : float or array
        Flux of one sub-aperture in one frame [electrons].
    pixels : int
        Number of pixels of a sub-aperture.
    excess_noise : float
        Factor on the variance of the photon noise: 2 for an EMCCD at high gain.

    Raises
    ------
    InputError
        If a value is negative or NaN.
    """
    read_noise = numbers_between("read_noise_e", read_noise_e, 0.0)
    flux = numbers_between("flux_e", flux_e, 0.0)
    number_between("pixels", pixels, 1, integer=True)
    excess = number_between("excess_noise", excess_noise, 1.0)
    strength: NDArray[np.float64] = np.sqrt(read_noise**2 + 0.25 * excess * flux / pixels)
    return strength


def pixel_noise(images: ArrayLike) -> float:
    """Estimate the standard deviation of the noise of pixels far from the spots.

    The first and last rows of every image are used, where spots are faintest. With several frames of the
    same sub-apertures, the estimate is the median absolute difference of a pixel in successive frames,
    scaled to the standard deviation of a normal distribution. With one frame, it is that of neighbours in a
    row, which the wings of spots increase.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images; with four dimensions, the first one is the frame.

    Returns
    -------
    float
        Standard deviation in the unit of the images.

    Raises
    ------
    InputError
        If images are not finite or narrower than two pixels.
    """
    stack: NDArray[np.generic] = image_stack("images", images)
    if stack.shape[-1] < 2:
        raise InputError(f"images: expected at least 2 columns, got shape {stack.shape}")
    edges = stack[..., [0, -1], :].astype(np.float64)
    several_frames = edges.ndim == 4 and len(edges) > 1
    differences = np.diff(edges, axis=0 if several_frames else -1)
    if several_frames and differences.any():  # frames that a grabber wrote twice show no noise
        differences = differences[differences.any(axis=(1, 2, 3))]
    return float(MAD_TO_STD * np.median(np.abs(differences - np.median(differences))) / np.sqrt(2.0))
