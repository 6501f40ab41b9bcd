"""Learning a sensor's PSF from recorded frames alone, low-light ones if need be."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import check_shape, not_none, number_between, numbers_between, one_of, real_array
from faintspot.base.errors import InputError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.noise import pixel_noise
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.psf_rounds import (
    Learning,
    LearningOptions,
    check_phases,
    gaussian_psf,
    measured_width,
    psf_of,
    usable_subapertures,
)
from faintspot.slopes.training.registration import Registered, Stack

SCOPES = ("sensor", "subaperture")

_SHARED_ROUNDS = 2  # in which all spots have one PSF, before each region gets its own
_PSFS_AT_ONCE = 32
_BACKGROUND_ROUNDS = 4  # of spots and background in turn
_COUNTABLE_E = 0.25  # read noise below which images hold whole electrons


@dataclass(frozen=True)
class LearntPSF:
    """A learnt PSF, and what was found on the way."""

    psf: PSF
    background_e: NDArray[np.float64]
    """Constant flux left in the images, electrons per pixel, for each PSF."""
    positions: NDArray[np.float64]
    """Positions of the spots, (n, 2): x and y, px from the image's centre."""
    flux_e: NDArray[np.float64]
    """Fluxes of the spots, (n,)."""
    standard_error_px: NDArray[np.float64]
    """Standard errors of the positions, (n, 2)."""


class PSFOptions(TypedDict, total=False):
    """Options of `checked_options`."""

    oversampling: int
    radius_px: int | None
    rounds: int


def learn_psf(
    frames: ArrayLike,
    layout: Layout,
    calibration: Calibration | None = None,
    *,
    scope: str | ArrayLike = "sensor",
    start: PSF | float | None = None,
    rng: np.random.Generator | None = None,
    progress: Callable[[float], object] | None = None,
    **options: Unpack[PSFOptions],
) -> PSF:
    """Learn the PSF of a sensor from recorded frames; nothing else needs to be known about the spots.

    Spots are registered by maximum likelihood with the PSF so far, stacked where they may be given the errors
    of that registration, and a new PSF is fitted to the stack by weighted least squares, together with a
    constant background; eight times. The PSF is taken to be point-symmetric (a lenslet's asymmetry ends up in
    its reference position): a product of two profiles on splines with nodes every half pixel, along the
    pixels' or the spot's own axes, and what is not a product as far as it predicts spots held out.

    Parameters
    ----------
    frames : (h, w) or (n, h, w) array, ADU
        NaN, infinite and saturated pixels are left out, and sub-apertures that are dark, limited or unlike
        their neighbours, which a warning says. A few hundred spots will do, even of 30 electrons; they must
        lie at different sub-pixel positions.
    layout : Layout
    calibration : Calibration, optional
        Default: frames are in electrons already. The read noise is measured where it is not given.
    scope : "sensor" | "subaperture" | (n_subapertures,) array of int
        What has one PSF: the whole sensor, each sub-aperture (elongated spots of a laser guide star), or all
        sub-apertures with the same number.
    start : PSF or float, optional
        The PSF to begin with, or a spot's full width at half maximum, px. Default: measured.
    rng : numpy.random.Generator, optional
    progress : callable, optional
        Called with the fraction done.
    **options
        oversampling: nodes per pixel of the result, 2, 4 or 8 [default: 4]. radius_px: beyond it the PSF is
        zero [default: half the smaller side of the windows]. rounds: at least 4 [default: 8].

    Returns
    -------
    PSF

    Raises
    ------
    InputError
        For values out of range, fewer than 20 spots that tell their position, or spots all at one sub-pixel
        position (a warning, where they only lie close together).

    Notes
    -----
    Effective PSFs from stars at many sub-pixel positions: Anderson & King 2000, PASP 112, 1360. Drawing the
    positions from their posterior is the Monte-Carlo expectation step of Wei & Tanner 1990, JASA 85, 699;
    stacked at the measured positions instead, noise sharpens the peak.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> layout = fs.Layout.grid((4, 4), pixels=12)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 40, flux_e=150.0, rng=np.random.default_rng(1)
    ... )
    >>> psf = fs.learn_psf(frames, layout, rng=np.random.default_rng(2))
    >>> print(f"{psf.fwhm_px.mean():.1f} px; in truth {fs.PSF.analytic().fwhm_px.mean():.1f}")
    1.9 px; in truth 1.9
    """
    calibration = Calibration() if calibration is None else calibration
    stack = frame_stack(frames, layout, calibration)
    checked = checked_options(layout.window, **options)
    regions = _regions(scope, len(layout))
    usable, left_out = usable_subapertures(np.asarray(frames), layout, calibration)
    if left_out:
        warnings.warn(f"PSF: {left_out}", stacklevel=2)
    numbers = np.zeros(len(layout), np.int64)
    numbers[usable] = np.unique(regions[usable], return_inverse=True)[1]
    n_frames = len(stack.images) // len(layout)
    stack, index = stack.part(np.tile(usable, n_frames)), np.tile(numbers[usable], n_frames)
    learnt = _learn(stack, index, start, checked, rng, progress)
    return PSF(learnt.psf.samples, checked.oversampling, None if len(learnt.psf.samples) == 1 else numbers)


