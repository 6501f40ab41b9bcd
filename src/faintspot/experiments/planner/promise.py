"""Check of promised slope errors on recorded frames that were not used to learn them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none, spawn
from faintspot.base.statistics import UNKNOWN, Estimate
from faintspot.experiments.planner.question import Question
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.psf_learning import LearntPSF, fit_spots
from faintspot.slopes.training.spot_transfer import variance_over_expected

_SPOTS, _FEWEST_SPOTS = 4096, 1024  # of 16 x 16 px; fewer of larger windows
_COUNTABLE_E = 0.25  # read noise below which images hold whole electrons, which are dealt out one by one
_FEWEST_FRAMES = 8
_LARGEST_SHARE = 0.5  # of the flux, for two images of a frame
_TOLERANCE = 0.1  # relative, within which a promise counts as kept
_SURELY = 3.0  # standard errors
_NOISE_TOLERANCE = 0.1  # of the pixels' standard deviation, likewise
_ORDERS = (1, 2, 3)  # of differences between frames: the higher ones take slow movement out


@dataclass(frozen=True)
class Promise:
    """Slope errors that were predicted and measured on frames kept for it, px.

    Two images of the same spots, whose noises are independent, are made of every frame; half the mean
    difference of their slopes, times sqrt(2), is R without movement.

    Examples
    --------
    >>> from faintspot.base.statistics import Estimate
    >>> from faintspot.experiments import Promise
    >>> alike, moved = (Estimate(value, 0.002) for value in (0.103, 0.140))
    >>> promise = Promise(200.0, Estimate(0.100, 0.002), alike, moved, noise_ratio=1.02, promised_px=0.098)
    >>> print(f"{promise.ratio.value:.2f}", promise.contradicted)
    1.03 False
    """

    flux_e: float
    """Flux of the images, electrons per sub-aperture on average."""
    predicted: Estimate
    """By simulation, as the answer: same camera, light and PSF, spots where they are in the recording."""
    measured: Estimate
    """In the recording."""
    frame_to_frame: Estimate
    """In the recording from one frame to the next, movement included; NaN of a single frame."""
    noise_ratio: float
    """Standard deviation of lit pixels about fitted spots over the one that was taken."""
    promised_px: float
    """R at the star's flux, as promised."""
    unshared_px: float = 0.0
    """Error that the two images of a frame share and successive frames do not: scatter from frame to frame
    beyond noise and the movement that all methods see. Known where spots move less than the noise."""
    placed_px: float = 0.0
    """R at the star's flux by simulation, spots where they are in the recording. The search range limits
    errors of these less than those of spots near its edges."""

    @property
    def ratio(self) -> Estimate:
        """Measured, with what the two images share, over predicted."""
        value = math.hypot(self.measured.value, self.unshared_px) / self.predicted.value
        relative = math.hypot(
            self.measured.standard_error / self.measured.value,
            self.predicted.standard_error / self.predicted.value,
        )
        return Estimate(value, value * relative)

    @property
    def contradicted(self) -> bool:
        """Whether the recording differs from the prediction by more than errors and a tenth allow."""
        ratio = self.ratio
        away = abs(math.log(ratio.value)) if ratio.value > 0 else math.inf
        differs = away > max(math.log1p(_TOLERANCE), _SURELY * ratio.standard_error / ratio.value)
        bound = self.frame_to_frame
        less = bound.value + _SURELY * bound.standard_error < self.predicted.value / (1 + _TOLERANCE)
        return bool(not math.isfinite(away) or differs or less or self.noise_differs)

    @property
    def noise_differs(self) -> bool:
        """Whether the pixels' noise is not what it was taken for."""
        return abs(math.log(max(self.noise_ratio, 1e-9))) > math.log1p(_NOISE_TOLERANCE)

    @property
    def factor(self) -> float:
        """Factor by which slope errors are larger than promised; 1 where the recording does not contradict.

        Never below 1: errors that do not differ between the images compared are not seen.
        """
        return max(self.ratio.value, 1.0) if self.contradicted and math.isfinite(self.ratio.value) else 1.0

    @property
    def expected_px(self) -> float:
        """R at the star's flux as the recording has it, without errors that are the same in all frames."""
        return max(self.promised_px, self.placed_px) * self.factor

    def to_table(self) -> dict[str, Any]:
        """Return plain numbers, rounded, as written into a configuration."""
        numbers = {
            "flux_e": self.flux_e,
            "predicted_px": self.predicted.value,
            "predicted_error_px": self.predicted.standard_error,
            "measured_px": self.measured.value,
            "measured_error_px": self.measured.standard_error,
            "noise_ratio": self.noise_ratio,
            "promised_px": self.promised_px,
            "expected_px": self.expected_px,
            "unshared_px": self.unshared_px,
        }
        if math.isfinite(self.frame_to_frame.value):
            numbers["frame_to_frame_px"] = self.frame_to_frame.value
        return {
            "contradicted": self.contradicted,
            **{name: float(f"{value:.3g}") for name, value in numbers.items()},
        }


