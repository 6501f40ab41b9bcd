"""Noisy images with known positions: stacks of sub-apertures and whole sensor frames."""

import math
from collections.abc import Callable
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between, spawn
from faintspot.base.errors import InputError
from faintspot.slopes.camera.detector import Detector, detector_or_default
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import SpotShape, image_shape, per_spot, spots
from faintspot.slopes.spots.speckled import LARGEST_D_OVER_R0, speckled_images, true_positions

_Images = Callable[[NDArray[np.float64]], NDArray[np.float64]]

_BLOCK_PIXELS = 1 << 21  # pixels simulated at a time, to limit the memory of the double-precision means


def subapertures(
    n: int,
    *,
    shape: tuple[int, int] = (16, 16),
    flux_e: ArrayLike = 100.0,
    position_range_px: float = 1.0,
    positions: ArrayLike | None = None,
    d_over_r0: float = 0.0,
    detector: Detector | None = None,
    rng: np.random.Generator | None = None,
    **spot_shape: Unpack[SpotShape],
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return noisy sub-aperture images in photo-electrons and the true positions of their spots.

    The images are `Detector.to_electrons` of the read-out and include background and dark current. Spot
    shapes are those of `spots.shapes`; flux_e, size, elongation and angle_deg are one number each
    or one per sub-aperture.

    Parameters
    ----------
    n : int
        Number of sub-apertures.
    shape : (int, int)
        Rows and columns (ny, nx) of each image, px.
    flux_e : float or array_like, shape (n,)
        Electrons within the image of a centred spot. Farther out more flux is lost, as with a field stop;
        turbulence, which spreads the flux, increases the loss.
    position_range_px : float
        True positions are uniform within plus and minus this, on each axis, px.
    positions : array_like, shape (n, 2), optional
        True x and y [px], instead of random ones.
    d_over_r0 : float
        Side of the square sub-aperture in units of the Fried parameter, 0 to 10. Each spot is speckled by
        Kolmogorov turbulence whose own mean gradient is removed, so that the mean gradient of its phase is
        the true position. 0: no turbulence; the draws of positions and noise are those without this option.
        Values above 0 require profile "diffraction" and elongation 1.
    detector : Detector, optional
        Default: 0.1 e- read noise and no other noise.
    rng : numpy.random.Generator, optional
        Generator from which separate ones for positions, noise and turbulence are spawned: the same seed
        gives the same positions for any detector and turbulence.
    **spot_shape
        profile, size, elongation and angle_deg, see `faintspot.slopes.spots.shapes`.

    Returns
    -------
    images : ndarray, float32, shape (n, ny, nx)
        Photo-electrons.
    truth : ndarray, float64, shape (n, 2)
        True x and y, px.

    Raises
    ------
    InputError
        If a value is not finite, out of range or of the wrong shape.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> images, truth = fs.slopes.simulate.subapertures(1000, flux_e=50.0, rng=np.random.default_rng(1))
    >>> images.shape, truth.shape
    ((1000, 16, 16), (1000, 2))
    >>> round(float(images.sum((1, 2)).mean()))
    50
    """
    n = int(number_between("n", n, 1, integer=True))
    ny, nx = image_shape("shape", shape)
    turbulence = number_between("d_over_r0", d_over_r0, 0.0, LARGEST_D_OVER_R0)
    position_rng, noise_rng = spawn(rng, 2)
    # Spawned only if needed, so that without turbulence later draws of the generator do not change.
    phase_rng = spawn(rng, 1)[0] if turbulence else None
    truth = true_positions(positions, position_range_px, (n, 2), position_rng)
    camera = detector_or_default(detector)
    profile, spot = _values_of_spots(n, (ny, nx), flux_e, **spot_shape)
    if turbulence and (profile != "diffraction" or np.any(spot["elongation"] != 1)):
        raise InputError(f"d_over_r0 = {turbulence:g}: expected profile 'diffraction' and elongation 1")
    images = np.empty((n, ny, nx), dtype=np.float32)
    block = max(1, _BLOCK_PIXELS // (ny * nx))
    for start in range(0, n, block):
        part = slice(start, start + block)
        shapes = {name: value[part] for name, value in spot.items()}
        if phase_rng is None:
            mean_e = spots(truth[part], shape=(ny, nx), profile=profile, **shapes)
        else:
            mean_e = speckled_images(
                truth[part],
                d_over_r0=turbulence,
                shape=(ny, nx),
                size=shapes["size"],
                flux_e=shapes["flux_e"],
                rng=phase_rng,
            )
        images[part] = camera.to_electrons(camera.expose(mean_e, spawn(noise_rng, 1)[0]))
    return images, truth


def sensor_frames(
    layout: Layout,
    n_frames: int,
    *,
    flux_e: ArrayLike = 100.0,
    position_range_px: float = 1.0,
    positions: ArrayLike | None = None,
    psf: PSF | None = None,
    jitter_px: float = 0.0,
    detector: Detector | None = None,
    rng: np.random.Generator | None = None,
    **spot_shape: Unpack[SpotShape],
) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return frames of a whole Shack-Hartmann sensor in ADU and the true positions of their spots.

    The flux of each spot is confined to its own window, as with a field stop. For more frames than fit into
    memory, call the function again with the same generator: noise and positions continue.

    Parameters
    ----------
    layout : Layout
        Windows and the frame; spots are relative to the centres of windows.
    n_frames : int
        Number of frames.
    flux_e : float or array_like, shape (n,)
        Electrons per frame within the window of a centred spot.
    position_range_px : float
        True positions are uniform within plus and minus this on each axis [px], independently in each frame.
    positions : array_like, shape (n, 2) or (n_frames, n, 2), optional
        True x and y in px from the centre of each window, constant or for each frame, instead of random ones.
    psf : PSF, optional
        PSF of each sub-aperture instead of profile, size, elongation and angle_deg: elongated spots of
        `faintspot.LaserGuideStar.psf`, for example.
    jitter_px : float
        Standard deviation of a motion common to all spots of a frame, such as the jitter of a beam [px].
    detector : Detector, optional
        Default: 0.1 e- read noise and no other noise. Maps have the shape of the frame.
    rng : numpy.random.Generator, optional
        Generator from which separate ones for positions and noise are spawned.
    **spot_shape
        profile, size, elongation and angle_deg, see `faintspot.slopes.spots.shapes`; one number each or one
        per sub-aperture.

    Returns
    -------
    frames : ndarray, shape (n_frames, rows, columns)
        Frames [ADU], of the type that `Detector.expose` returns.
    truth : ndarray, float64, shape (n_frames, n, 2)
        True x and y, px.

    Raises
    ------
    InputError
        If a value is not finite, out of range or of the wrong shape.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> grid = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5)
    >>> frames, truth = fs.slopes.simulate.sensor_frames(grid, 10)
    >>> frames.shape, truth.shape
    ((10, 112, 112), (10, 37, 2))
    """
    n_frames = int(number_between("n_frames", n_frames, 1, integer=True))
    n, pixels = len(layout), _window_pixels(layout)
    position_rng, noise_rng = spawn(rng, 2)
    truth = true_positions(positions, position_range_px, (n_frames, n, 2), position_rng)
    jitter = number_between("jitter_px", jitter_px, 0.0)
    if jitter:  # spawned only if needed, as above
        truth += spawn(rng, 1)[0].normal(0.0, jitter, (n_frames, 1, 2))
    camera = detector_or_default(detector)
    if psf and spot_shape:
        raise InputError(f"psf: expected no {', '.join(spot_shape)} beside it")
    sensor = n, layout.window, flux_e
    images_of = _spots_of_psf(psf, *sensor) if psf else _spots(*sensor, spot_shape)
    blocks = []
    block = max(1, _BLOCK_PIXELS // max(math.prod(layout.frame_shape), pixels.size))
    for start in range(0, n_frames, block):
        part = truth[start : start + block]
        images = images_of(part)
        mean_e = _place_windows(images.reshape(len(part), -1), pixels, layout.frame_shape)
        blocks.append(camera.expose(mean_e, spawn(noise_rng, 1)[0]))
    return np.concatenate(blocks), truth


def _spots(n: int, shape: tuple[int, int], flux_e: ArrayLike, spot_shape: SpotShape) -> _Images:
    """Return a function that makes the images of the spots of several frames at positions (frames, n, 2)."""
    profile, values = _values_of_spots(n, shape, flux_e, **spot_shape)

    def images(positions: NDArray[np.float64]) -> NDArray[np.float64]:
        repeated = {name: np.tile(value, len(positions)) for name, value in values.items()}
        return spots(positions.reshape(-1, 2), shape=shape, profile=profile, **repeated)

    return images


def _spots_of_psf(psf: PSF, n: int, shape: tuple[int, int], flux_e: ArrayLike) -> _Images:
    """Return a function as `_spots`, for PSFs."""
    which = psf.index_of(n)
    centred = psf.images(np.zeros((n, 2)), shape, which=which).sum(axis=(1, 2))
    if not np.all(centred > 0):
        raise InputError("psf: expected spots with flux in their windows, got none")
    flux = per_spot("flux_e", flux_e, n, 0.0) / centred

    def images(positions: NDArray[np.float64]) -> NDArray[np.float64]:
        repeated = np.tile(which, len(positions))
        made = psf.images(positions.reshape(-1, 2), shape, np.tile(flux, len(positions)), which=repeated)
        return np.maximum(made, 0.0)

    return images


def _values_of_spots(
    n: int, shape: tuple[int, int], flux_e: ArrayLike, profile: str = "diffraction", **form: ArrayLike
) -> tuple[str, dict[str, NDArray[np.float64]]]:
    """Return profile, and size, elongation, angle and whole flux of n spots with `flux_e` in their image."""
    form = {"size": 1.0, "elongation": 1.0, "angle_deg": 0.0, **form}
    values = {name: per_spot(name, value, n) for name, value in form.items()}
    flux = per_spot("flux_e", flux_e, n)
    kinds, which = np.unique(np.stack(list(values.values()), axis=1), axis=0, return_inverse=True)
    one_of_each = dict(zip(values, kinds.T, strict=True))
    centred = spots(np.zeros((len(kinds), 2)), shape=shape, profile=profile, **one_of_each)
    return profile, {**values, "flux_e": flux / centred.sum(axis=(1, 2))[which]}


def _window_pixels(layout: Layout) -> NDArray[np.int64]:
    """Return the flat frame index of each window's pixels, shape (n, ny * nx)."""
    height, width = layout.window
    rows = layout.corners[:, 0, None, None] + np.arange(height)[:, None]
    columns = layout.corners[:, 1, None, None] + np.arange(width)
    flat: NDArray[np.int64] = (rows * layout.frame_shape[1] + columns).reshape(len(layout), -1)
    return flat


def _place_windows(
    images: NDArray[np.float64], pixels: NDArray[np.int64], frame: tuple[int, int]
) -> NDArray[np.float64]:
    """Add the flux of the windows to each frame; windows may overlap."""
    n_pixels = frame[0] * frame[1]
    where = pixels.ravel() + n_pixels * np.arange(len(images))[:, None]
    flux = np.zeros(len(images) * n_pixels)
    np.add.at(flux, where, images)
    return flux.reshape(len(images), *frame)
