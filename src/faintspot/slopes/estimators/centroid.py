"""Brightest pixels and centre of gravity."""

from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.statistics import FWHM_TO_STD, mad_std
from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.parallel import run_groups
from faintspot.slopes.kernels.positions.gravity import centroid_stack, subtract_stack

RULES = ("subtract_next", "threshold", "subtract_kth")


def most_kept(pixels: int, rule: str) -> int:
    """Return the largest number of pixels that can be kept; "subtract_next" needs one more to subtract."""
    return pixels - 1 if rule == "subtract_next" else pixels


def threshold_rank(keep: NDArray[np.int64], rule: str) -> NDArray[np.int64]:
    """Return the rank (1 = largest) of the pixel whose value is the threshold."""
    return keep + 1 if rule == "subtract_next" else keep


def brightest_pixels(images: ArrayLike, keep: ArrayLike, *, rule: str = "subtract_next") -> NDArray[Any]:
    """Subtract the background from the `keep` brightest pixels of each image and set the others to zero.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images; computed in float32 if they are float32 or float16, otherwise in float64.
    keep : int or array of int
        Number of pixels k to keep, 1 to ny * nx (one less for "subtract_next"); scalar or broadcastable to
        the leading shape.
    rule : {"subtract_next", "threshold", "subtract_kth"}
        With t the threshold of image g:

        - "subtract_next" [1]_: t is the (k+1)-th largest value, the result max(g - t, 0). Exactly k pixels
          remain, unless some of them equal t; these become zero, too.
        - "threshold": t is the k-th largest value; pixels below t become zero, the others are unchanged. All
          pixels equal to t remain, so that there may be more than k.
        - "subtract_kth": t is the k-th largest value, the result max(g - t, 0); the k-th pixel becomes zero.

    Returns
    -------
    (..., ny, nx) array

    Raises
    ------
    InputError
        If images are not real, finite and at least two-dimensional, `keep` is out of range or its shape does
        not broadcast, or the rule is unknown.

    References
    ----------
    .. [1] Basden, A. G., Myers, R. M. & Gendron, E., 2012, MNRAS 419, 1628, and Basden et al. 2015,
       arXiv:1503.06043.

    Examples
    --------
    >>> import faintspot as fs
    >>> print(fs.brightest_pixels([[1.0, 2.0, 1.0], [2.0, 9.0, 6.0], [1.0, 3.0, 1.0]], 3))
    [[0. 0. 0.]
     [0. 7. 4.]
     [0. 1. 0.]]
    """
    stack = image_stack("images", images)
    one_of("rule", rule, RULES)
    leading, (ny, nx) = stack.shape[:-2], stack.shape[-2:]
    if ny * nx < 2:
        raise InputError(f"images: expected at least 2 pixels, got {ny} x {nx}")
    count = numbers_between(
        f"keep ({ny} x {nx} pixels, rule {rule!r})", keep, 1, most_kept(ny * nx, rule), integer=True
    )
    try:
        count = np.broadcast_to(count, leading)
    except ValueError:
        raise InputError(f"keep: shape {count.shape} does not broadcast to {leading}") from None

    # The kernel is compiled for arrays of one kind, not once more for those that are read-only.
    flat = np.require(stack.reshape(-1, ny * nx), requirements="W")
    rank = np.require(threshold_rank(count.reshape(-1), rule), requirements=["C", "W"])
    result = np.empty_like(flat)
    lanes = lanes_for(flat.dtype)
    subtract = 0.0 if rule == "threshold" else 1.0

    def job(start: int, stop: int, scratch: tuple[object, ...]) -> None:
        subtract_stack(lanes, flat, rank, subtract, start, stop, scratch, result)

    run_groups(job, -(-len(flat) // lanes.width), lanes, (ny, nx))
    return result.reshape(stack.shape)


def centre_of_gravity(images: ArrayLike) -> NDArray[Any]:
    """Return the centre of gravity of each image.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images; computed in float32 if they are float32 or float16, otherwise in float64.

    Returns
    -------
    (..., 2) array
        x (along columns) and y (along rows) in pixels from the image centre: pixel i of n is at
        ``i - (n - 1) / 2``. The result is (0, 0), never NaN, if the sum of the image is not positive or too
        small relative to its values to define a position.

    Raises
    ------
    InputError
        If images are not real, finite and at least two-dimensional.

    Examples
    --------
    >>> import faintspot as fs
    >>> print(fs.centre_of_gravity([[0.0, 0.0, 0.0], [0.0, 3.0, 1.0], [0.0, 0.0, 0.0]]))
    [0.25 0.  ]
    """
    stack = image_stack("images", images)
    ny, nx = stack.shape[-2:]
    # The kernel is compiled for arrays of one kind, not once more for those that are read-only.
    flat = np.require(_scaled_up(stack.reshape(-1, ny * nx)), requirements="W")
    positions = np.empty((len(flat), 2), stack.dtype)
    lanes = lanes_for(flat.dtype)

    def job(start: int, stop: int, scratch: tuple[object, ...]) -> None:
        centroid_stack(lanes, flat, ny, nx, start, stop, scratch, positions)

    run_groups(job, -(-len(flat) // lanes.width), lanes, (ny, nx))
    positions[~np.isfinite(positions).all(axis=1)] = 0.0
    return positions.reshape(*stack.shape[:-2], 2)


def _scaled_up(flat: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return images (n, pixels) in which those with tiny values are multiplied by a power of two.

    The kernel multiplies by the reciprocal of a sum, which overflows if the sum is subnormal.
    """
    limits = np.finfo(flat.dtype)
    largest = np.abs(flat).max(axis=1)
    tiny = (largest > 0) & (largest < limits.tiny / limits.eps)
    if not tiny.any():
        return flat
    # A subnormal number keeps all its digits.
    power = -int(np.log2(limits.tiny)) // 2 + int(limits.nmant)
    scaled = flat.copy()
    scaled[tiny] *= flat.dtype.type(2.0) ** power
    return scaled


_NARROWEST_PX, _WIDEST = 0.5, 0.75  # full width at half maximum; the latter of the window's side
# Squared flux and width of a spot relative to the median of the lenslets, and standard deviations of the
# former: what is beyond is no spot.
_MOST_SQUARED_FLUX, _WIDEST_SPOT, _OUTLYING = 9.0, 1.6, 6.0
# Below this width, the pixels blur a spot to a shape of their own: it is found in a table of the standard
# deviation before. A correlation at lag 1 above this part of that at lag 0 is that of spots, not of noise.
_SHARP_PX, _STD_PX, _CORRELATED = 2.0, np.linspace(0.16, 0.96, 81), 0.05
_AREA_OF_SQUARED_FWHM = np.pi / (2 * np.log(2))  # noise-equivalent area of a Gaussian spot


class SeenSpots(NamedTuple):
    """FWHM [px], including the blur of the pixels, and rms flux of spots in the unit of the images."""

    fwhm_x_px: float
    fwhm_y_px: float
    flux: float


def seen_spots(images: ArrayLike) -> SeenSpots:
    """Measure the width and the flux of spots at unknown positions in their images.

    The mean autocorrelation of the images does not depend on the positions of the spots. Noise contributes
    only at lag 0; the value there is extrapolated from lags 1 and 2 with a Gaussian. The lag at half
    maximum is 1 / sqrt(2) of the full width at half maximum of a Gaussian spot. The flux is that of the
    same spot.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images in any unit, with spots of equal width; hundreds of them if spots are lost in the noise.

    Returns
    -------
    SeenSpots

    Raises
    ------
    InputError
        If images are not finite, smaller than 4 x 4, or show no spots.
    """
    stack: NDArray[np.float64] = image_stack("images", images).astype(np.float64)
    if min(stack.shape[-2:]) < 4:
        raise InputError(f"images: expected at least 4 x 4 pixels, got shape {stack.shape}")
    stack = stack - np.median(stack[..., [0, -1], :])
    stack = stack.reshape(-1, *stack.shape[-2:])
    (x, power_x), (y, power_y) = _along(stack), _along(stack.swapaxes(1, 2))
    flux = np.sqrt(0.5 * (power_x + power_y) * _AREA_OF_SQUARED_FWHM * x * y)
    return SeenSpots(x, y, float(flux))


def _along(images: NDArray[np.float64]) -> tuple[float, float]:
    """Return the width along the last axis, and the mean sum of squares of a noise-free spot."""
    side = images.shape[-1]
    correlation = np.array([np.vdot(images[..., : side - lag], images[..., lag:]) for lag in range(side)])
    width = 0.0
    is_sharp = correlation[1] > _CORRELATED * correlation[0] and not correlation[2] > 0
    if correlation[1] > correlation[2] > 0:
        lag_0 = correlation[1] * (correlation[1] / correlation[2]) ** (1 / 3)
        relative = np.append(1.0, correlation[1:] / lag_0)
        beyond = int(np.argmax(relative < 0.5))
        if beyond > 0:
            before, after = np.log(relative[beyond - 1]), np.log(max(relative[beyond], 1e-9))
            width = float(np.sqrt(2.0) * (beyond - 1 + (before - np.log(0.5)) / (before - after)))
        is_sharp, correlation[0] = 0 < width < _SHARP_PX, lag_0
    if is_sharp:
        model = np.array([_correlation_of_sharp(lag) for lag in (0, 1, 2)])
        ratio = max(correlation[2], 0.0) / correlation[1]
        std = np.interp(ratio, model[2] / model[1], _STD_PX)
        correlation[0] = correlation[1] * np.interp(std, _STD_PX, model[0] / model[1])
        width = float(np.sqrt(std**2 + 1 / 12)) / FWHM_TO_STD
    if not _NARROWEST_PX < width < _WIDEST * side:
        raise InputError("images: expected spots whose width can be measured, found none")
    return width, float(correlation[0]) / len(images)


def _correlation_of_sharp(lag: int) -> NDArray[np.float64]:
    """Return the autocorrelation along an axis of Gaussians integrated over pixels, for each width tried."""
    std = np.sqrt(2.0) * _STD_PX
    places = np.arange(lag - 1, lag + 2)[:, None] / std
    integral = places * scipy.special.ndtr(places) + np.exp(-0.5 * places**2) / np.sqrt(2 * np.pi)
    return np.asarray(std * np.diff(integral, 2, axis=0)[0])


def like_most(images: ArrayLike) -> NDArray[np.bool_]:
    """Return which lenslets show a spot like most others, and no reflection or other extended structure.

    Left out are lenslets whose autocorrelation is far above that of most others, as that of bright
    structures is, or wider. Where spots are lost in the noise, only the former can be measured.

    Parameters
    ----------
    images : (n_frames, n, ny, nx) array
        Images of n lenslets.

    Returns
    -------
    (n,) array of bool
    """
    stack: NDArray[np.float64] = image_stack("images", images).astype(np.float64)
    stack = stack - np.median(stack[..., [0, -1], :])
    reach = max(2, min(stack.shape[-2:]) // 2 + 1)
    correlation = np.zeros((reach, stack.shape[1]))
    for along in (stack, stack.swapaxes(2, 3)):
        for lag in range(1, reach + 1):
            correlation[lag - 1] += np.einsum("fnyx,fnyx->n", along[..., :-lag], along[..., lag:])
    power = correlation[0]
    typical = max(float(np.median(power)), 0.0)
    scatter = mad_std(power)
    kept = power <= _MOST_SQUARED_FLUX * typical + _OUTLYING * scatter
    if typical > scatter:
        below = correlation < 0.5 * power
        width = np.where(below.any(axis=0), below.argmax(axis=0), reach)
        kept &= width <= np.ceil(_WIDEST_SPOT * np.median(width[kept]))
    return np.asarray(kept)
