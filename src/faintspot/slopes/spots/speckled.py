"""Short-exposure spots of a lenslet in turbulence: speckled, with a known position."""

import functools
import math
from typing import NamedTuple, Required, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import check_shape, finite_array, number_between, numbers_between, spawn
from faintspot.slopes.spots.shapes import SMALLEST_SIZE, image_shape, per_spot, structure_function

LARGEST_D_OVER_R0 = 10.0
"""Largest sub-aperture side accepted, in r0: the phase grid has four points per r0."""

# Points across the sub-aperture. The image of the grid is periodic with a period of `points` lambda / d.
_FEWEST_POINTS, _MOST_POINTS = 24, 40
_BLOCK_POINTS = 1 << 18  # image samples processed at a time: the temporary arrays stay in the cache


class Speckles(TypedDict, total=False):
    """Turbulence, image and spot of `speckled_spots`."""

    d_over_r0: Required[ArrayLike]
    """Side of the sub-aperture in units of the Fried parameter at the sensing wavelength, 0 to 10."""
    shape: tuple[int, int]
    """Rows and columns (ny, nx) of each image [px] [default: (16, 16)]."""
    size: ArrayLike
    """lambda / d = 2 px * size, at least 0.05 [default: 1]. In images wider than 40 lambda / d too much of
    the flux is in the outer parts."""
    flux_e: ArrayLike
    """Electrons in the whole, infinite spot, as in `faintspot.slopes.spots.shapes` [default: 1]."""


class _PhaseModes(NamedTuple):
    """Square root of a joint covariance for d = r0: phases and mean gradients are root @ white noise."""

    phase: Floats  # (points^2, modes), rad
    gradient: Floats  # (2, modes), rad per d


