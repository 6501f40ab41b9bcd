"""How much noise a pixel has, and which strength to give the denoiser."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack, number_between, numbers_between
from faintspot.base.errors import InputError

_MAD_TO_STD = 1.4826  # of a normal distribution


def suggested_strength(
    read_noise_e: ArrayLike, flux_e: ArrayLike, pixels: int, *, excess_noise: float = 1.0
) -> NDArray[np.float64]:
    """Return a strength (`noise_std`) that works: sqrt(read_noise^2 + 0.25 * excess_noise * flux / pixels).

    The full photon noise, flux / pixels, would smooth the spot itself; a quarter of it was found best in
    Monte-Carlo studies at 0.1 e- of read noise. At 1 e- and more and low flux, 0.85 of the result is better.
    Where the spot's size is known, `faintspot.algorithms.automatic.automatic_strength` is nearer the best.

    Parameters
    ----------
    read_noise_e : float or array
        Standard deviation of the read noise in electrons (for an EMCCD: divided by its gain).
    flux_e : float or array
        Electrons of one sub-aperture in one frame.
    pixels : int
        Number of pixels of a sub-aperture.
    excess_noise : float
        Factor on the photon noise's variance: 2 for an EMCCD at high gain.

    Raises
    ------
    InputError
        For negative or NaN values.
    """
    read_noise = numbers_between("read_noise_e", read_noise_e, 0.0)
    flux = numbers_between("flux_e", flux_e, 0.0)
    number_between("pixels", pixels, 1, integer=True)
    excess = number_between("excess_noise", excess_noise, 1.0)
    strength: NDArray[np.float64] = np.sqrt(read_noise**2 + 0.25 * excess * flux / pixels)
    return strength


def pixel_noise(images: ArrayLike) -> float:
    """Estimate the standard deviation of the noise of pixels far from the spots.

    Looks at the first and last row of every image, where spots are faintest. With several frames of the same
    sub-apertures, the median absolute difference of a pixel in successive frames; with one, that of
    neighbours in a row, which light from a spot's wings makes too large. Both as a normal distribution's
    standard deviation.

    Parameters
    ----------
    images : (..., ny, nx) array
        With four dimensions, the first one counts frames.

    Returns
    -------
    float
        In the unit of the images.

    Raises
    ------
    InputError
        For images that are not finite or narrower than two pixels.
    """
    stack: NDArray[Any] = image_stack("images", images)
    if stack.shape[-1] < 2:
        raise InputError(f"images: expected at least 2 columns, got shape {stack.shape}")
    edges = stack[..., [0, -1], :].astype(np.float64)
    several_frames = edges.ndim == 4 and len(edges) > 1
    differences = np.diff(edges, axis=0 if several_frames else -1)
    return float(_MAD_TO_STD * np.median(np.abs(differences - np.median(differences))) / np.sqrt(2.0))