def check_promises(
    question: Question, methods: Mapping[str, tuple[Method, float]], *, rng: np.random.Generator | None = None
) -> dict[str, Promise]:
    """Predict and measure the slope errors of methods on the recording that a question brought along.

    Of every frame two images with the star's flux, or half the recording's where that is less, and with the
    camera's own read noise are made: both are the frame, scaled, with noise that is opposite in the two and
    cancels what they have in common, and more noise of their own. What differs in their slopes is error; the
    spots' movement is the same in both. The same methods measure pairs of simulated spots at the same places.

    Parameters
    ----------
    question : Question
        With recorded frames.
    methods : dict of str to (Method, float)
        Each with the options to check and R at the star's flux as promised.
    rng : numpy.random.Generator, optional
        Default: seed 1.

    Returns
    -------
    dict of str to Promise

    Examples
    --------
    >>> import faintspot as fs
    >>> from faintspot.experiments import check_promises, question_from_frames
    >>> question = question_from_frames(frames)  # doctest: +SKIP
    >>> best = fs.tune(question).best  # doctest: +SKIP
    >>> promised = {"best": (best.method, best.statistics.error.value)}  # doctest: +SKIP
    >>> check_promises(question, promised)["best"].contradicted  # doctest: +SKIP
    """
    pair_rng, *exposures = spawn(np.random.default_rng(1) if rng is None else rng, 4)
    images, fitted = _recorded(question)
    flux, excess = float(fitted.flux_e.mean()), question.detector.excess_noise_factor
    share = min(_LARGEST_SHARE, question.star_flux_e / flux)
    dark = question.read_noise_photoelectrons**2 + excess * question.background_e
    flat = images.reshape(-1, *question.spots.shape)
    ratio = variance_over_expected(flat, fitted, dark_variance_e2=dark, excess_noise=excess)
    if question.read_noise_photoelectrons < _COUNTABLE_E and excess == 1:
        pair = _dealt(images, share, question, pair_rng)
    else:
        spots = np.maximum(fitted.psf.images(fitted.positions, question.spots.shape, fitted.flux_e), 0.0)
        pair = _split(images, excess * spots.reshape(images.shape), dark, ratio, share, pair_rng)
    positions, camera = _spot_positions(question, fitted), question.detector
    exposed_images = []
    for flux_e, noise in zip((share * flux, share * flux, question.star_flux_e), exposures, strict=True):
        mean = _simulated(question, fitted.psf, positions, flux_e).reshape(images.shape)
        exposed = np.asarray(camera.to_electrons(camera.expose(mean, noise)), np.float64)
        exposed_images.append(exposed - question.background_e)
    truth = positions.reshape(*images.shape[:2], 2) - not_none(question.layout).offsets
    promises = {}
    for name, (method, promised_px) in methods.items():
        first, second, *simulated = (_measure(question, method, part) for part in (*pair, *exposed_images))
        promises[name] = Promise(
            share * flux,
            _error_of(simulated[0] - simulated[1], 2),
            _error_of(first - second, 2),
            _frame_to_frame(first),
            math.sqrt(ratio),
            promised_px,
            placed_px=_error_of(simulated[2] - truth, 1).value,
        )
    return _with_unshared(promises)


def _with_unshared(promises: dict[str, Promise]) -> dict[str, Promise]:
    """Add the error that images of one frame share, where the spots stay where they are.

    Movement is the same for all methods; one whose slopes scatter more from frame to frame has errors.
    """
    beyond, sure = {}, {}
    for name, promise in promises.items():
        scatter, noise = promise.frame_to_frame, promise.measured
        beyond[name] = scatter.value**2 - noise.value**2
        sure[name] = 2 * math.hypot(
            scatter.value * scatter.standard_error, noise.value * noise.standard_error
        )
    movement = max(min(beyond.values(), default=0.0), 0.0)
    least = min((promise.measured.value for promise in promises.values()), default=0.0)
    if not movement < least**2:  # of a single frame it is not a number
        return promises
    return {
        name: replace(promise, unshared_px=math.sqrt(max(beyond[name] - movement, 0.0)))
        if beyond[name] - movement > _SURELY * sure[name]
        else promise
        for name, promise in promises.items()
    }


