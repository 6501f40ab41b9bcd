"""One cell of a study: simulate, choose each arm's settings on one half, score them on the other.

All arms see the same images. They are simulated and measured block by block, so that memory does not grow
with the number of realisations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.simulate import Detector, subapertures
from faintspot.study.arms import Images, error_table
from faintspot.study.specification import BEST, StudySpecification
from faintspot.study.sweep import Cell

_BLOCK_PIXELS = 1 << 18  # small enough for the processor's cache

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Choice:
    """What an arm chose in a mode; `column` is the number of kept pixels less one, 0 where there is none."""

    candidate: float
    column: int


def realisations(
    cell: Cell, count: int, rng: np.random.Generator
) -> Iterator[tuple[Images, NDArray[np.float64]]]:
    """Yield blocks of noisy images (n, side, side), the mean background subtracted, and true positions."""
    detector = Detector(
        read_noise_e=cell.read_noise_e * cell.em_gain, background_e=cell.background_e, em_gain=cell.em_gain
    )
    block = _BLOCK_PIXELS // cell.pixels**2
    for start in range(0, count, block):
        images, truth = subapertures(
            min(block, count - start),
            shape=(cell.pixels, cell.pixels),
            flux_e=cell.flux_e,
            profile=cell.profile,
            size=cell.size,
            elongation=cell.elongation,
            position_range_px=cell.position_range_px,
            detector=detector,
            rng=rng,
        )
        yield images - np.float32(cell.background_e), truth


def mean_errors(cell: Cell, arms: dict[str, tuple[float, ...]], blocks: Any) -> dict[str, Floats]:
    """Return R of every arm's candidates and every k, shape (candidates, K), px."""
    sums: dict[str, Any] = dict.fromkeys(arms, 0.0)
    count = 0
    for images, truth in blocks:
        count += len(images)
        for arm, candidates in arms.items():
            tables = (error_table(arm, candidate, cell, images, truth)[0] for candidate in candidates)
            sums[arm] = sums[arm] + np.stack([table.sum(axis=0, dtype=np.float64) for table in tables])
    return {arm: total / count for arm, total in sums.items()}


def choose(arm: str, candidates: tuple[float, ...], errors: Floats, kept: int | None) -> Choice:
    """Return the candidate, and where `kept` is None the k, of the smallest R of a table (candidates, K)."""
    if kept is not None and arm != "thresholded":
        return Choice(candidates[int(np.argmin(errors[:, kept - 1]))], kept - 1)
    row, column = np.unravel_index(np.argmin(errors), errors.shape)
    return Choice(candidates[int(row)], int(column))


def measure_cell(cell: Cell, specification: StudySpecification) -> dict[str, NDArray[Any]]:
    """Measure one cell of a study.

    Parameters
    ----------
    cell : Cell
    specification : StudySpecification

    Returns
    -------
    dict
        The variables of the study's dataset for this cell: `error`, `error_se`, `chosen_k`,
        `chosen_candidate` and `invalid_fraction` of shape (arm, mode), `error_covariance` (mode, arm, arm),
        `error_at_k` and `error_at_k_se` (arm, K) with K = pixels^2 - 1. NaN in modes that keep more pixels
        than the window can.
    """
    rng = np.random.default_rng(cell.seed(specification.seed))
    half = specification.realisations // 2
    arms = {arm: specification.candidates(arm) for arm in specification.arms}
    means = mean_errors(cell, arms, realisations(cell, half, rng))
    kept = {BEST: None} | {f"fixed{k}": k for k in specification.fixed_k if k < cell.pixels**2}
    choices = {(arm, mode): choose(arm, arms[arm], means[arm], k) for arm in arms for mode, k in kept.items()}
    scores = _Scores(cell, choices)
    for images, truth in realisations(cell, specification.realisations - half, rng):
        scores.add(images, truth)
    return _results(cell, specification, choices, scores)