def speckled_spots(
    n: int,
    *,
    position_range_px: float = 1.0,
    positions: ArrayLike | None = None,
    rng: np.random.Generator | None = None,
    **speckles: Unpack[Speckles],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return noiseless short-exposure images behind square sub-apertures, and the positions of their spots.

    The phase of each image is drawn from its exact covariance over the sub-aperture, that of the Kolmogorov
    structure function 6.88 (r / r0)^(5/3) (Fried 1966, JOSA 56, 1372). The amplitude is uniform (no
    scintillation). With d_over_r0 = 0 the images are the "diffraction" spots of
    `faintspot.slopes.spots.shapes`.

    The mean gradient of the turbulent phase is replaced by the random (or given) position, so that positions
    have the requested range at any strength of turbulence. A position is the mean gradient of the phase over
    the sub-aperture as a displacement of the spot: the quantity that a wavefront sensor is to measure, and
    the centre of gravity of all flux in and outside the image.

    Parameters
    ----------
    n : int
        Number of images.
    position_range_px : float
        Positions are uniform within plus and minus this, on each axis, px.
    positions : array_like, shape (n, 2), optional
        x and y in px, instead of random ones.
    rng : numpy.random.Generator, optional
        Generator from which separate ones for positions and phases are spawned.
    **speckles
        Values of `Speckles`, of which `d_over_r0` is required; one each, or arrays of n.

    Returns
    -------
    images : ndarray, float64, shape (n, ny, nx)
        Mean electrons per pixel.
    truth : ndarray, float64, shape (n, 2)
        x and y, px.

    Raises
    ------
    InputError
        If a value is not finite or out of range, or `positions` have another shape.

    Examples
    --------
    >>> import numpy as np
    >>> from faintspot.slopes.simulate import speckled_spots
    >>> rng = np.random.default_rng(1)
    >>> sharp, _ = speckled_spots(100, d_over_r0=0.0, positions=np.zeros((100, 2)), rng=rng)
    >>> speckled, _ = speckled_spots(100, d_over_r0=3.0, positions=np.zeros((100, 2)), rng=rng)
    >>> round(float(speckled.max((1, 2)).mean() / sharp.max((1, 2)).mean()), 1)
    0.5
    """
    n = int(number_between("n", n, 1, integer=True))
    position_rng, phase_rng = spawn(rng, 2)
    true = true_positions(positions, position_range_px, (n, 2), position_rng)
    return speckled_images(true, rng=phase_rng, **speckles), true


def true_positions(
    positions: object, position_range_px: float, shape: tuple[int, ...], rng: np.random.Generator
) -> Floats:
    """Return the given positions, or uniform random ones, with shape (..., n, 2)."""
    half = number_between("position_range_px", position_range_px, 0)
    if positions is None:
        return rng.uniform(-half, half, shape)
    given = finite_array("positions", positions).astype(np.float64)
    check_shape("positions", given, shape[-2:], shape)
    return np.broadcast_to(given, shape).copy()


def speckled_images(
    positions: Floats,
    *,
    d_over_r0: ArrayLike,
    shape: tuple[int, int] = (16, 16),
    size: ArrayLike = 1.0,
    flux_e: ArrayLike = 1.0,
    rng: np.random.Generator,
) -> Floats:
    """Return images of spots at positions (n, 2); see `speckled_spots`.

    The phases are the next draws of `rng`, so that several calls give the same images as one call.
    """
    n = len(positions)
    ny, nx = image_shape("shape", shape)
    checked = numbers_between("d_over_r0", d_over_r0, 0.0, LARGEST_D_OVER_R0)
    strength = per_spot("d_over_r0", checked, n) ** (5 / 6)
    width = 2.0 * per_spot("size", size, n, SMALLEST_SIZE)
    flux = per_spot("flux_e", flux_e, n, 0.0)
    points = _points(max(ny, nx) / float(np.min(width)), float(np.max(strength)) ** (6 / 5))
    modes = _phase_modes(points)
    nodes, weights = _pixel_samples(float(np.min(width)))
    images = np.empty((n, ny, nx))
    block = max(1, _BLOCK_POINTS // (ny * nx * len(nodes) ** 2))
    for start in range(0, n, block):
        part = slice(start, start + block)
        phase, _ = _draw(modes, strength[part], rng)
        images[part] = _intensities(phase, positions[part], width[part], (ny, nx), nodes, weights)
    return images * flux[:, None, None]


def _points(window_lambda_over_d: float, d_over_r0: float) -> int:
    """Return the points across the sub-aperture for which periodic images stay outside the window."""
    least = max(1.25 * window_lambda_over_d, 4 * d_over_r0)
    return int(np.clip(2 * math.ceil(least / 2), _FEWEST_POINTS, _MOST_POINTS))


@functools.lru_cache(maxsize=8)
def _phase_modes(points: int) -> _PhaseModes:
    """Return the square root of the covariance of phases and mean gradients, for d = r0 = 1.

    The mean gradient of a phase over a square is exactly the difference of its means over opposite edges,
    which are therefore part of the covariance. The common piston of all points is removed.
    """
    line = (np.arange(points) + 0.5) / points - 0.5
    y, x = (axis.ravel() for axis in np.meshgrid(line, line, indexing="ij"))
    half = np.full(points, 0.5)
    x = np.concatenate([x, half, -half, line, line])
    y = np.concatenate([y, line, line, half, -half])
    n = points**2
    distance = np.hypot(x[:, None] - x, y[:, None] - y)
    structure = structure_function(distance, math.inf)
    from_piston = structure[:n].mean(axis=0)
    covariance = 0.5 * (from_piston[:, None] + from_piston - structure - from_piston[:n].mean())
    edges = np.repeat([[1.0, -1.0, 0, 0], [0, 0, 1, -1]], points, axis=1) / points
    across = edges @ covariance[n:]
    gradients = across[:, n:] @ edges.T
    joint = np.block([[covariance[:n, :n], across[:, :n].T], [across[:, :n], gradients]])
    variance, directions = np.linalg.eigh(joint)
    positive = variance > 1e-12 * variance[-1]
    root = directions[:, positive] * np.sqrt(variance[positive])
    root.flags.writeable = False
    return _PhaseModes(root[:n], root[n:])


def _draw(modes: _PhaseModes, strength: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Draw phases (n, points, points) without their mean gradient, and that gradient (n, 2) [rad per d]."""
    noise = rng.standard_normal((len(strength), modes.phase.shape[1])) * strength[:, None]
    gradient = noise @ modes.gradient.T
    points = math.isqrt(len(modes.phase))
    phase = (noise @ modes.phase.T).reshape(-1, points, points)
    line = (np.arange(points) + 0.5) / points - 0.5
    phase -= gradient[:, 0, None, None] * line + gradient[:, 1, None, None] * line[:, None]
    return phase, gradient


def _pixel_samples(smallest_width: float) -> tuple[Floats, Floats]:
    """Return offsets [px] and weights of the samples of a pixel along one axis (Gauss-Legendre).

    The image has no frequency above 1 / width cycles per pixel; for a width of 2 px, three samples
    integrate it to 1e-4 of the brightest pixel.
    """
    nodes, weights = np.polynomial.legendre.leggauss(2 + math.ceil(2 / smallest_width))
    return nodes / 2, weights / 2


def _intensities(
    phase: Floats, positions: Floats, width: Floats, shape: tuple[int, int], nodes: Floats, weights: Floats
) -> Floats:
    """Return the pixel-integrated images (n, ny, nx) of phases, displaced to the positions.

    Each point is a square of constant phase. Without turbulence these form the lenslet exactly, and the
    image is sinc^2. The displacement is applied to the image rather than to the phase.
    """
    points = phase.shape[-1]
    field = np.exp(1j * phase.astype(np.float32))
    rows, columns = (
        _fourier(length, positions[:, axis], width, points, nodes)
        for length, axis in zip(shape, (1, 0), strict=True)
    )
    amplitude = rows @ field @ columns.transpose(0, 2, 1)
    intensity = amplitude.real**2 + amplitude.imag**2
    sampled = intensity.reshape(-1, shape[0], len(nodes), shape[1], len(nodes))
    images: Floats = np.einsum("nypxq,p,q->nyx", sampled, weights, weights, optimize=True)
    return images / np.square(width)[:, None, None]


def _fourier(length: int, centre: Floats, width: Floats, points: int, nodes: Floats) -> NDArray[np.complex64]:
    """Return the Fourier transform from sub-aperture points to image samples, shape (n, samples, points).

    It is for one axis of the image and the samples of all pixels.
    """
    samples = ((np.arange(length) - (length - 1) / 2)[:, None] + nodes).ravel()
    angle = (samples - centre[:, None]) / width[:, None]  # in lambda / d
    square = np.sinc(angle / points) / points
    line = (np.arange(points) + 0.5) / points - 0.5
    wave = np.exp(((-2j * np.pi) * (angle[:, :, None] * line)).astype(np.complex64))
    transform: NDArray[np.complex64] = wave * square[:, :, None].astype(np.float32)
    return transform
