"""What each arm chooses from its candidates, on the first half of a cell's images."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.study.arms import Images, error_table
from faintspot.study.estimator_arms import EstimatorArms
from faintspot.study.specification import (
    CORRECTED,
    ESTIMATOR_ARMS,
    KEEPING_ARMS,
    Candidate,
    StudySpecification,
)
from faintspot.study.sweep import Cell
from faintspot.study.tables import HostTables, Tables, moments_of

Floats = NDArray[np.float64]
Blocks = Iterable[tuple[Images, Floats]]
Candidates = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Choice:
    """What an arm chose in a mode; `column` is the number of kept pixels less one, 0 where there is none."""

    candidate: Candidate
    column: int


def mean_errors(
    cell: Cell, arms: Candidates, blocks: Blocks, search_range_px: float = math.inf
) -> dict[str, Floats]:
    """Return R of the candidates and every k of arms that keep pixels or a threshold, (candidates, K), px."""
    sums: dict[str, Any] = dict.fromkeys(arms, 0.0)
    count = 0
    for images, truth in blocks:
        count += len(images)
        for arm, candidates in arms.items():
            tables = (
                error_table(arm, candidate, cell, images, truth, search_range_px)[0]
                for candidate in candidates
            )
            sums[arm] = sums[arm] + np.stack([table.sum(axis=0, dtype=np.float64) for table in tables])
    return {arm: total / count for arm, total in sums.items()}


def _corrected_rms(moments: Floats) -> Floats:
    """Root mean square of the residuals over the gain, as `faintspot.study.metric.slope_statistics`."""
    n, true_x, true_y, true_squares, x, y, squares, across = moments
    spread = true_squares - (np.square(true_x) + np.square(true_y)) / n
    together = across - (x * true_x + y * true_y) / n
    own = squares - (np.square(x) + np.square(y)) / n
    gain = together / spread
    residual = np.maximum(own - gain * together, 0.0) / (2 * n)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gain > 0, np.sqrt(residual) / gain, np.inf)


def choose(arm: str, candidates: Sequence[Candidate], errors: Floats, kept: int | None) -> Choice:
    """Return the candidate, and where `kept` is None the k, of a table's smallest error (candidates, K)."""
    if kept is not None and arm in KEEPING_ARMS:
        return Choice(candidates[int(np.argmin(errors[:, kept - 1]))], kept - 1)
    row, column = np.unravel_index(np.argmin(errors), errors.shape)
    return Choice(candidates[int(row)], int(column))


class Tuning:
    """Errors of all candidates on the first half of a cell's images, and what follows from them."""

    def __init__(self, cell: Cell, specification: StudySpecification, tables: Tables | None = None) -> None:
        self._modes = specification.kept_pixels(cell)
        self._candidates = {arm: specification.candidates(arm, cell) for arm in specification.arms}
        self._tables = HostTables(cell, specification.search_range_of(cell)) if tables is None else tables
        self._errors: dict[str, Any] = dict.fromkeys(self._candidates, 0.0)  # sums over images
        self._moments: dict[str, Any] = dict.fromkeys(self._candidates, 0.0)

    def add(self, blocks: list[Any], estimators: EstimatorArms) -> None:
        """Add images and their true positions, in a form that the tables take."""
        for arm, candidates in self._candidates.items():
            if arm not in ESTIMATOR_ARMS:
                for block in blocks:
                    self._add_tables(arm, candidates, block)
            elif len(candidates) > 1:  # else there is nothing to choose
                images, truth = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
                self._add_estimator(arm, candidates, images, truth, estimators)

    def _add_tables(self, arm: str, candidates: Sequence[Any], block: Any) -> None:
        sums, moments = self._tables.sums(arm, candidates, block, moments=CORRECTED in self._modes)
        self._errors[arm] = self._errors[arm] + sums
        if moments is not None:
            self._moments[arm] = self._moments[arm] + moments

    def _add_estimator(
        self,
        arm: str,
        candidates: Sequence[Candidate],
        images: Images,
        truth: Floats,
        estimators: EstimatorArms,
    ) -> None:
        slopes = [estimators.measure(arm, candidate, images) for candidate in candidates]
        positions = [np.stack([s.x, s.y], axis=-1).astype(np.float64) for s in slopes]
        sums = np.array([[np.abs(part - truth).mean(axis=1).sum()] for part in positions])
        self._errors[arm] = self._errors[arm] + sums
        moments = [moments_of(part[:, None], truth) for part in positions]
        self._moments[arm] = self._moments[arm] + np.stack(moments, axis=1)

    def choices(self) -> dict[tuple[str, str], Choice]:
        """Return the choice of every arm and mode."""
        chosen = {}
        for arm, candidates in self._candidates.items():
            for mode, kept in self._modes.items():
                if np.ndim(self._errors[arm]) == 0:
                    chosen[arm, mode] = Choice(candidates[0], 0)
                    continue
                errors = _corrected_rms(self._moments[arm]) if mode == CORRECTED else self._errors[arm]
                chosen[arm, mode] = choose(arm, candidates, errors, kept)
        return chosen
