"""What an estimator needs, and how that is said when it is missing."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.errors import InputError
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.sensor.settings import AUTO, Settings


def is_auto(value: Any) -> bool:
    """Say whether a setting is to be found by itself."""
    return isinstance(value, str) and value == AUTO


def is_automatic(settings: Settings) -> bool:
    """Say whether strength or number of kept pixels follow from the light."""
    return is_auto(settings.noise_std) or is_auto(settings.keep_brightest)


def check_parts(
    settings: Settings,
    calibration: Calibration,
    psf: PSF | None,
    score: TrainedScore | None,
    *,
    lacks_width: bool,
    n: int,
) -> None:
    """Refuse an estimator that lacks what it needs.

    Parameters
    ----------
    lacks_width : bool
        Whether the width of some spot is not known.
    n : int
        Number of sub-apertures.

    Raises
    ------
    InputError
        When something is missing, or a score is for another number of sub-apertures.
    """
    name = settings.estimator
    automatic = is_automatic(settings) and name in ("cog", "smoothed")
    wanted_by = 'settings "auto"' if automatic else f"estimator {name!r}"
    if name in ("matched", "ml", "map") and psf is None:
        raise InputError(f"psf: expected a PSF for {wanted_by}, got none; faintspot.learn_psf makes one")
    if name == "trained" and score is None:
        raise InputError(
            f"score: expected a TrainedScore for {wanted_by}, got none; faintspot.train_estimator makes one"
        )
    kinds = None if score is None else score.index
    if name == "trained" and kinds is not None and len(kinds) != n:
        raise InputError(f"score.index: expected {n} numbers, one per sub-aperture, got {len(kinds)}")
    if (name in ("ml", "map") or automatic) and calibration.read_noise_e is None:
        raise InputError(
            f"calibration.read_noise_e: expected the read noise (electrons) for {wanted_by}, got none"
        )
    if (name == "weighted" or automatic) and lacks_width:
        raise InputError(
            f"settings.spot_fwhm_px: expected the spots' width (px), or a PSF, for {wanted_by}, got none"
        )
    if name == "thresholded" and np.isnan(settings.values("threshold_e", n, 2).astype(float)).any():
        raise InputError(f"settings.threshold_e: expected a level (electrons) for {wanted_by}, got none")
