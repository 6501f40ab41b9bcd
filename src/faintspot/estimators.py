"""Estimators of a spot's position, for stacks of images.

========== ============================================================================ ====================
name       how                                                                          needs
========== ============================================================================ ====================
cog        TV denoising (where asked for), brightest pixels, centre of gravity          strength
smoothed   linear Gaussian smoothing, brightest pixels, centre of gravity
thresholded centre of gravity of what is above a level                                  level
weighted   centre of gravity under a Gaussian weight that follows the spot              spot's width
matched    matched filter: least squares with the PSF                                   PSF
ml         maximum likelihood for Poisson and Gaussian noise                            PSF, read noise
map        the same with a prior on the position; posterior mean at very low light      PSF, read noise
trained    a linear score learnt for the sensor, applied in a few passes                trained score
========== ============================================================================ ====================

`SlopePipeline` uses them on frames; the name is `Settings.estimator`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from faintspot.checks import real_array
from faintspot.errors import InputError
from faintspot.pipeline import SlopePipeline, Slopes
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.sensor.settings import ESTIMATORS, Settings

__all__ = ["ESTIMATORS", "measure"]


def measure(
    images: ArrayLike,
    settings: Settings,
    *,
    calibration: Calibration | None = None,
    psf: PSF | None = None,
    score: TrainedScore | None = None,
    prior: ArrayLike | None = None,
) -> Slopes:
    """Measure the positions of the spots of a stack of images, each image a sub-aperture of its own.

    Parameters
    ----------
    images : (n, ny, nx) array
        ADU; electrons with the default calibration.
    settings : Settings
        Its arrays hold one value per image. Light that is not given (`flux_e`) is the mean of the stack.
    calibration : Calibration, optional
        Without maps: gain, dark level, read noise.
    psf, score
        As `SlopePipeline`; an index holds the PSF or kind of each image.
    prior : (n, 2) array, optional
        Predicted positions, px from the images' centres.

    Returns
    -------
    Slopes
        Arrays of shape (n,); x and y in px from each image's centre.

    Raises
    ------
    InputError
        For images that are not real or not three-dimensional, and as `SlopePipeline`.
    """
    stack = real_array("images", images)
    if stack.ndim != 3:
        raise InputError(f"images: expected shape (n, ny, nx), got {stack.shape}")
    n, ny, nx = stack.shape
    corners = np.column_stack([ny * np.arange(n), np.zeros(n, np.int64)])
    layout = Layout((n * ny, nx), (ny, nx), corners)
    pipeline = SlopePipeline(layout, settings, calibration, psf=psf, score=score)
    return pipeline(stack.reshape(n * ny, nx), prior)