def learn_psf_from_images(
    images: ArrayLike,
    calibration: Calibration | None = None,
    *,
    index: ArrayLike | None = None,
    start: PSF | float | None = None,
    search_range_px: float | None = None,
    rng: np.random.Generator | None = None,
    progress: Callable[[float], object] | None = None,
    **options: Unpack[PSFOptions],
) -> LearntPSF:
    """Learn PSFs from a stack of images of single spots, as `learn_psf` does from frames.

    Parameters
    ----------
    images : (n, ny, nx) array
    calibration : Calibration, optional
        Its maps, if any, have the images' shape. Default: images are in electrons.
    index : (n,) array of int, optional
        Which PSF each spot has, from 0. Default: all have one.
    search_range_px : float, optional
        Largest distance of a spot from the image's centre along an axis. Default: half the image.
    start, rng, progress, **options
        As in `learn_psf`.

    Returns
    -------
    LearntPSF
        With as many PSFs as the largest `index` asks for.

    Raises
    ------
    InputError
        As `learn_psf`.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.simulate import subapertures
    >>> from faintspot.slopes.training import learn_psf_from_images
    >>> images, _ = subapertures(600, shape=(12, 12), flux_e=150.0, rng=np.random.default_rng(1))
    >>> learnt = learn_psf_from_images(images, rng=np.random.default_rng(2))
    >>> print(f"{learnt.psf.fwhm_px.mean():.1f} px wide")
    1.9 px wide
    """
    calibration = Calibration() if calibration is None else calibration
    stack = image_stack(images, calibration)
    n = len(stack.images)
    numbers = np.zeros(n, np.int64)
    if index is not None:
        numbers = numbers_between("index", index, 0, n - 1, integer=True)
        if numbers.shape != (n,):
            raise InputError(f"index: expected one number for each of {n} images, got shape {numbers.shape}")
    shape = (stack.images.shape[1], stack.images.shape[2])
    checked = replace(checked_options(shape, **options), search_px=_search_px(shape, search_range_px))
    return _learn(stack, numbers, start, checked, rng, progress)


def _search_px(window: tuple[int, int], search_range_px: float | None) -> float:
    """Return the largest distance from the image's centre at which spots are looked for."""
    half = min(window) / 2
    if search_range_px is None:
        return half
    return min(number_between("search_range_px", search_range_px, 0.0, low_open=True), half)


