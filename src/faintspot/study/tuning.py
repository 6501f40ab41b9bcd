"""What each arm chooses from its candidates, on the first half of a cell's images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.study.arm_names import keeps_every_k
from faintspot.study.arms import Candidate, CellArms, Images
from faintspot.study.specification import CORRECTED, StudySpecification
from faintspot.study.tables import error_sums, moments_of, position_table

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Choice:
    """What an arm chose in a mode."""

    candidate: Candidate
    column: int | None
    """Number of kept pixels less one; None where every k is not measured."""


class Tuning:
    """Errors of all candidates on the first half of a cell's images, and what follows from them."""

    def __init__(self, arms: CellArms, specification: StudySpecification) -> None:
        self._arms = arms
        self._modes = specification.kept_pixels(arms.cell)
        self._candidates = {arm: arms.candidates(arm) for arm in specification.arms}
        self._errors: dict[str, Any] = dict.fromkeys(self._candidates, 0.0)  # sums over images
        self._moments: dict[str, Any] = dict.fromkeys(self._candidates, 0.0)

    def add(self, blocks: list[Any]) -> None:
        """Add images and their true positions."""
        for arm, candidates in self._candidates.items():
            if keeps_every_k(self._arms.kinds[arm]):
                for block in blocks:
                    self._add_table(arm, candidates, *block)
            elif len(candidates) > 1:  # else there is nothing to choose
                self._add_measured(arm, candidates, blocks)

    def _add_table(self, arm: str, candidates: Sequence[Candidate], images: Images, truth: Floats) -> None:
        estimators: list[Any] = [self._arms.estimator(arm, candidate) for candidate in candidates]
        reach = self._arms.search_range_px
        self._errors[arm] += error_sums(estimators, images, truth, reach)
        if CORRECTED in self._modes:
            tables = (position_table(each, images, reach)[0] for each in estimators)
            self._moments[arm] += np.stack([moments_of(table, truth) for table in tables], axis=1)

    def _add_measured(self, arm: str, candidates: Sequence[Candidate], blocks: list[Any]) -> None:
        images, truth = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
        slopes = [self._arms.measure(arm, candidate, images) for candidate in candidates]
        positions = [np.stack([s.x, s.y], axis=-1).astype(np.float64) for s in slopes]
        sums = np.array([[np.abs(part - truth).mean(axis=1).sum()] for part in positions])
        self._errors[arm] += sums
        moments = [moments_of(part[:, None], truth) for part in positions]
        self._moments[arm] += np.stack(moments, axis=1)

    def choices(self) -> dict[tuple[str, str], Choice]:
        """Return the choice of every arm and mode."""
        chosen = {}
        for arm, candidates in self._candidates.items():
            for mode, kept in self._modes.items():
                if np.ndim(self._errors[arm]) == 0:
                    chosen[arm, mode] = Choice(candidates[0], None)
                    continue
                errors = _corrected_rms(self._moments[arm]) if mode == CORRECTED else self._errors[arm]
                chosen[arm, mode] = _smallest(candidates, errors, kept)
        return chosen


def _smallest(candidates: Sequence[Candidate], errors: Floats, kept: int | None) -> Choice:
    """Return the candidate, and where `kept` is None the k, of a table's smallest error (candidates, K)."""
    if errors.shape[1] == 1:
        return Choice(candidates[int(np.argmin(errors))], None)
    if kept is not None:
        return Choice(candidates[int(np.argmin(errors[:, kept - 1]))], kept - 1)
    row, column = np.unravel_index(np.argmin(errors), errors.shape)
    return Choice(candidates[int(row)], int(column))


def _corrected_rms(moments: Floats) -> Floats:
    """Root mean square of the residuals over the gain, as `faintspot.compare.statistics.slope_statistics`."""
    n, true_x, true_y, true_squares, x, y, squares, across = moments
    spread = true_squares - (np.square(true_x) + np.square(true_y)) / n
    together = across - (x * true_x + y * true_y) / n
    own = squares - (np.square(x) + np.square(y)) / n
    gain = together / spread
    residual = np.maximum(own - gain * together, 0.0) / (2 * n)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(gain > 0, np.sqrt(residual) / gain, np.inf)
