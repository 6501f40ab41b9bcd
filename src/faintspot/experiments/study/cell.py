"""One cell of a study: simulate, choose each method's settings on one half, score them on the other.

All methods see the same images. They are simulated and measured block by block, so that memory does not grow
with the number of realisations.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none
from faintspot.base.statistics import OUTLIER_PX, slope_statistics
from faintspot.experiments.methods import keeps_every_k, knows_the_spot
from faintspot.experiments.study.cell_methods import (
    Block,
    Candidate,
    CellMethods,
    Measured,
    errors_of,
    moments_of,
    shown,
)
from faintspot.experiments.study.specification import BEST, CORRECTED, StudySpecification
from faintspot.experiments.study.sweep import Cell
from faintspot.slopes.simulate import subapertures
from faintspot.slopes.spots.bounds import MEAN_ABSOLUTE, cramer_rao, photon_efficiency

Chosen = tuple[Candidate, int | None]
"""Candidate and number of kept pixels less one of a method in a mode; None where every k is not measured."""


class Tuning:
    """Errors of all candidates on the first half of a cell's images, and what follows from them."""

    def __init__(self, methods: CellMethods) -> None:
        self._methods, specification = methods, methods.specification
        self._modes = specification.kept_pixels(methods.cell)
        self._candidates = {method: methods.candidates(method) for method in specification.estimators}
        self._errors: dict[str, Any] = dict.fromkeys(self._candidates, 0.0)  # sums over images
        self._moments: dict[str, Any] = dict.fromkeys(self._candidates, 0.0)

    def add(self, blocks: Sequence[Block]) -> None:
        """Add images and their true positions."""
        for method, candidates in self._candidates.items():
            if len(candidates) == 1 and not keeps_every_k(self._methods.kinds[method]):
                continue  # there is nothing to choose
            for images, truth in self._methods.parts(method, blocks):
                estimates = [self._methods.positions(method, option, images)[0] for option in candidates]
                self._errors[method] += np.stack(
                    [errors_of(xy, truth[:, None]).sum(axis=0) for xy in estimates]
                )
                if CORRECTED in self._modes:
                    self._moments[method] += np.stack([moments_of(xy, truth) for xy in estimates], axis=1)

    def choices(self) -> dict[tuple[str, str], Chosen]:
        """Return the choice of every method and mode."""
        chosen: dict[tuple[str, str], Chosen] = {}
        for method, candidates in self._candidates.items():
            for mode, kept in self._modes.items():
                if np.ndim(self._errors[method]) == 0:
                    chosen[method, mode] = candidates[0], None
                    continue
                errors = _corrected_rms(self._moments[method]) if mode == CORRECTED else self._errors[method]
                chosen[method, mode] = _smallest(candidates, errors, kept)
        return chosen


def _smallest(candidates: Sequence[Candidate], errors: Floats, kept: int | None) -> Chosen:
    """Return the candidate, and where `kept` is None the k, of a table's smallest error (candidates, K)."""
    if errors.shape[1] == 1:
        return candidates[int(np.argmin(errors))], None
    if kept is not None:
        return candidates[int(np.argmin(errors[:, kept - 1]))], kept - 1
    row, column = np.unravel_index(np.argmin(errors), errors.shape)
    return candidates[int(row)], int(column)


def _corrected_rms(moments: Floats) -> Floats:
    """Root mean square of the residuals over the gain, as `slope_statistics`."""
    n, true_x, true_y, true_squares, x, y, squares, across = moments
    spread = true_squares - (np.square(true_x) + np.square(true_y)) / n
    product = across - (x * true_x + y * true_y) / n
    spread_of_estimates = squares - (np.square(x) + np.square(y)) / n
    gain = product / spread
    residual = np.maximum(spread_of_estimates - gain * product, 0.0) / (2 * n)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gain > 0, np.sqrt(residual) / gain, np.inf)


_BLOCK_PIXELS = 1 << 18  # small enough for the processor's cache
_STACK_PIXELS = 1 << 21  # that an estimator measures at once


STATISTICS = ("gain", "rms", "corrected_rms", "outlier_fraction")
"""Variables beside R that are made with their standard errors, from `slope_statistics`."""


def realisations(cell: Cell, count: int, rng: np.random.Generator) -> Iterator[Block]:
    """Yield blocks of noisy images (n, side, side), the mean background subtracted, and true positions."""
    block = _BLOCK_PIXELS // cell.pixels**2
    for start in range(0, count, block):
        images, truth = subapertures(
            min(block, count - start),
            flux_e=cell.flux_e,
            d_over_r0=cell.d_over_r0,
            rng=rng,
            **cell.conditions,
        )
        yield images - np.float32(cell.background_e), truth


