"""Slopes of images that lie in no frame."""

from numpy.typing import ArrayLike

from faintspot.base.checks import check_shape, real_array
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF


def measure_images(
    images: ArrayLike,
    settings: Settings | Estimator,
    *,
    calibration: Calibration | None = None,
    psf: PSF | None = None,
    weights: FixedWeights | None = None,
    prior: ArrayLike | None = None,
) -> Slopes:
    """Measure the positions of the spots in a stack of images, each image a separate sub-aperture.

    Parameters
    ----------
    images : (n, ny, nx) array
        Images [ADU]; electrons with the default calibration.
    settings : Settings or Estimator
        Arrays in it hold one value per image. If `flux_e` is not given, the mean flux of the stack is used.
    calibration : Calibration, optional
        Gain, dark level and read noise; maps are not allowed.
    psf, weights
        As for `SlopePipeline`; an index holds the PSF or kind of each image.
    prior : (n, 2) array, optional
        Predicted positions, px from the image centres.

    Returns
    -------
    Slopes
        Arrays of shape (n,); x and y in px from the image centres.

    Raises
    ------
    InputError
        If the images are not real or not three-dimensional, and as for `SlopePipeline`.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> images, truth = fs.slopes.simulate.subapertures(2000, flux_e=100.0, rng=np.random.default_rng(1))
    >>> for settings in (fs.Settings("brightest", keep_brightest=12), fs.Settings(noise_std=0.5)):
    ...     slopes = fs.measure_images(images, settings)
    ...     error = np.abs(np.stack([slopes.x, slopes.y], axis=1) - truth).mean()
    ...     print(f"{settings.estimator.name}: R = {error:.3f} px")
    brightest: R = 0.077 px
    tv: R = 0.073 px
    """
    stack = real_array("images", images)
    check_shape("images", stack, ("n", "ny", "nx"))
    n, ny, nx = stack.shape
    layout = Layout.stacked(n, (ny, nx))
    pipeline = SlopePipeline(layout, settings, calibration, psf=psf, weights=weights)
    return pipeline(stack.reshape(n * ny, nx), prior)
