"""Choose the settings of every arm on one sample of spots, score them on another, and say which is best."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.checks import number_between
from faintspot.errors import InputError
from faintspot.estimate.bounds import MEAN_ABSOLUTE, cramer_rao
from faintspot.planner.answer import Answer, ArmResult
from faintspot.planner.arms import ARMS, Arm, Choice, Workshop
from faintspot.planner.curves import Curve, limiting_flux, magnitude_gain
from faintspot.planner.question import Question
from faintspot.planner.scene import Sample, Scene
from faintspot.sensor.score import TrainedScore
from faintspot.simulate.generators import spawn
from faintspot.slopes import Slopes
from faintspot.study.metric import Estimate, SlopeStatistics, absolute_errors, slope_statistics
from faintspot.training.simulation import CLASS_WIDTH, train_estimator

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]

_REALISATIONS, _FEWEST_REALISATIONS = 4096, 1024  # of 16 x 16 px; fewer of larger windows
_SPECKLED_SHARE = 0.5  # of the realisations, as speckled spots are slow to simulate
_STEP_MAGNITUDES = 0.75  # between the fluxes of the plot: a factor of 2
_STEPS_EACH_SIDE = 4
_ROUNDS = 2  # of looking along each axis in turn
_BLOCKS = 16  # of the scored spots, whose scatter says how sure a difference is
_TIE_ERRORS = 2.0  # standard errors of the difference within which two arms are equally good
_OUTLIER_PX = 1.0
_ERROR_TOLERANCE = 0.05  # of the standard errors, below which they need no factor
_TRAINING_SHARE = 0.75  # of the scored spots, to train each class on


def tune(
    question: Question,
    *,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
    realisations: int | None = None,
    steps: int = _STEPS_EACH_SIDE,
) -> Answer:
    """Find out which estimator suits a camera and a star best, with which settings.

    Spots are simulated at the star's flux and, for the plot, up to 3 magnitudes brighter and fainter. On one
    sample each arm's free parameters are chosen for the smallest gain-corrected rms error, along one axis at
    a time from the automatic rules' values; on another sample, the same for all arms, they are scored.

    Recommended is the arm of the smallest gain-corrected rms error at the star's flux. R alone flatters
    estimators that fall back to the reference position. Of arms within two standard errors (of the
    difference, on the same spots) of the best, the one that has to know least is taken, and of these the
    cheapest.

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
    """
    if not isinstance(question, Question):
        raise InputError(f"question: expected a faintspot.planner.Question, got {type(question).__name__}")
    wanted = _default_realisations(question) if realisations is None else realisations
    number = int(number_between("realisations", wanted, 256, integer=True))
    around = int(number_between("steps", steps, 1, 20, integer=True))
    scene_rng, score_rng, noise_rng, resampling_rng = spawn(
        np.random.default_rng(1) if rng is None else rng, 4
    )
    flux = question.star_flux_e * 10 ** (0.4 * _STEP_MAGNITUDES * np.arange(-around, around + 1.0))
    left_out = _left_out(question)
    arms = [arm for arm in ARMS if arm.name not in left_out]
    classes = 1 + 2 * round(math.log(flux[-1] / question.star_flux_e) / math.log(CLASS_WIDTH) - 0.5)
    report = _Steps(progress, len(arms) * len(flux) + classes)
    scene = Scene.of(question, number, scene_rng)
    score = None
    if "trained" not in left_out:
        score = _trained(question, int(_TRAINING_SHARE * number), classes, score_rng)
    report.add(classes)
    workshop = Workshop(question, score)
    scored: dict[str, list[_Scored]] = {arm.name: [] for arm in arms}
    for level, level_rng in zip(flux, spawn(noise_rng, len(flux)), strict=True):
        choosing, scoring = scene.exposed(float(level), level_rng)
        for arm in arms:
            scored[arm.name].append(_chosen_and_scored(arm, scene, workshop, float(level), choosing, scoring))
            report.add(1)
    return _answer(question, arms, scored, flux, left_out, resampling_rng)


@dataclass(frozen=True, eq=False)
class _Scored:
    """An arm at one flux."""

    settings: Any
    parts: dict[str, Any]
    errors: Floats
    """(|dx| + |dy|) / 2 of each scored spot."""
    statistics: SlopeStatistics
    blocks: Floats
    """Logarithm of the gain-corrected rms of each block of spots."""


class _Steps:
    """Counts finished steps."""

    def __init__(self, progress: Progress | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, 0

    def add(self, count: int) -> None:
        self._done += count
        if self._progress is not None:
            self._progress(self._done, self._total)


def _default_realisations(question: Question) -> int:
    ny, nx = question.shape
    share = min(1.0, 256 / (ny * nx)) * (_SPECKLED_SHARE if question.d_over_r0 else 1.0)
    return max(_FEWEST_REALISATIONS, round(_REALISATIONS * share))


def _left_out(question: Question) -> dict[str, str]:
    """Return the arms that cannot be tried, and why."""
    if question.psf is not None:
        return {
            "trained": "its training simulates assumed profiles; faintspot.training.train_from_frames learns "
            "from frames"
        }
    return {}


def _trained(question: Question, realisations: int, classes: int, rng: np.random.Generator) -> TrainedScore:
    """Train the score for fluxes around the star's, the star in the middle of a class."""
    reach = CLASS_WIDTH ** (classes / 2)
    return train_estimator(
        flux_e=(question.star_flux_e / reach, question.star_flux_e * reach),
        detector=question.detector,
        shape=question.shape,
        profile=question.profile,
        size=question.size,
        d_over_r0=question.d_over_r0,
        position_range_px=question.search_range_px,
        search_range_px=question.search_range_px,
        realisations=realisations,
        rng=rng,
    )