def frames_to_check(layout: Layout) -> int:
    """Return how many frames hold spots enough to check slope errors on."""
    ny, nx = layout.window
    spots = max(_FEWEST_SPOTS, min(_SPOTS, _SPOTS * 256 // (ny * nx)))
    return max(_FEWEST_FRAMES, spots // len(layout))


def images_e(frames: NDArray[np.generic], layout: Layout, calibration: Calibration) -> Floats:
    """Return the images (n_frames, n, ny, nx) of frames in photo-electrons."""
    dark, electrons_per_adu = layout.images(calibration.maps(layout.frame_shape))
    images: Floats = (layout.images(frames) - dark) * electrons_per_adu
    return images


def _recorded(question: Question) -> tuple[Floats, LearntPSF]:
    """Images (n_frames, n, ny, nx) of the recording in photo-electrons, and the spots fitted to them."""
    layout, calibration = not_none(question.layout), not_none(question.calibration)
    images = images_e(not_none(question.recorded.frames)[: frames_to_check(layout)], layout, calibration)
    psf = question.spots.known_psf(max(question.spots.shape))
    camera = Calibration(read_noise_e=question.read_noise_photoelectrons, background_e=question.background_e)
    search = question.spots.search_range_px + float(np.abs(layout.offsets).max())
    flat = images.reshape(-1, *question.spots.shape)
    return images, fit_spots(flat, psf, calibration=camera, search_range_px=search)


def _spot_positions(question: Question, fitted: LearntPSF) -> Floats:
    """Positions (n, 2) of spots that vary as the recorded ones do, without the noise of their positions."""
    layout = not_none(question.layout)
    n_frames, reach = len(fitted.positions) // len(layout), question.spots.search_range_px
    middle = np.tile(layout.offsets, (n_frames, 1))
    offsets = np.clip(fitted.positions - middle, -reach, reach)
    mean, noise = offsets.mean(axis=0), np.mean(np.square(fitted.standard_error_px), axis=0)
    share = np.sqrt(np.maximum(1 - noise / np.maximum(offsets.var(axis=0), 1e-12), 0.0))
    positions: Floats = middle + mean + share * (offsets - mean)
    return positions


def _simulated(question: Question, psf: PSF, positions: Floats, flux_e: float) -> Floats:
    """Mean images (n, ny, nx) of simulated spots, electrons."""
    layout = not_none(question.layout)
    shares = question.spots.relative_flux
    relative = np.ones(len(layout)) if shares is None else shares
    flux = flux_e * np.tile(relative, len(positions) // len(layout))
    return np.maximum(psf.images(positions, question.spots.shape, flux), 0.0)


def _split(
    images: Floats,
    photon_variance: Floats,
    dark_variance: float,
    ratio: float,
    share: float,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Return two images of a share of the flux, the noise of both being the camera's and independent.

    The share's noise is the same in both, and so is its negative that is added to one and taken from the
    other: their covariance is zero. The rest of the noise is drawn.
    """
    expected = photon_variance + dark_variance
    opposite = share * np.sqrt(ratio * expected) * rng.standard_normal(images.shape)
    remainder = share * photon_variance + dark_variance - 2 * share**2 * expected
    deviation = np.sqrt(np.maximum(remainder, 0.0))
    first, second = (deviation * rng.standard_normal(images.shape) for _ in range(2))
    return share * images + opposite + first, share * images - opposite + second


def _dealt(
    images: Floats, share: float, question: Question, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Return the same where electrons can be counted: each goes to one of the two images, or to neither."""
    background, noise = question.background_e, question.read_noise_photoelectrons
    counts = np.rint(np.maximum(images + background, 0.0)).astype(np.int64)
    first = rng.binomial(counts, share)
    second = rng.binomial(counts - first, share / (1 - share))
    pair = (2, *images.shape)
    added = rng.poisson((1 - share) * background, pair) + noise * rng.standard_normal(pair) - background
    return first + added[0], second + added[1]


def _measure(question: Question, method: Method, images: Floats) -> Floats:
    """Slopes (n_frames, n, 2) of images as the pipeline measures them."""
    n_frames, n, ny, nx = images.shape
    # Images are in photo-electrons: the multiplication that is divided out only says how noisy they are.
    camera = replace(question.camera, gain_e_per_adu=question.em_gain)
    windows = Layout.grid((n, 1), pixels=(ny, nx))
    pipeline = SlopePipeline(
        windows, method.settings, camera, reference=not_none(question.layout).offsets, **method.parts
    )
    slopes = pipeline(images.reshape(n_frames, n * ny, nx).astype(np.float32))
    return np.stack([slopes.x, slopes.y], axis=-1).astype(np.float64)


def _error_of(differences: Floats, variances: float) -> Estimate:
    """R from differences that have so many times the variance of one slope."""
    errors = np.abs(differences).mean(axis=-1).ravel() / math.sqrt(variances)
    return Estimate(float(errors.mean()), float(errors.std() / math.sqrt(max(errors.size - 1, 1))))


def _frame_to_frame(slopes: Floats) -> Estimate:
    """R from differences of neighbouring frames; no movement can make it smaller than it is."""
    estimates = [
        _error_of(np.diff(slopes, order, axis=0), math.comb(2 * order, order))
        for order in _ORDERS
        if order < len(slopes)
    ]
    return min(estimates, key=lambda estimate: estimate.value, default=UNKNOWN)
