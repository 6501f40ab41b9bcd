"""Noise of the pixels, and the denoising strength suggested by it."""

import math
from typing import Any, Literal, NamedTuple, TypedDict, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import image_stack, number_between, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.statistics import mad_std
from faintspot.base.tables import PRESETS, of_denoising
from faintspot.slopes.kernels.host import lanes_for
from faintspot.slopes.kernels.parallel import run_groups
from faintspot.slopes.kernels.positions.gravity import denoise_stack
from faintspot.slopes.kernels.total_variation.denoise import CHAMBOLLE, FGP
from faintspot.slopes.kernels.total_variation.flat_start import flat_start_table


def suggested_strength(
    read_noise_e: ArrayLike, flux_e: ArrayLike, pixels: int, *, excess_noise: float = 1.0
) -> NDArray[np.float64]:
    """Return a suitable strength (`noise_std`): sqrt(read_noise^2 + 0.25 * excess_noise * flux / pixels).

    The full photon noise, flux / pixels, would smooth the spot itself; a quarter of it was best in
    Monte-Carlo simulations at 0.1 e- of read noise. At 1 e- and more and low flux, 0.85 of the result is
    better. If the size of the spot is known, `estimators.automatic.automatic_strength` is closer
    to the optimum.

    Parameters
    ----------
    read_noise_e : float or array
        Standard deviation of the read noise in electrons (for an EMCCD: divided by its gain).
    flux_e : float or array
        Flux of one sub-aperture in one frame [electrons].
    pixels : int
        Number of pixels of a sub-aperture.
    excess_noise : float
        Factor on the variance of the photon noise: 2 for an EMCCD at high gain.

    Raises
    ------
    InputError
        If a value is negative or NaN.
    """
    read_noise = numbers_between("read_noise_e", read_noise_e, 0.0)
    flux = numbers_between("flux_e", flux_e, 0.0)
    number_between("pixels", pixels, 1, integer=True)
    excess = number_between("excess_noise", excess_noise, 1.0)
    strength: NDArray[np.float64] = np.sqrt(read_noise**2 + 0.25 * excess * flux / pixels)
    return strength


def pixel_noise(images: ArrayLike) -> float:
    """Estimate the standard deviation of the noise of pixels far from the spots.

    The first and last rows of every image are used, where spots are faintest. With several frames of the
    same sub-apertures, the estimate is the median absolute difference of a pixel in successive frames,
    scaled to the standard deviation of a normal distribution. With one frame, it is that of neighbours in a
    row, which the wings of spots increase.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images; with four dimensions, the first one is the frame.

    Returns
    -------
    float
        Standard deviation in the unit of the images.

    Raises
    ------
    InputError
        If images are not finite or narrower than two pixels.
    """
    stack: NDArray[np.generic] = image_stack("images", images)
    if stack.shape[-1] < 2:
        raise InputError(f"images: expected at least 2 columns, got shape {stack.shape}")
    edges = stack[..., [0, -1], :].astype(np.float64)
    several_frames = edges.ndim == 4 and len(edges) > 1
    differences = np.diff(edges, axis=0 if several_frames else -1)
    if several_frames and differences.any():  # frames that a grabber wrote twice show no noise
        differences = differences[differences.any(axis=(1, 2, 3))]
    return mad_std(differences) / math.sqrt(2.0)


ALGORITHMS = {"fgp": FGP, "chambolle": CHAMBOLLE}
SMALLEST_SIDE = 2


class Denoised(NamedTuple):
    """Result of `tv_denoise` with `full_output`; every field but `images` has the leading shape.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> images, _ = fs.slopes.simulate.subapertures(100, flux_e=60.0, rng=np.random.default_rng(1))
    >>> result = fs.tv_denoise(images, 0.4, full_output=True)
    >>> result.images.shape, int(result.iterations.max()), int(result.infeasible.sum())
    ((100, 16, 16), 168, 0)
    """

    images: NDArray[Any]
    """(..., ny, nx) denoised images, in the dtype of the computation."""
    iterations: NDArray[np.int64]
    """Number of iterations made; 0 where none was needed."""
    multiplier: NDArray[np.float64]
    """Weight lambda of the penalised (ROF) problem with the same solution; inf if infeasible."""
    converged: NDArray[np.bool_]
    """Whether the tolerance was reached (also true where no iteration was needed)."""
    infeasible: NDArray[np.bool_]
    """Whether the strength exceeds the limit; the result is then the mean, or uses a lower strength."""


class Denoising(TypedDict, total=False):
    """Options of `tv_denoise`."""

    algorithm: str
    tolerance: float | None
    max_iterations: int | None
    preset: str
    lower_strength: bool


