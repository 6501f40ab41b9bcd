"""Cramer-Rao bound on the position of a spot, and the photon efficiency of estimators.

The bound holds for unbiased estimators. An estimator that knows that positions lie within some range can have
a smaller error at low flux.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.slopes.camera.detector import Detector, detector_or_default
from faintspot.slopes.spots.fixed_weights import STEP_PX, images_with_derivatives
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import SpotShape, image_shape, per_spot, position_array, spots

SMALLEST_MEAN_E = 1e-6
"""Pixels with a smaller mean [photo-electrons] count as having it."""
_LARGEST_TABLED_VARIANCE = 40.0  # above it, the expansion of the information is accurate to 5e-4
_SMALLEST_TABLED_NOISE_E = 0.05  # below it, electrons are counted without error


def poisson_gaussian_information(mean_e: Floats, read_noise_e: float) -> Floats:
    """Return the Fisher information about the mean of Poisson electrons with Gaussian read noise [1 / e-^2].

    With v = mean + read_noise^2 it tends to 1 / v + (read_noise^2 / v)^2 / (2 v^2) at large v, where the
    second term is the information in the variance, and to 1 / mean at low read noise. It is tabulated in
    between, and accurate to 5e-4.

    Parameters
    ----------
    mean_e : (...) array
        Mean electrons, from 0.
    read_noise_e : float
        Standard deviation of the read noise, from 0.
    """
    mean = np.maximum(mean_e, SMALLEST_MEAN_E)
    if read_noise_e < _SMALLEST_TABLED_NOISE_E:
        return 1 / mean
    variance = mean + read_noise_e**2
    information: Floats = 1 / variance + np.square(read_noise_e**2 / variance) / (2 * variance**2)
    low = variance < _LARGEST_TABLED_VARIANCE
    if low.any():
        spline = _information_table(read_noise_e)
        information[low] = np.exp(spline(np.log(mean[low])))
    return information


@functools.lru_cache(maxsize=64)
def _information_table(read_noise_e: float) -> Any:
    """Return a spline of the logarithm of the information against the logarithm of the mean.

    p(g) is a sum over electrons k of Poisson(k) Normal(g - k). Since d Poisson(k) / d mean is
    Poisson(k - 1) - Poisson(k), dp/dmean = p(g - 1) - p(g), and the information, the integral of its square
    over p, is the integral of p(g - 1)^2 / p(g), minus 1.
    """
    from scipy.interpolate import CubicSpline
    from scipy.special import gammaln

    log_mean = np.linspace(math.log(SMALLEST_MEAN_E), math.log(_LARGEST_TABLED_VARIANCE), 160)
    mean = np.exp(log_mean)
    per_electron = math.ceil(8 / min(read_noise_e, 1.0))  # samples: the integrand is smooth at this step
    highest = _LARGEST_TABLED_VARIANCE + 10 * math.sqrt(_LARGEST_TABLED_VARIANCE) + 10 * read_noise_e
    lowest = -math.ceil(10 * read_noise_e) - 1
    values = np.arange(lowest * per_electron, math.ceil(highest) * per_electron) / per_electron
    # More electrons than the largest value, so that p does not end before the range of integration.
    electrons = np.arange(math.ceil(highest + 10 * read_noise_e) + 3)
    poisson = np.exp(electrons * log_mean[:, None] - mean[:, None] - gammaln(electrons + 1))
    normal = np.exp(-0.5 * np.square((values - electrons[:, None]) / read_noise_e))
    density = poisson @ normal / (read_noise_e * math.sqrt(2 * math.pi))
    before, after = density[:, :-per_electron], density[:, per_electron:]
    ratio = np.divide(before, after, out=np.zeros_like(before), where=after > 1e-280)
    information = np.sum(np.square(ratio - 1) * after, axis=1) / per_electron
    return CubicSpline(log_mean, np.log(information))


MEAN_ABSOLUTE = math.sqrt(2 / math.pi)
"""Mean absolute value of a standard normal distribution: slope error of an estimator at a bound of 1 px."""

_NOISES = ("exact", "gaussian")
_BRACKET = 1e12  # largest and, inverted, smallest flux tried by photon_efficiency, e-
_FLUX_STEPS_PER_DECADE = 12


class _Spot(NamedTuple):
    """Images of a spot with 1 e- in its window when centred, and their derivatives: (m, pixels)."""

    image: Floats
    along_x: Floats
    along_y: Floats


class _PixelNoise(NamedTuple):
    """Noise of each pixel [photo-electrons]; maps are flattened: (pixels,)."""

    read_noise_e: Floats
    background_e: Floats
    excess: float
    exact: bool


def cramer_rao(
    flux_e: ArrayLike,
    *,
    shape: tuple[int, int] = (16, 16),
    psf: PSF | None = None,
    detector: Detector | None = None,
    positions: ArrayLike = (0.0, 0.0),
    position_range_px: float | None = None,
    unknown_background: bool = False,
    noise: str = "exact",
    **spot_shape: Unpack[SpotShape],
) -> NDArray[np.float64]:
    """Return the Cramer-Rao bound on the standard error of a spot's position.

    The bound is the square root of the diagonal of the inverse Fisher information of (x, y, flux,
    background). With normally distributed errors at the bound, the slope error R (mean absolute error) is
    sqrt(2 / pi) times the mean of the two axes.

    Parameters
    ----------
    flux_e : float or array_like, any shape
        Electrons within the image of a centred spot, as in `faintspot.slopes.simulate.subapertures`; above 0.
    shape : (int, int)
        Rows and columns (ny, nx) of the image, at least 3 px each.
    psf : PSF, optional
        PSF of the spot instead of a shape; of several, the first. Pixels in which it is not positive are
        ignored. Noise in the wings of a learnt PSF increases the apparent information if the read noise is
        low.
    detector : Detector, optional
        Detector that defines the noise; mean background and dark current are known unless
        `unknown_background`. Quantisation counts as read noise of 1/12 ADU squared; full well and
        saturation are ignored. Default: 0.1 e- read noise and no other noise.
    positions : array_like, shape (2,) or (m, 2)
        x and y [px]; the result is the mean over the positions.
    position_range_px : float, optional
        Use positions uniform within plus and minus this on each axis, instead of `positions`.
    unknown_background : bool
        Whether it is estimated along with position and flux.
    noise : {"exact", "gaussian"}
        "exact": information of Poisson electrons plus Gaussian read noise, summed over the number of
        electrons. "gaussian": sum over pixels of (dm/dx)^2 / variance, which is lower at low flux and equal
        at high flux. With a multiplication register both are the latter, with twice the photon noise. This
        is not a strict bound if single electrons can be distinguished and counted.
    **spot_shape
        profile, size, elongation and angle_deg, see `faintspot.slopes.spots.shapes`.

    Returns
    -------
    ndarray, float64, shape of flux_e + (2,)
        Standard error along x and y [px]; infinite if the image has no flux.

    Raises
    ------
    InputError
        If a value is not finite, out of its range or of the wrong shape.

    Examples
    --------
    >>> import faintspot as fs
    >>> camera = fs.slopes.simulate.Detector(read_noise_e=1.0)
    >>> print(fs.cramer_rao([50.0, 500.0], shape=(8, 8), detector=camera).round(3))
    [[0.133 0.133]
     [0.034 0.034]]
    """
    flux: Floats = numbers_between("flux_e", flux_e, 0.0, low_open=True)
    ny, nx = image_shape("shape", shape)
    if min(ny, nx) < 3:
        raise InputError(f"shape: expected at least 3 rows and columns, got ({ny}, {nx})")
    exact = one_of("noise", noise, _NOISES) == "exact"
    points = _positions(positions, position_range_px)
    if psf is None:
        render = functools.partial(spots, shape=(ny, nx), **spot_shape)
        step = 0.01 * number_between("size", spot_shape.get("size", 1.0), 0.0, low_open=True)
    elif spot_shape:
        raise InputError(f"psf: expected no {', '.join(spot_shape)} beside it")
    else:
        render = functools.partial(psf.images, shape=(ny, nx))
        step = STEP_PX
    spot = _with_derivatives(render, points, step)
    blur = _noise(detector, (ny, nx), exact)
    bound = np.empty((*flux.shape, 2))
    for index in np.ndindex(flux.shape):
        covariances = _covariances(float(flux[index]), spot, blur, unknown_background)
        bound[index] = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)).mean(axis=0)
    return bound


def cramer_rao_covariance(
    flux_e: ArrayLike,
    psf: PSF,
    shape: tuple[int, int] = (16, 16),
    *,
    detector: Detector | None = None,
    noise: str = "exact",
) -> NDArray[np.float64]:
    """Return the bound on the covariance of x and y of each PSF's spot at the window centre, of unknown flux.

    Elongated spots, such as those of `faintspot.LaserGuideStar`, have errors that are larger along one
    direction: x and y are then correlated.

    Parameters
    ----------
    flux_e : float or (n_psfs,) array
        Electrons within the image of a centred spot; above 0.
    psf : PSF
    shape : (int, int)
        Rows and columns of the image.
    detector, noise
        As for `cramer_rao`.

    Returns
    -------
    (n_psfs, 2, 2) array
        Covariance [px^2]; infinite variances and no covariance if an image has no information.

    Raises
    ------
    InputError
        As for `cramer_rao`.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> psf = fs.PSF.analytic("gaussian", elongation=3.0, angle_deg=45.0)
    >>> bound = fs.cramer_rao_covariance(200.0, psf)[0]
    >>> print(f"correlation of x and y: {bound[0, 1] / bound[0, 0]:.1f}")
    correlation of x and y: 0.8
    """
    count = len(psf.samples)
    flux = per_spot("flux_e", flux_e, count)
    if not np.all(flux > 0):
        raise InputError(f"flux_e = {flux.min():g}: expected numbers above 0")
    size = image_shape("shape", shape)
    blur = _noise(detector, size, one_of("noise", noise, _NOISES) == "exact")
    bound = np.empty((count, 2, 2))
    for plane in range(count):
        render = functools.partial(psf.images, shape=size, which=plane)
        spot = _with_derivatives(render, np.zeros((1, 2)), STEP_PX)
        bound[plane] = _covariances(float(flux[plane]), spot, blur)[0]
    return bound


def photon_efficiency(error_px: ArrayLike, flux_e: ArrayLike, **conditions: Any) -> NDArray[np.float64]:
    """Return the fraction of its flux that an estimator would need if it reached the Cramer-Rao bound.

    This is (flux at which the slope error R of the bound equals that of the estimator) / (flux used). The
    limit is 1; a larger value means a bias towards the truth, for example by a prior of the estimator.

    Parameters
    ----------
    error_px : float or array_like
        Slope error R of the estimator: mean absolute error of x and y [px], above 0. Multiply a root mean
        square error per axis by `MEAN_ABSOLUTE`.
    flux_e : float or array_like
        Electrons used, defined as in `cramer_rao`; broadcast with `error_px`.
    **conditions
        Spot, detector, positions and unknowns, as for `cramer_rao`.

    Returns
    -------
    ndarray, float64, shape of error_px and flux_e broadcast
        Solved by interpolation on a grid of fluxes, accurate to 1e-3.

    Raises
    ------
    InputError
        As for `cramer_rao`, and if the bound does not reach the error between 1e-12 and 1e12 e-.

    Examples
    --------
    >>> import faintspot as fs
    >>> round(float(fs.photon_efficiency(0.1, 100.0)), 2)
    0.31
    """
    from scipy.interpolate import PchipInterpolator

    error: Floats = numbers_between("error_px", error_px, 0.0, low_open=True)
    used: Floats = numbers_between("flux_e", flux_e, 0.0, low_open=True)
    try:
        error, used = np.broadcast_arrays(error, used)
    except ValueError:
        raise InputError(f"error_px, flux_e: shapes {error.shape} and {used.shape} do not fit") from None

    def slope_error(flux: Floats) -> Floats:
        bound: Floats = MEAN_ABSOLUTE * cramer_rao(flux, **conditions).mean(axis=-1)
        return bound

    low, high = _bracket(slope_error, float(error.min()), float(error.max()), float(np.median(used)))
    steps = 3 + math.ceil(_FLUX_STEPS_PER_DECADE * math.log10(high / low))
    grid = np.geomspace(low, high, steps)
    bounds = slope_error(grid)
    inverse = PchipInterpolator(-np.log(bounds), np.log(grid))
    efficiency: Floats = np.exp(inverse(-np.log(error))) / used
    return efficiency


def _bracket(
    slope_error: Callable[[Floats], Floats], smallest: float, largest: float, start: float
) -> tuple[float, float]:
    """Return two fluxes with slope errors above `largest` and below `smallest`."""
    low = high = start
    while slope_error(np.array(low)) < 1.01 * largest:
        low /= 10
        if low < 1 / _BRACKET:
            raise InputError(f"error_px = {largest:g}: expected an error below that of {1 / _BRACKET:g} e-")
    while slope_error(np.array(high)) > 0.99 * smallest:
        high *= 10
        if high > _BRACKET:
            raise InputError(f"error_px = {smallest:g}: expected an error that {_BRACKET:g} e- can reach")
    return low, high


def _positions(positions: object, position_range_px: float | None) -> Floats:
    """Return positions (m, 2); for a range, the nodes of a regular grid that represents it."""
    if position_range_px is None:
        array = np.asarray(positions)
        return position_array(array[None] if array.ndim == 1 else array)
    half = number_between("position_range_px", position_range_px, 0.0)
    count = min(4 + math.ceil(4 * half), 24)
    line = half * ((2 * np.arange(count) + 1) / count - 1)
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def _with_derivatives(render: Callable[[Floats], Floats], positions: Floats, step: float) -> _Spot:
    """Return images and their derivatives, for a flux of 1 e- in the window of a centred spot."""
    centred = float(np.sum(render(np.zeros((1, 2)))))
    if not centred > 0:
        raise InputError("psf: expected images with flux, got none")
    arrays = images_with_derivatives(render, positions, step)
    image, along_x, along_y = (np.reshape(array, (len(positions), -1)) / centred for array in arrays)
    # The wings of a learnt PSF scatter around zero; their slope carries no information there.
    illuminated = image > 0
    return _Spot(np.where(illuminated, image, 0.0), along_x * illuminated, along_y * illuminated)


def _noise(detector: object, shape: tuple[int, int], exact: bool) -> _PixelNoise:
    """Return the noise of each pixel in photo-electrons, flattened."""
    camera = detector_or_default(detector)
    excess = camera.excess_noise_factor
    # Take the background electrons from the variance that the detector itself reports.
    dark = camera.variance(np.zeros(shape))
    converter = camera.gain_e_per_adu**2 / 12 if camera.bits is not None else 0.0
    read_variance = (np.square(camera.read_noise_e) + converter) / camera.em_gain**2
    background = np.maximum(dark - read_variance, 0.0) / excess
    read_noise = np.broadcast_to(np.sqrt(read_variance), shape)
    return _PixelNoise(read_noise.ravel(), background.ravel(), excess, exact and excess == 1)


def _covariances(flux: float, spot: _Spot, noise: _PixelNoise, unknown_background: bool = False) -> Floats:
    """Return the bound on the covariance of x and y at each position, (m, 2, 2)."""
    weight = _pixel_information(flux * spot.image + noise.background_e, noise)
    derivatives = [flux * spot.along_x, flux * spot.along_y, spot.image]
    if unknown_background:
        derivatives.append(np.ones_like(spot.image))
    stack = np.stack(derivatives, axis=1)
    information = np.einsum("map,mbp,mp->mab", stack, stack, weight, optimize=True)
    # In units of the error of each unknown, the matrix is well conditioned at any flux.
    scale = np.sqrt(np.diagonal(information, axis1=1, axis2=2))
    illuminated = np.all(scale > 0, axis=1)
    covariances = np.full((len(scale), 2, 2), np.diag([math.inf, math.inf]))
    if illuminated.any():
        scale = scale[illuminated]
        inverse = np.linalg.inv(information[illuminated] / (scale[:, :, None] * scale[:, None, :]))
        covariances[illuminated] = (inverse / (scale[:, :, None] * scale[:, None, :]))[:, :2, :2]
    return covariances


def _pixel_information(mean_e: Floats, noise: _PixelNoise) -> Floats:
    """Return the Fisher information of each pixel value about its mean [1 / e-^2]; (m, pixels)."""
    if not noise.exact:
        # The floor avoids division by zero for noise-free pixels.
        variance = noise.excess * mean_e + np.square(noise.read_noise_e)
        return 1 / np.maximum(variance, SMALLEST_MEAN_E)
    information = np.empty_like(mean_e)
    for read_noise in np.unique(noise.read_noise_e):
        pixels = noise.read_noise_e == read_noise
        information[:, pixels] = poisson_gaussian_information(mean_e[:, pixels], float(read_noise))
    return information
