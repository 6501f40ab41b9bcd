"""Choose the settings of every method on one sample of spots, score them on another, and recommend one."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between, spawn
from faintspot.base.errors import InputError
from faintspot.base.statistics import OUTLIER_PX, Estimate, SlopeStatistics, absolute_errors, slope_statistics
from faintspot.experiments.curves import Curve, limiting_flux, magnitude_gain
from faintspot.experiments.methods import (
    Choice,
    Knowledge,
    coordinate_search,
    corrected_badness,
    method_for_scene,
    tuned_options,
)
from faintspot.experiments.planner.answer import Answer, MethodResult
from faintspot.experiments.planner.promise import Promise, check_promises
from faintspot.experiments.planner.question import Question, SimulatedSpots, SpotFrames
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels, Thresholded
from faintspot.slopes.estimators.registry import estimators
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.spots.bounds import MEAN_ABSOLUTE, cramer_rao
from faintspot.slopes.spots.psf import PSF

Progress = Callable[[int, int], None]

_REALISATIONS, _FEWEST_REALISATIONS = 4096, 1024  # of 16 x 16 px; fewer of larger windows
_SPECKLED_SHARE = 0.5  # of the realisations, as speckled spots are slow to simulate
_STEP_MAGNITUDES = 0.75  # between the fluxes of the plot: a factor of 2
_STEPS_EACH_SIDE = 4
_BLOCKS = 16  # of the scored spots, whose scatter says how sure a difference is
_TIE_ERRORS = 2.0  # standard errors of the difference within which two methods are equally good
_ERROR_TOLERANCE = 0.05  # of the standard errors, below which they need no factor
_SEARCHED_E = (0.1, 1e7)  # electrons within which the limiting flux is sought
_SEARCH_STEPS = 4  # fluxes that are added at a time
_BOUND_SHARES = 9  # quantiles of the sub-apertures' flux that the bound is averaged over


def tune(
    question: Question,
    *,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
    realisations: int | None = None,
    steps: int = _STEPS_EACH_SIDE,
) -> Answer:
    """Find out which estimator suits a camera and a star best, with which settings.

    Every estimator that is registered takes part. Spots are simulated at the star's flux and, for the plot,
    up to 3 magnitudes brighter and fainter; with a budget further, until the limiting flux is found. On one
    sample each method's free parameters are chosen for the smallest gain-corrected rms error, along one axis
    at a time from the automatic rules' values; on another sample, the same for all methods, they are scored.

    Recommended is the method of the smallest gain-corrected rms error at the star's flux, times the factor by
    which the recording, if any, contradicts it (`Answer.promises`). R alone flatters estimators that fall
    back to the reference position. Of methods within two standard errors (of the difference, on the same
    spots) of the best, the one that has to know least is taken, and of these the cheapest.

    Parameters
    ----------
    question : Question
    rng : numpy.random.Generator, optional
        Where spots and noise come from. Default: seed 1, so that the answer can be repeated.
    progress : callable, optional
        Called with the finished and the total number of steps.
    realisations : int, optional
        Spots that are scored; half as many to choose on. Default: 4096 of 16 x 16 px, fewer of larger windows
        and of speckled spots, so that an answer takes seconds.
    steps : int
        Fluxes on each side of the star's, a factor of 2 apart.

    Returns
    -------
    Answer

    Raises
    ------
    InputError
        For a question of the wrong kind or numbers out of range.

    Examples
    --------
    >>> import faintspot as fs
    >>> from faintspot.experiments import Question
    >>> question = Question(read_noise_e=3.0, pixels=8, fwhm_px=1.8, flux_e=200.0)
    >>> answer = fs.tune(question, realisations=256, steps=1)
    >>> sorted(result.method.name for result in answer.results)[:3]
    ['brightest', 'centroid', 'map']
    >>> answer.save("faintspot.toml")
    >>> fs.Settings.load("faintspot.toml").estimator.name == answer.best.method.name
    True
    """
    if not isinstance(question, Question):
        raise InputError(f"question: expected a Question, got {type(question).__name__}")
    count = _default_realisations(question) if realisations is None else realisations
    number = int(number_between("realisations", count, 256, integer=True))
    each_side = int(number_between("steps", steps, 1, 20, integer=True))
    spots_rng, noise_rng, resampling_rng = spawn(np.random.default_rng(1) if rng is None else rng, 3)
    spots = SimulatedSpots.of(question, number, spots_rng)
    trial = _Trial(question, spots, noise_rng, progress)
    trial.add(range(-each_side, each_side + 1))
    answer = trial.answer(resampling_rng)
    while question.budget_px is not None and (further := _further(answer, trial.steps)):
        trial.add(further)
        answer = trial.answer(resampling_rng)
    return answer


def _further(answer: Answer, steps: Sequence[int]) -> list[int]:
    """Return steps of flux beyond those tried, where limiting fluxes are wanted that were not found."""
    results = [answer.best, answer[BrightestPixels.name]]
    limits = [result.limiting_flux_e.value for result in results if result.limiting_flux_e is not None]
    further = []
    if 0.0 in limits:
        further += [min(steps) - 1 - step for step in range(_SEARCH_STEPS)]
    if math.inf in limits:
        further += [max(steps) + 1 + step for step in range(_SEARCH_STEPS)]
    low, high = _SEARCHED_E
    star = answer.question.star_flux_e
    return sorted(step for step in further if low <= _flux_of(star, step) <= high)


def _flux_of(star_flux_e: float, step: int) -> float:
    return float(star_flux_e * 10 ** (0.4 * _STEP_MAGNITUDES * step))


@dataclass(frozen=True, eq=False)
class _Scored:
    """A method at one flux."""

    method: Method
    errors: Floats
    """(|dx| + |dy|) / 2 of each scored spot."""
    statistics: SlopeStatistics
    blocks: Floats
    """Logarithm of the gain-corrected rms of each block of spots."""


@dataclass(eq=False)
class _Trial:
    """All estimators at all fluxes that were tried."""

    question: Question
    spots: SimulatedSpots
    noise_rng: np.random.Generator
    progress: Progress | None

    def __post_init__(self) -> None:
        self._left_out: dict[str, str] = {}
        self._kinds = dict(estimators())
        self._scored: dict[int, dict[str, _Scored]] = {}
        self._finished = self._to_do = 0

    @property
    def steps(self) -> list[int]:
        """Fluxes that were tried, in steps from the star's."""
        return sorted(self._scored)

    def add(self, steps: Sequence[int]) -> None:
        """Try more fluxes."""
        fluxes = [_flux_of(self.question.star_flux_e, step) for step in steps]
        self._to_do += len(self._kinds) * len(fluxes)
        for step, flux, rng in zip(steps, fluxes, spawn(self.noise_rng, len(fluxes)), strict=True):
            samples = self.spots.exposed(flux, rng)
            self._scored[step] = {}
            for name, kind in list(self._kinds.items()):
                try:
                    self._scored[step][name] = self._tried(kind, flux, samples)
                except InputError as error:
                    if name in (BrightestPixels.name, Thresholded.name):  # what all are compared with
                        raise
                    self._left_out[name] = f"it refuses {flux:.3g} electrons per spot: {error}"
                    del self._kinds[name]
                self._finished += 1
                if self.progress is not None:
                    self.progress(self._finished, self._to_do)

    def _tried(self, kind: type[Estimator], flux_e: float, samples: Sequence[SpotFrames]) -> _Scored:
        """Choose an estimator's options on the first sample, and score it on the second."""
        scene, spots = self.question.scene(flux_e), self.spots
        (first, second), method = samples, method_for_scene(kind, scene, psf=self._psf)
        if method.estimator.uses_flux and self.question.flux_is_known:
            method = method.with_options({"flux_e": float(f"{flux_e:.4g}")})

        def badness(choice: Choice, name: str, values: Sequence[object]) -> list[float]:
            measured = spots.measure_each(first, method.with_options(choice), name, values)
            return [corrected_badness(x, y, first.truth) for x, y in measured]

        chosen = method.with_options(coordinate_search(tuned_options(method, scene), badness))
        error_scale = _error_scale(spots.measure(first, chosen), first.truth)
        chosen = chosen.with_options({"error_scale": error_scale})
        slopes, truth = spots.measure(second, chosen), second.truth
        errors = absolute_errors(slopes.x, slopes.y, truth).ravel()
        statistics = slope_statistics(slopes.x, slopes.y, truth)
        return _Scored(chosen, errors, statistics, _by_blocks(slopes, truth))

    @cached_property
    def _psf(self) -> PSF:
        """The user's PSF, or that of the assumed profile."""
        spots = self.question.spots
        return spots.known_psf(math.ceil(max(spots.shape) / 2 + spots.search_range_px + 1))

    def answer(self, rng: np.random.Generator) -> Answer:
        """Return what the fluxes tried so far say."""
        question, at_star = self.question, self._scored[0]
        flux = np.array([_flux_of(question.star_flux_e, step) for step in self.steps])
        errors = {name: np.stack([self._scored[s][name].errors for s in self.steps]) for name in self._kinds}
        curve = Curve.of_errors(flux, errors)

        def over(name: str, reference: type[Estimator]) -> Estimate:
            star = question.star_flux_e
            return magnitude_gain(curve, star, rng, method=name, reference=reference.name)

        budget = question.budget_px
        results = [
            MethodResult(
                at_star[name].method,
                at_star[name].statistics,
                over(name, BrightestPixels),
                over(name, Thresholded),
                None if budget is None else limiting_flux(curve, name, budget, rng),
            )
            for name in self._kinds
        ]
        factors = {name: promise.factor for name, promise in self._promises.items()}
        ranked = _ranked(results, {name: scored.blocks for name, scored in at_star.items()}, factors)
        bound, count = _bound(question, flux), errors[BrightestPixels.name].shape[1]
        return Answer(question, curve, tuple(results), ranked, bound, count, self._left_out, self._promises)

    @cached_property
    def _promises(self) -> dict[str, Promise]:
        """The methods at the star's flux, checked on the recording."""
        if self.question.recorded.frames is None:
            return {}
        methods = {
            name: (scored.method, scored.statistics.error.value) for name, scored in self._scored[0].items()
        }
        return check_promises(self.question, methods)