def _stacks(blocks: Iterable[Block], pixels: int) -> Iterator[list[Block]]:
    """Yield several blocks at a time."""
    stack: list[Block] = []
    for block in blocks:
        stack.append(block)
        if sum(len(truth) for _, truth in stack) * pixels**2 >= _STACK_PIXELS:
            yield stack
            stack = []
    if stack:
        yield stack


def measure_cell(cell: Cell, specification: StudySpecification) -> dict[str, NDArray[np.generic]]:
    """Measure one cell of a study.

    Parameters
    ----------
    cell : Cell
    specification : StudySpecification

    Returns
    -------
    dict
        The variables of the study's dataset for this cell (`experiments.study.run.VARIABLES`), without
        the dimension cell; K = pixels^2 - 1. NaN in modes that keep more pixels than the window can.

    Examples
    --------
    >>> from faintspot.experiments import StudySpecification, Sweep, measure_cell
    >>> light = Sweep("light", flux_e=100, pixels=8)
    >>> study = StudySpecification("mine", [light], realisations=400, estimators=["brightest"], fixed_k=[])
    >>> measured = measure_cell(study.cells()[0], study)
    >>> print(f"R = {measured['error'][0, 0]:.2f} px, {measured['chosen_k'][0, 0]:.0f} pixels kept")
    R = 0.07 px, 12 pixels kept
    """
    rng = np.random.default_rng(cell.seed(specification.seed))
    half = specification.realisations // 2
    methods: CellMethods | None = None
    for stack in _stacks(realisations(cell, half, rng), cell.pixels):
        if methods is None:
            flux = np.concatenate([images.sum(axis=(1, 2), dtype=np.float64) for images, _ in stack])
            methods = CellMethods(cell, specification, float(flux.mean()))
            tuning = Tuning(methods)
        tuning.add(stack)
    methods = not_none(methods)
    scores = Scores(methods, tuning.choices())
    for stack in _stacks(realisations(cell, specification.realisations - half, rng), cell.pixels):
        scores.add(stack)
    return _results(scores)


class Scores:
    """Positions with the chosen settings, stack after stack."""

    def __init__(self, methods: CellMethods, choices: dict[tuple[str, str], Chosen]) -> None:
        self.methods, self.choices = methods, choices
        self._truth: list[Floats] = []
        self._measured: dict[tuple[str, str], list[tuple[Floats, Any]]] = {key: [] for key in choices}
        self._stated: dict[str, list[Floats]] = {}
        self.sums: dict[str, Any] = {}  # of the errors and of their squares, for every k

    @property
    def truth(self) -> Floats:
        """True positions (n, 2), px."""
        return np.concatenate(self._truth)

    def add(self, blocks: Sequence[Block]) -> None:
        """Score images."""
        self._truth += [truth for _, truth in blocks]
        modes_of: dict[tuple[str, Candidate], list[str]] = {}
        for (method, mode), (candidate, _) in self.choices.items():
            modes_of.setdefault((method, candidate), []).append(mode)
        for (method, candidate), modes in modes_of.items():
            for images, truth in self.methods.parts(method, blocks):
                self._add(method, modes, truth, self.methods.positions(method, candidate, images))

    def _add(self, method: str, modes: list[str], truth: Floats, measured: Measured) -> None:
        """Add positions that a method measured for the modes that chose its candidate."""
        positions, valid, stated = measured
        for mode in modes:
            column = self.choices[method, mode][1] or 0
            self._measured[method, mode].append((positions[:, column], valid[:, column]))
        if BEST not in modes:
            return
        if stated is None:
            errors = errors_of(positions, truth[:, None])
            sums = np.stack([errors.sum(axis=0), np.square(errors).sum(axis=0)])
            self.sums[method] = self.sums.get(method, 0.0) + sums
        elif knows_the_spot(method):
            self._stated.setdefault(method, []).append(stated)

    def positions(self, method: str, mode: str) -> Floats:
        """Return the positions of all realisations, (n, 2) px."""
        return np.concatenate([positions for positions, _ in self._measured[method, mode]])

    def valid(self, method: str, mode: str) -> NDArray[np.bool_]:
        """Return which realisations have a valid position."""
        return np.concatenate([valid for _, valid in self._measured[method, mode]])

    def stated(self, method: str) -> Floats | None:
        """Return the standard errors (n, 2) that an estimator states, px, in mode "best"."""
        return np.concatenate(self._stated[method]) if method in self._stated else None