class _Scores:
    """Errors of the chosen settings, block after block."""

    def __init__(self, cell: Cell, choices: dict[tuple[str, str], Choice]) -> None:
        self._cell, self._choices = cell, choices
        self._errors: dict[tuple[str, str], list[Any]] = {key: [] for key in choices}
        self._valid = dict.fromkeys(choices, 0)
        self.sums: dict[str, Any] = {}  # of the errors and of their squares, for every k
        self.count = 0

    def add(self, images: Images, truth: Floats) -> None:
        """Score a block."""
        self.count += len(images)
        for arm, candidate in dict.fromkeys((arm, c.candidate) for (arm, _), c in self._choices.items()):
            errors, valid = error_table(arm, candidate, self._cell, images, truth)
            for mode in [
                mode for (a, mode), c in self._choices.items() if (a, c.candidate) == (arm, candidate)
            ]:
                column = self._choices[arm, mode].column
                self._errors[arm, mode].append(errors[:, column].astype(np.float64))
                self._valid[arm, mode] += int(valid[:, column].sum())
                if mode == BEST:
                    squares = np.square(errors, dtype=np.float64)
                    sums = np.stack([errors.sum(axis=0, dtype=np.float64), squares.sum(axis=0)])
                    self.sums[arm] = self.sums.get(arm, 0.0) + sums

    def errors(self, arm: str, mode: str) -> Floats:
        """Return the errors of all realisations, px."""
        return np.concatenate(self._errors[arm, mode])

    def invalid_fraction(self, arm: str, mode: str) -> float:
        """Return the fraction of realisations without a valid position."""
        return 1.0 - self._valid[arm, mode] / self.count


def _results(
    cell: Cell, specification: StudySpecification, choices: dict[tuple[str, str], Choice], scores: _Scores
) -> dict[str, NDArray[Any]]:
    """Arrange choices and scores as the dataset has them."""
    arms, modes = specification.arms, specification.modes
    table = (len(arms), len(modes))
    names = ("error", "error_se", "chosen_k", "chosen_candidate", "invalid_fraction")
    results: dict[str, NDArray[Any]] = {name: np.full(table, np.nan) for name in names}
    results["error_covariance"] = np.full((len(modes), len(arms), len(arms)), np.nan)
    for j, mode in enumerate(modes):
        if (arms[0], mode) not in choices:
            continue
        errors = np.stack([scores.errors(arm, mode) for arm in arms])
        covariance = _covariance_of_means(errors)
        results["error"][:, j] = errors.mean(axis=1)
        results["error_se"][:, j] = np.sqrt(np.diag(covariance))
        results["error_covariance"][j] = covariance
        for i, arm in enumerate(arms):
            choice = choices[arm, mode]
            results["chosen_k"][i, j] = np.nan if arm == "thresholded" else choice.column + 1
            results["chosen_candidate"][i, j] = choice.candidate
            results["invalid_fraction"][i, j] = scores.invalid_fraction(arm, mode)
    return results | _results_at_k(cell, arms, scores)


def _results_at_k(cell: Cell, arms: Any, scores: _Scores) -> dict[str, NDArray[Any]]:
    """R and its standard error for every k, at the candidate of mode "best"."""
    errors, standard_errors = np.full((2, len(arms), cell.pixels**2 - 1), np.nan)
    for i, arm in enumerate(arms):
        if arm != "thresholded":
            mean, mean_square = scores.sums[arm] / scores.count
            errors[i] = mean
            standard_errors[i] = np.sqrt(np.maximum(mean_square - mean**2, 0.0) / (scores.count - 1))
    return {"error_at_k": errors, "error_at_k_se": standard_errors}


def _covariance_of_means(errors: Floats) -> Floats:
    """Covariance of the means of (arms, n) errors.

    Products are summed without BLAS, whose results depend on its number of threads.
    """
    n = errors.shape[1]
    centred = errors - errors.mean(axis=1, keepdims=True)
    products: Floats = np.array([[(a * b).sum() for b in centred] for a in centred])
    products /= n * (n - 1)
    return products
