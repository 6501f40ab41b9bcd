"""Noise of each pixel, pixels that blink or are hot, and use, of the dark of `faintspot layout`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray

from faintspot.base.statistics import MAD_TO_STD
from faintspot.cli.layout.options import is_number
from faintspot.io.frames import open_frames
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.dark_frames import FEWEST_FRAMES, DarkPixels
from faintspot.slopes.camera.photon_transfer import measure_detector

_MOST_NUMBERS = 1 << 27  # read at a time


def measured_darks(location: str | None) -> DarkPixels | None:
    """Return the pixels of a file of dark frames; None for a number, few frames, or frames with NaN."""
    if location is None or is_number(location):
        return None
    with open_frames([location]) as frames:
        most = _MOST_NUMBERS // (frames.shape[0] * frames.shape[1])
        if min(frames.n_frames, most) < FEWEST_FRAMES or min(frames.shape) < 4:
            return None
        darks = frames.block(0, min(frames.n_frames, most))
    return measure_detector(darks=darks).pixels if np.isfinite(darks).all() else None


def with_measured_pixels(
    calibration: Calibration, pixels: DarkPixels, *, keeps_noise: bool
) -> tuple[Calibration, list[str]]:
    """Return the calibration with the noise map and further bad pixels, and lines that describe them."""
    notes = []
    if not keeps_noise:
        electrons_per_adu = replace(calibration, bad_pixels=None).maps(pixels.noise_adu.shape)[1]
        noise = pixels.noise_adu * electrons_per_adu * calibration.em_gain
        calibration = replace(calibration, read_noise_e=noise)
        rms, median = calibration.typical_read_noise_e, float(np.nanmedian(calibration.read_noise_e))
        notes.append(f"  read noise of each pixel from the darks: median {median:.3g} e-, rms {rms:.3g} e-")
    found = np.concatenate([pixels.blinking, pixels.hot])
    if len(found):
        calibration = calibration.with_bad_pixels(found)
        notes.append(f"  {len(pixels.blinking)} pixels that blink and {len(pixels.hot)} hot ones masked")
    return calibration, notes


def clearer_frame(
    mean: NDArray[np.float64], calibration: Calibration
) -> tuple[NDArray[np.float64], list[str]]:
    """Return the frame with or without the structure of its dark, whichever shows spots better.

    Spots are found above their own background, so that a dark helps only where it takes off a pattern. A
    noisy one, or one that was taken with light, adds one.

    Parameters
    ----------
    mean : (h, w) array
        Calibrated frame, NaN in bad pixels.
    calibration : Calibration

    Returns
    -------
    (h, w) array
    list of str
        A line on a dark that is not used.
    """
    if not isinstance(calibration.dark, np.ndarray):
        return mean, []
    dark, electrons_per_adu = calibration.maps((mean.shape[0], mean.shape[1]))
    without = mean + (dark - np.nanmedian(dark)) * electrons_per_adu
    if _roughness(mean) <= _roughness(without):
        return mean, []
    return without, [
        "  the sub-apertures were found without the dark, which adds noise or structure as large as spots"
    ]


def _roughness(image: NDArray[np.float64]) -> float:
    """Return the standard deviation of structures as large as spots, between these."""
    filled = np.where(np.isfinite(image), image, np.nanmedian(image))
    band = scipy.ndimage.gaussian_filter(filled, 1.0) - scipy.ndimage.gaussian_filter(filled, 4.0)
    return MAD_TO_STD * float(np.median(np.abs(band - np.median(band))))