def _default_realisations(question: Question) -> int:
    ny, nx = question.spots.shape
    share = min(1.0, 256 / (ny * nx)) * (_SPECKLED_SHARE if question.spots.d_over_r0 else 1.0)
    return max(_FEWEST_REALISATIONS, round(_REALISATIONS * share))


def _error_scale(slopes: Slopes, truth: Floats) -> float:
    """Return by how much the stated standard errors must grow to be the actual ones; 1 where they nearly are.

    Of errors below 1 px: outliers are not what a standard error tells.
    """
    actual = np.stack([slopes.x, slopes.y], axis=-1) - truth
    stated = np.stack([slopes.standard_error_x, slopes.standard_error_y], axis=-1)
    good = np.all(np.isfinite(stated) & (np.abs(actual) < OUTLIER_PX), axis=-1)
    if not np.any(stated[good] > 0):
        return 1.0
    scale = float(np.sqrt(np.mean(actual[good] ** 2) / np.mean(stated[good] ** 2)))
    return 1.0 if abs(scale - 1.0) < _ERROR_TOLERANCE else max(round(scale, 2), 0.01)


def _by_blocks(slopes: Slopes, truth: Floats) -> Floats:
    """Return the logarithm of the gain-corrected rms of blocks of frames; infinite where not defined."""
    blocks = np.array_split(np.arange(len(truth)), min(_BLOCKS, len(truth)))
    values = [
        slope_statistics(slopes.x[block], slopes.y[block], truth[block]).corrected_rms.value
        for block in blocks
    ]
    with np.errstate(divide="ignore"):
        logarithms: Floats = np.log(np.array(values))
    return logarithms