def _chosen_and_scored(
    arm: Arm, scene: Scene, workshop: Workshop, flux_e: float, choosing: Sample, scoring: Sample
) -> _Scored:
    """Choose an arm's free parameters on one sample, and score it on the other."""

    def along(choice: Choice, name: str, values: list[float]) -> list[float]:
        """How bad each value of one axis is, the others staying."""
        settings = workshop.settings(arm, choice)
        if name == "blur_px":
            each = [
                scene.measure(choosing, settings, **workshop.parts(arm, {**choice, name: value}))
                for value in values
            ]
            return [_badness(slopes.x, slopes.y, choosing.truth) for slopes in each]
        chosen = [getattr(workshop.settings(arm, {**choice, name: value}), name) for value in values]
        found = scene.measure_each(choosing, settings, name, chosen, **workshop.parts(arm, choice))
        return [_badness(x, y, choosing.truth) for x, y in found]

    choice = _best_choice(workshop.axes(arm, flux_e), along)
    settings, parts = workshop.settings(arm, choice), workshop.parts(arm, choice)
    scale = _error_scale(scene.measure(choosing, settings, **parts), choosing.truth)
    settings = settings.replace(error_scale=scale)
    slopes = scene.measure(scoring, settings, **parts)
    return _Scored(
        settings,
        parts,
        absolute_errors(slopes.x, slopes.y, scoring.truth).ravel(),
        slope_statistics(slopes.x, slopes.y, scoring.truth),
        _by_blocks(slopes, scoring.truth),
    )


def _error_scale(slopes: Slopes, truth: Floats) -> float:
    """Return by how much the stated standard errors must grow to be the actual ones; 1 where they nearly are.

    Of errors below 1 px: outliers are not what a standard error tells.
    """
    actual = np.stack([slopes.x, slopes.y], axis=-1) - truth
    stated = np.stack([slopes.standard_error_x, slopes.standard_error_y], axis=-1)
    good = np.all(np.isfinite(stated) & (np.abs(actual) < _OUTLIER_PX), axis=-1)
    if not np.any(stated[good] > 0):
        return 1.0
    scale = float(np.sqrt(np.mean(actual[good] ** 2) / np.mean(stated[good] ** 2)))
    return 1.0 if abs(scale - 1.0) < _ERROR_TOLERANCE else max(round(scale, 2), 0.01)