@overload
def tv_denoise(
    images: ArrayLike,
    noise_std: ArrayLike,
    *,
    full_output: Literal[False] = ...,
    **options: Unpack[Denoising],
) -> NDArray[Any]: ...
@overload
def tv_denoise(
    images: ArrayLike, noise_std: ArrayLike, *, full_output: Literal[True], **options: Unpack[Denoising]
) -> Denoised: ...
def tv_denoise(
    images: ArrayLike,
    noise_std: ArrayLike,
    *,
    algorithm: str = "fgp",
    tolerance: float | None = None,
    max_iterations: int | None = None,
    preset: str = "accurate",
    lower_strength: bool = False,
    full_output: bool = False,
) -> NDArray[Any] | Denoised:
    r"""Denoise each image by total-variation minimisation under a noise constraint.

    Minimise the isotropic total variation TV(u) (forward differences, Neumann edges) subject to
    ``||u - g||^2 = ny * nx * noise_std^2``, independently for each image.

    Parameters
    ----------
    images : (..., ny, nx) array
        Images g, at least 2 x 2 pixels. float32 (and float16) images are processed in float32, all others in
        float64, with the same algorithm.
    noise_std : float or array
        Standard deviation of the noise to remove, in the unit of the images; scalar or broadcastable to the
        leading shape. Not a weight: the weight of the equivalent penalised problem
        ``min ||u - g||^2 / 2 + lambda TV(u)`` is returned as `multiplier`. (scikit-image's
        ``denoise_tv_chambolle(weight=w)`` solves that with lambda = w.)
    algorithm : {"fgp", "chambolle"}
        "fgp": accelerated projected gradient on the dual [2]_. "chambolle": the fixed-point iteration of
        [1]_, used by [3]_; it has the same solution and needs 6 to 8 times more iterations. Both update the
        multiplier in every iteration as in [1]_, section 4.
    tolerance : float, optional
        Stop an image when 24 iterations change the solution by less than this fraction of its own standard
        deviation, ``||u - u_24|| <= tolerance * ||u - mean(u)||`` with ``u_24`` of 24 iterations before and
        the present multiplier; tested every 24 iterations. 0 never stops early. With the default, 0.0025,
        the slope error is nearly always within 1 % of the converged one, whatever number of pixels is kept:
        docs/results/tv_settings.md.
        Tolerances of different algorithms and
        packages are not comparable: "chambolle" changes less in an iteration and stops farther from the
        solution.
    max_iterations : int, optional
        Maximum number of iterations for each image. Default: 480.
    preset : {"accurate", "fast"}
        "fast": 8 iterations without a test of the tolerance (`tolerance` and `max_iterations` override it).
    lower_strength : bool
        Lower a strength above 0.9 of an image's own rms to 0.6 of it, as `SlopePipeline` does; closer to the
        rms, too little of the spot remains.
    full_output : bool
        Return a `Denoised` with the images, iterations, multiplier, converged and infeasible.

    Returns
    -------
    ndarray or Denoised
        u, in the shape of `images`. The constraint holds to rounding error after any number of iterations.
        For a constant image or noise_std = 0 the image itself is returned. If ``rms(g - mean(g)) <=
        noise_std``, the constant mean(g) is returned, since no u obeys the constraint with less variation,
        unless `lower_strength` is set.

    Raises
    ------
    InputError
        If images are not real, finite and at least two-dimensional, noise_std is negative, NaN or does not
        broadcast, or the algorithm is unknown.

    References
    ----------
    .. [1] Chambolle, A., 2004, J. Math. Imaging Vis. 20, 89.
    .. [2] Beck, A. & Teboulle, M., 2009, IEEE Trans. Image Process. 18, 2419.
    .. [3] Basden, A. G., Morris, T. J., Gratadour, D. & Gendron, E., 2015, MNRAS; arXiv:1503.06043.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> images, truth = fs.slopes.simulate.subapertures(100, flux_e=200, rng=np.random.default_rng(1))
    >>> denoised = fs.tv_denoise(images, noise_std=0.4)
    >>> denoised.shape
    (100, 16, 16)
    """
    stack = image_stack("images", images)
    ny, nx = stack.shape[-2:]
    if min(ny, nx) < SMALLEST_SIDE:
        raise InputError(
            f"images: expected at least {SMALLEST_SIDE} x {SMALLEST_SIDE} pixels, got {ny} x {nx}"
        )
    leading = stack.shape[:-2]
    strength = numbers_between("noise_std", noise_std, 0.0)
    try:
        strength = np.broadcast_to(strength, leading)
    except ValueError:
        raise InputError(f"noise_std: shape {strength.shape} does not broadcast to {leading}") from None
    one_of("algorithm", algorithm, list(ALGORITHMS))
    one_of("preset", preset, PRESETS)
    usual = of_denoising(preset)
    threshold = usual["tolerance"] if tolerance is None else number_between("tolerance", tolerance, 0.0)
    limit = usual["max_iterations"] if max_iterations is None else max_iterations
    number_between("max_iterations", limit, 1, 2**31, integer=True)

    # The kernel is compiled for arrays of one kind, not once more for those that are read-only.
    flat = np.require(stack.reshape(-1, ny * nx), requirements="W")
    settings = np.empty((3, len(flat)), np.float64)
    settings[0], settings[1], settings[2] = strength.reshape(-1), threshold, limit
    denoised, multiplier = np.empty_like(flat), np.empty(len(flat))
    counts = np.empty((3, len(flat)), np.int64)
    lanes = lanes_for(flat.dtype)
    begin = flat_start_table(ny, nx, flat.dtype)
    window, how, found = (ny, nx), ALGORITHMS[algorithm], (denoised, multiplier, counts)

    def job(start: int, stop: int, scratch: tuple[object, ...]) -> None:
        denoise_stack(lanes, flat, window, settings, how, lower_strength, begin, start, stop, scratch, found)

    run_groups(job, -(-len(flat) // lanes.width), lanes, (ny, nx))
    result = denoised.reshape(stack.shape)
    if not full_output:
        return result
    iterations, converged, infeasible = (row.reshape(leading) for row in counts)
    return Denoised(
        result, iterations, multiplier.reshape(leading), converged.astype(bool), infeasible.astype(bool)
    )
