"""Settings to begin with, from the flux, noise and spot width that a few frames show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.algorithms.automatic import automatic_kept_pixels, automatic_smoothing, is_lost
from faintspot.algorithms.noise import pixel_noise
from faintspot.algorithms.spot_width import SeenSpots, seen_spots
from faintspot.base.errors import InputError
from faintspot.camera.calibration import Calibration
from faintspot.pipeline.settings import Settings
from faintspot.pipeline.slope_pipeline import SlopePipeline
from faintspot.sensor.layout import Layout

_PIXEL_BLUR_PX2 = 0.46  # that a pixel adds to the square of a spot's full width at half maximum
_LEAST_RANGE_PX = 1.0
_FEWEST_PX = 4  # of a window's side; below, as in quad cells, every pixel counts
_RANGE_OF_DISPLACEMENT, _RANGE_OF_FWHM, _RANGE_OF_LOST = 1.5, 2.0, 0.5
_WIDTH_OF_WINDOW = 0.25  # of the window's side, where no spot is seen
_MOST = 0.98  # quantile of the displacements
_NOISE_E = 1e4  # at which photon noise does not count
_LARGEST_E, _LEAST_NOISE = 9e8, 1e-6  # flux; noise over flux


@dataclass(frozen=True)
class FirstSettings:
    """Settings to begin with, and the noise and flux from which they follow, in the frames' unit.

    Parameters
    ----------
    settings : Settings
    noise : float
        Standard deviation of a pixel far from the spots.
    flux : float
        Of a spot in a frame; 0 where no spots are seen.
    lost : bool
        Whether the spots of single frames are lost in the noise.
    """

    settings: Settings
    noise: float
    flux: float
    lost: bool


def first_settings(layout: Layout, calibration: Calibration, frames: NDArray[Any]) -> FirstSettings:
    """Choose settings from a few frames of typical flux; they follow the unit of the frames.

    Gaussian smoothing and brightest pixels by the rules of `faintspot.algorithms.automatic`, with the noise
    that the frames show far from the spots. Photon noise is left out, because it depends on the gain. A fixed
    Gaussian window over their mean flux where spots are lost in the noise; the centre of gravity in windows
    narrower than 4 px.

    Parameters
    ----------
    layout : Layout
    calibration : Calibration
    frames : (n, h, w) array, ADU

    Returns
    -------
    FirstSettings
    """
    pipeline = SlopePipeline(layout, Settings("brightest"), calibration)
    images = pipeline.explain(frames).calibrated
    noise = pixel_noise(images)
    if min(layout.window) < _FEWEST_PX:
        sums = images.sum(axis=(-2, -1), dtype=np.float64)
        return FirstSettings(Settings("centroid"), noise, max(float(np.median(sums)), 0.0), False)
    try:
        spots = seen_spots(images)
    except InputError:
        side = _WIDTH_OF_WINDOW * min(layout.window)
        return FirstSettings(_window(SeenSpots(side, side, 0.0), _LEAST_RANGE_PX), noise, 0.0, True)
    noise = max(noise, _LEAST_NOISE * spots.flux)
    width = max(spots.fwhm_x_px, spots.fwhm_y_px)
    displacement = 0.0
    averaged = _smoothed(layout, noise / math.sqrt(len(images)), spots)
    if averaged is not None:
        found = pipeline.with_settings(averaged).for_images()(np.vstack(images.mean(axis=0))[None])
        seen = np.abs([found.x[found.valid], found.y[found.valid]])
        displacement = _RANGE_OF_DISPLACEMENT * float(np.quantile(seen, _MOST)) if seen.size else 0.0
    settings = _smoothed(layout, noise, spots)
    if settings is None:
        reach = max(displacement, _RANGE_OF_LOST * width, _LEAST_RANGE_PX)
        return FirstSettings(_window(spots, reach), noise, spots.flux, True)
    reach = max(displacement + _RANGE_OF_FWHM * width, _LEAST_RANGE_PX)
    if reach < min(layout.window) / 2:
        settings = settings.replace(search_range_px=_rounded(reach))
    return FirstSettings(settings, noise, spots.flux, False)


def _smoothed(layout: Layout, noise: float, spots: SeenSpots) -> Settings | None:
    """Return settings by the automatic rules; None where spots are lost in this noise."""
    seen = np.square([spots.fwhm_x_px, spots.fwhm_y_px])
    optical = np.sqrt(np.maximum(seen - _PIXEL_BLUR_PX2, 0.25 * seen))
    sensor: dict[str, Any] = {
        "flux_e": min(spots.flux / noise * _NOISE_E, _LARGEST_E),
        "read_noise_e": _NOISE_E,
        "pixels": layout.pixels,
        "spot_fwhm_px": float(np.sqrt(optical.prod())),
        "elongation": float(optical.max() / optical.min()),
    }
    if is_lost(**sensor):
        return None
    kept, width = automatic_kept_pixels(**sensor, method="smoothed"), automatic_smoothing(**sensor)
    return Settings("smoothed", smoothing_px=_rounded(width), keep_brightest=int(kept))


def _window(spots: SeenSpots, reach: float) -> Settings:
    known = {"flux_e": _rounded(spots.flux)} if spots.flux > 0 else {}
    width = {
        "spot_fwhm_px": _rounded(spots.fwhm_x_px),
        "spot_fwhm_y_px": _rounded(spots.fwhm_y_px),
        "search_range_px": _rounded(reach),
    }
    return Settings("window", **width, **known)


def _rounded(value: Any) -> float:
    return float(f"{float(value):.3g}")