def _ranked(
    results: list[MethodResult], blocks: Mapping[str, Floats], factors: Mapping[str, float]
) -> tuple[str, ...]:
    """Return the names of the methods that are as good as the best one, the recommended one first.

    `factors` are those by which a recording has larger errors than the simulated spots.
    """

    def corrected(result: MethodResult) -> float:
        return result.statistics.ranking_rms * factors.get(result.method.name, 1.0)

    best = min(results, key=corrected)
    equal = [best]
    for result in results:
        with np.errstate(invalid="ignore"):
            difference = blocks[result.method.name] - blocks[best.method.name]
            difference += math.log(factors.get(result.method.name, 1.0) / factors.get(best.method.name, 1.0))
        finite = difference[np.isfinite(difference)]
        if result is not best and len(finite) == len(difference) > 1:
            error = float(finite.std(ddof=1)) / math.sqrt(len(finite))
            if float(finite.mean()) <= _TIE_ERRORS * error:
                equal.append(result)
    equal.sort(key=lambda result: (Knowledge.of(result.method.estimator), result.method.estimator.cost))
    return tuple(result.method.name for result in equal)


def _bound(question: Question, flux: Floats) -> Floats:
    """R of an estimator at the Cramer-Rao bound, without speckles, px."""
    shares, spots = np.ones(1), question.spots
    if spots.relative_flux is not None:
        shares = np.quantile(spots.relative_flux, (np.arange(_BOUND_SHARES) + 0.5) / _BOUND_SHARES)
    errors = cramer_rao(
        np.outer(flux, shares).ravel(),
        detector=question.detector,
        position_range_px=spots.search_range_px,
        **spots.form,
    )
    bound: Floats = MEAN_ABSOLUTE * errors.mean(axis=-1).reshape(len(flux), -1).mean(axis=1)
    return bound
