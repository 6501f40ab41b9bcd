"""How the arms of a study compare with TV: total-variation denoising is not the only way to remove noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faintspot.study.arm_names import TV
from faintspot.study.curves import study_curves

if TYPE_CHECKING:
    import xarray

_FAMILY_FALSE_ALARM = 0.05


@dataclass(frozen=True)
class AgainstTV:
    """An arm against TV, over all cells of a spot profile in one mode."""

    arm: str
    mode: str
    profile: str
    smaller: int
    """Cells in which the arm's R is smaller than TV's; paired, 5 % false alarms for all cells together."""
    larger: int
    cells: int
    mean_ratio: float
    """Geometric mean of R / R of TV."""
    smallest: int
    """Cells in which the arm's R is the smallest of all arms, decided or not."""


def against_tv(dataset: xarray.Dataset, mode: str) -> list[AgainstTV]:
    """Return how each arm compares with TV, by spot profile; nothing when TV is not in the study."""
    from scipy.stats import norm

    curves = study_curves(dataset, mode)
    rows = []
    for profile in sorted({key.profile for key in curves}):
        part = [curve for key, curve in curves.items() if key.profile == profile]
        arms = part[0].arms
        if TV not in arms:
            continue
        error = np.concatenate([curve.error for curve in part])
        measured = np.all(np.isfinite(error), axis=1)
        winner = np.argmin(error[measured], axis=1)
        for index, arm in enumerate(arms):
            pairs = [curve.difference(TV, arm) for curve in part]
            difference, se = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
            known = np.isfinite(difference)
            n = int(known.sum())
            if arm == TV or n == 0:
                continue
            limit = float(norm.isf(_FAMILY_FALSE_ALARM / n))
            ratio = error[known, index] / error[known, arms.index(TV)]
            rows.append(
                AgainstTV(
                    arm,
                    mode,
                    profile,
                    int(np.sum(difference[known] < -limit * se[known])),
                    int(np.sum(difference[known] > limit * se[known])),
                    n,
                    float(np.exp(np.mean(np.log(ratio)))),
                    int(np.sum(winner == index)),
                )
            )
    return rows