def fit_spots(
    images: ArrayLike,
    psf: PSF,
    *,
    calibration: Calibration | None = None,
    search_range_px: float | None = None,
) -> LearntPSF:
    """Measure single spots whose PSF is known, with a constant background that all of them share.

    Parameters
    ----------
    images : (n, ny, nx) array
    psf : PSF
        The first is that of all spots.
    calibration, search_range_px
        As in `learn_psf_from_images`.

    Returns
    -------
    LearntPSF
        With the PSF that was given.
    """
    stack = image_stack(images, Calibration() if calibration is None else calibration)
    n, shape = len(stack.images), (stack.images.shape[1], stack.images.shape[2])
    single = PSF(psf.samples[:1], psf.oversampling)
    search_px = _search_px(shape, search_range_px)
    options = LearningOptions(max(shape) // 2 + 1, psf.oversampling, _BACKGROUND_ROUNDS, search_px)
    border = np.ones(shape, dtype=bool)
    border[1:-1, 1:-1] = False
    learning, wings = Learning(stack, np.zeros(n, np.int64), single, options), np.zeros((n, *shape))
    for _ in range(options.rounds):
        learning.background_e[0] = np.median(np.mean((stack.images - wings)[:, border], axis=1))
        spots, _ = learning.register()
        wings = single.images(spots.positions, shape, spots.flux_e)
    return LearntPSF(single, learning.background_e, spots.positions, spots.flux_e, spots.error_px)


def frame_stack(frames: ArrayLike, layout: Layout, calibration: Calibration) -> Stack:
    """Return the windows of a frame or of frames as one stack, in photo-electrons."""
    raw = real_array("frames", frames, minimum_dimensions=2)
    check_shape("frames", raw, ("h", "w"), ("n", "h", "w"))
    maps = layout.images(calibration.maps(layout.frame_shape))
    windows = layout.images(raw if raw.ndim == 3 else raw[None])
    return _stack(windows, maps, calibration, raw.dtype)


def image_stack(images: ArrayLike, calibration: Calibration) -> Stack:
    """Return images of single spots as a stack, in photo-electrons."""
    raw = real_array("images", images)
    check_shape("images", raw, ("n", "ny", "nx"))
    return _stack(raw[:, None], calibration.maps(raw.shape[1:])[:, None], calibration, raw.dtype)


def _stack(windows: NDArray[Any], maps: NDArray[np.generic], calibration: Calibration, dtype: Any) -> Stack:
    """Calibrate windows (n_frames, n, ny, nx) with maps (2, n, ny, nx)."""
    # Saturation NaN means none: no value is at least NaN.
    saturated = windows >= calibration.saturation(dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        electrons = ((windows.astype(np.float32) - maps[0]) * maps[1]).reshape(-1, *windows.shape[2:])
    usable = np.isfinite(electrons) & ~saturated.reshape(electrons.shape)
    electrons = np.where(usable, electrons, np.float32(0))
    read_noise = calibration.read_noise_photoelectrons
    if read_noise is None:
        read_noise = pixel_noise(electrons.reshape(windows.shape))
    countable = read_noise < _COUNTABLE_E and calibration.em_gain == 1 and calibration.background_e == 0
    variance = max(read_noise, 1e-3) ** 2 + calibration.excess_noise * calibration.background_e
    return Stack(
        np.rint(electrons) if countable else electrons,
        None if usable.all() else usable,
        variance,
        calibration.excess_noise,
    )


def checked_options(
    window: tuple[int, int], oversampling: int = 4, radius_px: int | None = None, rounds: int = 8
) -> LearningOptions:
    """Return how to learn, checked."""
    side = min(window)
    if side < 6:
        raise InputError(f"images: expected at least 6 x 6 pixels, got {window[0]} x {window[1]}")
    if oversampling not in (2, 4, 8):
        raise InputError(f"oversampling = {oversampling!r}: expected 2, 4 or 8")
    radius = number_between(
        "radius_px", side // 2 if radius_px is None else radius_px, 3, max(window), integer=True
    )
    number = number_between("rounds", rounds, 4, 100, integer=True)
    return LearningOptions(int(radius), int(oversampling), int(number), side / 2)


def _regions(scope: str | ArrayLike, n_subapertures: int) -> NDArray[np.int64]:
    """The region of each sub-aperture."""
    if isinstance(scope, str):
        one_of("scope", scope, SCOPES)
        return np.arange(n_subapertures) if scope == "subaperture" else np.zeros(n_subapertures, np.int64)
    regions = numbers_between("scope", scope, -(2**31), 2**31, integer=True)
    if regions.shape != (n_subapertures,):
        raise InputError(
            f"scope: expected {n_subapertures} regions, one per sub-aperture, got {regions.shape}"
        )
    return regions


def _learn(
    stack: Stack,
    index: NDArray[np.int64],
    start: PSF | float | None,
    options: LearningOptions,
    rng: np.random.Generator | None,
    progress: Callable[[float], object] | None,
) -> LearntPSF:
    """Learn one PSF from all spots, then, where there are several, each batch of them on its own."""
    rng = np.random.default_rng() if rng is None else rng
    n_psfs = int(index.max()) + 1
    batches = [np.arange(i, min(i + _PSFS_AT_ONCE, n_psfs)) for i in range(0, n_psfs, _PSFS_AT_ONCE)]
    shared = Learning(stack, np.zeros_like(index), _start_psf(start, stack, n_psfs, options), options)
    shared_rounds = _SHARED_ROUNDS if len(shared.psf.samples) < n_psfs else 0
    total, done = shared_rounds + options.rounds * len(batches), 0

    def advance() -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(done / total)

    if shared_rounds:
        shared.learn(shared_rounds, rng, advance)
    learnt = [shared.part(batch, index) for batch in batches]
    for part in learnt:
        part.learn(options.rounds, rng, advance)
    # Spots by their batch, each in order.
    order = np.argsort(np.argsort(index // _PSFS_AT_ONCE, kind="stable"))
    spots = Registered.joined([not_none(part.spots) for part in learnt]).part(order)
    check_phases(index, spots)
    psf = psf_of(np.concatenate([part.psf.samples for part in learnt]), options.oversampling)
    background_e = np.concatenate([part.background_e for part in learnt])
    return LearntPSF(psf, background_e, spots.positions, spots.flux_e, spots.error_px)


def _start_psf(start: PSF | float | None, stack: Stack, n_psfs: int, options: LearningOptions) -> PSF:
    if isinstance(start, PSF):
        if len(start.samples) not in (1, n_psfs):
            raise InputError(f"start: expected 1 or {n_psfs} PSFs, got {len(start.samples)}")
        return start
    if start is None:
        return gaussian_psf(measured_width(stack), options)
    return gaussian_psf(number_between("start", start, 0.2, max(stack.images.shape[1:])), options)