def _results(scores: Scores) -> dict[str, NDArray[np.generic]]:
    """Arrange choices and scores as the dataset has them."""
    cell, specification, truth = scores.methods.cell, scores.methods.specification, scores.truth
    methods, modes = specification.estimators, specification.modes
    names = ["error", "error_se", "chosen_k", "chosen_candidate", "chosen_model_error", "invalid_fraction"]
    names += [name for statistic in STATISTICS for name in (statistic, f"{statistic}_se")]
    results: dict[str, NDArray[Any]] = {name: np.full((len(methods), len(modes)), np.nan) for name in names}
    results["error_covariance"] = np.full((len(modes), len(methods), len(methods)), np.nan)
    for j, mode in enumerate(modes):
        if (methods[0], mode) not in scores.choices:
            continue
        positions = [scores.positions(method, mode) for method in methods]
        errors = np.stack([errors_of(part, truth) for part in positions])
        covariance = _covariance_of_means(errors)
        results["error"][:, j] = errors.mean(axis=1)
        results["error_se"][:, j] = np.sqrt(np.diag(covariance))
        results["error_covariance"][j] = covariance
        for i, method in enumerate(methods):
            candidate, column = scores.choices[method, mode]
            results["chosen_k"][i, j] = np.nan if column is None else column + 1
            results["chosen_candidate"][i, j] = shown(candidate)
            results["chosen_model_error"][i, j] = shown(candidate, "model_error")
            results["invalid_fraction"][i, j] = 1.0 - scores.valid(method, mode).mean()
            statistics = slope_statistics(positions[i][:, 0], positions[i][:, 1], truth)
            for name in STATISTICS:
                estimate = getattr(statistics, name)
                results[name][i, j] = estimate.value
                results[f"{name}_se"][i, j] = estimate.standard_error
    results |= _stated_over_actual(scores) | _results_at_k(scores)
    return results | _against_the_bound(cell, results["error"])


def _stated_over_actual(scores: Scores) -> dict[str, NDArray[Any]]:
    """Root mean squares of stated standard errors and of errors: their ratio, without outliers and with."""
    methods = scores.methods.specification.estimators
    without, with_outliers = np.full((2, len(methods)), np.nan)
    for i, method in enumerate(methods):
        stated = scores.stated(method)
        if stated is not None:
            errors = scores.positions(method, BEST) - scores.truth
            finite = np.all(np.isfinite(stated), axis=1)
            near = finite & np.all(np.abs(errors) <= OUTLIER_PX, axis=1)
            without[i], with_outliers[i] = (
                np.sqrt(np.mean(np.square(stated[part])) / np.mean(np.square(errors[part])))
                if part.any()
                else np.nan
                for part in (near, finite)
            )
    return {"stated_over_actual": without, "stated_over_actual_all": with_outliers}


def _against_the_bound(cell: Cell, errors: Floats) -> dict[str, NDArray[Any]]:
    """Cramer-Rao bound and photon efficiency; NaN for speckled spots, whose bound is not known."""
    bounds, efficiency = np.full(2, np.nan), np.full(errors.shape, np.nan)
    if cell.d_over_r0 == 0:
        bound = cramer_rao(cell.flux_e, **cell.conditions)
        bounds = np.array([MEAN_ABSOLUTE * bound.mean(), np.sqrt(np.mean(np.square(bound)))])
        measured = errors > 0
        efficiency[measured] = photon_efficiency(errors[measured], cell.flux_e, **cell.conditions)
    return {"bound": bounds[0], "bound_rms": bounds[1], "photon_efficiency": efficiency}


def _results_at_k(scores: Scores) -> dict[str, NDArray[Any]]:
    """R and its standard error for every k, at the candidate of mode "best"."""
    methods, count = scores.methods.specification.estimators, len(scores.truth)
    errors, standard_errors = np.full((2, len(methods), scores.methods.cell.pixels**2 - 1), np.nan)
    for i, method in enumerate(methods):
        if method in scores.sums:
            mean, mean_square = scores.sums[method] / count
            errors[i] = mean
            standard_errors[i] = np.sqrt(np.maximum(mean_square - mean**2, 0.0) / (count - 1))
    return {"error_at_k": errors, "error_at_k_se": standard_errors}


def _covariance_of_means(errors: Floats) -> Floats:
    """Covariance of the means of (methods, n) errors.

    Products are summed without BLAS, whose results depend on its number of threads.
    """
    n = errors.shape[1]
    centred = errors - errors.mean(axis=1, keepdims=True)
    products: Floats = np.array([[(a * b).sum() for b in centred] for a in centred])
    products /= n * (n - 1)
    return products
