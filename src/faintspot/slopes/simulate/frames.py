"""Noisy images with known positions: stacks of sub-apertures and whole sensor frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from types import MappingProxyType
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, not_none, number_between, numbers_between
from faintspot.base.config.options import REQUIRED, Options, number, setting
from faintspot.base.errors import InputError
from faintspot.base.generators import spawn
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import SpotShape, image_shape, per_spot, spots
from faintspot.slopes.spots.speckled import LARGEST_D_OVER_R0, speckled_images

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
    truth = _true_positions(positions, position_range_px, (n, 2), position_rng)
    camera = _camera(detector)
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
            mean_e, _ = speckled_images(
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
    truth = _true_positions(positions, position_range_px, (n_frames, n, 2), position_rng)
    jitter = number_between("jitter_px", jitter_px, 0.0)
    if jitter:  # spawned only if needed, as above
        truth += spawn(rng, 1)[0].normal(0.0, jitter, (n_frames, 1, 2))
    camera = _camera(detector)
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


def _camera(detector: object) -> Detector:
    """Return the detector; the default has 0.1 e- read noise and no other noise."""
    if detector is None:
        return Detector(read_noise_e=0.1)
    if not isinstance(detector, Detector):
        raise InputError(f"detector: expected a Detector or None, got {type(detector).__name__}")
    return detector


def _true_positions(
    positions: object, position_range_px: float, shape: tuple[int, ...], rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the given positions, or uniform random ones, with shape (..., n, 2)."""
    half = number_between("position_range_px", position_range_px, 0)
    if positions is None:
        return rng.uniform(-half, half, shape)
    given = finite_array("positions", positions).astype(np.float64)
    if given.shape not in (shape, shape[-2:]):
        raise InputError(f"positions: expected shape {shape[-2:]} or {shape}, got {given.shape}")
    return np.broadcast_to(given, shape).copy()


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


# Flux density (Jy) at magnitude 0 and relative width of the band: Bessell 1979 (PASP 91, 589) for B to I,
# Campins, Rieke & Lebofsky 1985 (AJ 90, 896) for J to K.
_BANDS = {
    "B": (4260.0, 0.22),
    "V": (3640.0, 0.16),
    "R": (3080.0, 0.23),
    "I": (2550.0, 0.19),
    "J": (1600.0, 0.16),
    "H": (1080.0, 0.23),
    "K": (670.0, 0.23),
}
_PHOTONS_PER_JANSKY = 1.509e7  # photons / s / m^2 for a band of relative width 1: 1e-26 W/m^2/Hz over h

ZERO_POINTS = MappingProxyType(
    {band: float(f"{jansky * width * _PHOTONS_PER_JANSKY:.3g}") for band, (jansky, width) in _BANDS.items()}
)
"""Photons per second and m^2 of a star of magnitude 0 above the atmosphere, over the whole band."""

DEFAULT_BAND = "R"
DEFAULT_THROUGHPUT = 0.4  # atmosphere, telescope and the optics before the sensor
DEFAULT_QUANTUM_EFFICIENCY = 0.9


_part: dict[str, Any] = {"low": 0.0, "high": 1.0, "low_open": True}
_above_zero = partial(number, low=0.0, high=math.inf, low_open=True)


@dataclass(frozen=True, eq=False, kw_only=True)
class Passband(Options):
    """Photons of a star of magnitude 0, and their way to the detector.

    Parameters
    ----------
    band : str
        B, V, R, I, J, H or K; sets the zero point if that is not given.
    zero_point : float, optional
        Photons per second and m^2 of a star of magnitude 0 above the atmosphere, within the sensor's band.
    throughput : float
        Fraction of the photons that reaches the detector: atmosphere, telescope, optics. Default: 0.4.
    quantum_efficiency : float
        Fraction of these photons that is detected. Default: 0.9.

    Raises
    ------
    InputError
        If a value is out of range.
    """

    band: str = setting(DEFAULT_BAND, "Band of the magnitude.", choices=tuple(ZERO_POINTS), group="star")
    zero_point: float | None = _above_zero(
        None,
        meaning="Photons/s/m^2 of magnitude 0 in the band. Default: that of --band.",
        unit="photons",
        group="star",
    )
    throughput: float = setting(
        DEFAULT_THROUGHPUT, "Of atmosphere, telescope and optics.", group="star", **_part
    )
    quantum_efficiency: float = setting(
        DEFAULT_QUANTUM_EFFICIENCY, "Quantum efficiency.", group="star", **_part
    )


@dataclass(frozen=True)
class Photometry(Passband):
    """Electrons from a star in a sub-aperture and a frame.

    electrons = zero_point * 10^(-0.4 magnitude) * area_m2 * frame_time_s * throughput * quantum_efficiency.

    Parameters
    ----------
    area_m2 : float
        Area of a sub-aperture in the entrance pupil of the telescope.
    frame_time_s : float
        Exposure time of a frame.
    band, zero_point, throughput, quantum_efficiency
        See `Passband`.

    Raises
    ------
    InputError
        If a value is out of range.

    Examples
    --------
    >>> from faintspot.slopes.simulate import Photometry
    >>> photometry = Photometry(area_m2=0.36, frame_time_s=1 / 150, band="R")
    >>> round(float(photometry.electrons(11.0))), round(float(photometry.magnitude(100.0)), 1)
    (368, 12.4)
    """

    area_m2: float = _above_zero(REQUIRED)
    frame_time_s: float = _above_zero(REQUIRED)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.zero_point is None:
            object.__setattr__(self, "zero_point", ZERO_POINTS[self.band])

    @property
    def electrons_at_zero(self) -> float:
        """Electrons per sub-aperture and frame of a star of magnitude 0."""
        flux = not_none(self.zero_point) * self.area_m2 * self.frame_time_s
        return flux * self.throughput * self.quantum_efficiency

    def electrons(self, magnitude: ArrayLike) -> NDArray[np.float64]:
        """Return the electrons per sub-aperture and frame for stars of the given magnitudes.

        Raises
        ------
        InputError
            If magnitudes are not finite.
        """
        stars: NDArray[np.float64] = finite_array("magnitude", magnitude).astype(np.float64)
        return np.asarray(self.electrons_at_zero * 10 ** (-0.4 * stars))

    def magnitude(self, electrons: ArrayLike) -> NDArray[np.float64]:
        """Return the magnitudes of stars with the given electrons per sub-aperture and frame.

        Raises
        ------
        InputError
            If electrons are not above 0.
        """
        flux = numbers_between("electrons", electrons, 0.0, math.inf, low_open=True)
        return np.asarray(-2.5 * np.log10(flux / self.electrons_at_zero))


@dataclass(frozen=True, eq=False, kw_only=True)
class StarLight(Passband):
    """A star by its magnitude."""

    magnitude: float | None = number(
        None, -30.0, 60.0, "Magnitude; needs --subaperture-m and --frame-rate-hz.", unit="mag", group="star"
    )

    def photometry_of(self, subaperture_m: float, frame_rate_hz: float) -> Photometry:
        """Return the relation of magnitude and electrons for a sub-aperture and a frame."""
        light = {item.name: getattr(self, item.name) for item in fields(Passband)}
        return Photometry(subaperture_m**2, 1 / frame_rate_hz, **light)