def _badness(x: NDArray[Any], y: NDArray[Any], truth: Floats) -> float:
    """Gain-corrected rms; where nothing is measured, the rms, behind all that measure something."""
    found = slope_statistics(x, y, truth)
    corrected = found.corrected_rms.value
    return corrected if math.isfinite(corrected) else 1e6 + found.rms.value


def _best_choice(
    axes: dict[str, list[float]], along: Callable[[Choice, str, list[float]], list[float]]
) -> Choice:
    """Look along each axis in turn, from the first values, `_ROUNDS` times."""
    best: Choice = {name: values[0] for name, values in axes.items()}
    names = list(axes)
    looked: dict[str, Choice] = {}
    for name in names * (_ROUNDS if len(axes) > 1 else 1):
        others = {key: value for key, value in best.items() if key != name}
        if looked.get(name) != others:  # else nothing has changed since
            looked[name] = others
            best = {**best, name: axes[name][int(np.argmin(along(best, name, axes[name])))]}
    return best


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


def _answer(
    question: Question,
    arms: list[Arm],
    scored: dict[str, list[_Scored]],
    flux: Floats,
    left_out: dict[str, str],
    rng: np.random.Generator,
) -> Answer:
    star = len(flux) // 2
    curves = {arm.name: Curve(flux, np.stack([one.errors for one in scored[arm.name]])) for arm in arms}
    budget = question.budget_px
    results = []
    for arm in arms:
        own, curve = scored[arm.name][star], curves[arm.name]
        results.append(
            ArmResult(
                arm=arm,
                settings=own.settings,
                statistics=own.statistics,
                curve=curve,
                over_plain=magnitude_gain(curves["plain"], curve, star, rng),
                over_thresholded=magnitude_gain(curves["thresholded"], curve, star, rng),
                limiting_flux_e=None if budget is None else limiting_flux(curve, budget, rng),
                **own.parts,
            )
        )
    ranked = _ranked(results, {name: found[star].blocks for name, found in scored.items()})
    return Answer(question, flux, tuple(results), ranked, _bound(question, flux), left_out)


def _ranked(results: list[ArmResult], blocks: dict[str, Floats]) -> tuple[str, ...]:
    """Return the names of the arms that are as good as the best one, the recommended one first."""
    best = min(results, key=lambda result: _corrected(result.statistics.corrected_rms))
    equal = [best]
    for result in results:
        with np.errstate(invalid="ignore"):
            difference = blocks[result.arm.name] - blocks[best.arm.name]
        known = difference[np.isfinite(difference)]
        if result is not best and len(known) == len(difference) > 1:
            error = float(known.std(ddof=1)) / math.sqrt(len(known))
            if float(known.mean()) <= _TIE_ERRORS * error:
                equal.append(result)
    equal.sort(key=lambda result: (result.arm.knowledge, result.arm.cost))
    return tuple(result.arm.name for result in equal)


def _corrected(rms: Estimate) -> float:
    return rms.value if math.isfinite(rms.value) else math.inf


def _bound(question: Question, flux: Floats) -> Floats:
    """R of an estimator at the Cramer-Rao bound, without speckles, px."""
    form: dict[str, Any] = {"profile": question.profile, "size": question.size}
    if question.psf is not None:
        form = {"psf": question.psf}
    errors = cramer_rao(
        flux,
        shape=question.shape,
        detector=question.detector,
        position_range_px=question.search_range_px,
        **form,
    )
    bound: Floats = MEAN_ABSOLUTE * errors.mean(axis=-1)
    return bound
