"""Presets: how much work an estimator does, where nothing else is said.

"accurate" goes on until more work changes nothing. "fast" does the least that keeps the slope error within
1 % of that: measured over cameras, spots and strengths, see docs/fast.md.
"""

from __future__ import annotations

from typing import Any

PRESETS = ("accurate", "fast")

_DENOISING: dict[str, dict[str, Any]] = {
    "accurate": {"tolerance": 1e-2, "max_iterations": 200},
    "fast": {"tolerance": 0.0, "max_iterations": 8},
}
_STEPS = {
    "accurate": {"matched": 3, "ml": 3, "map": 3, "weighted": 8},
    "fast": {"matched": 2, "ml": 2, "map": 2, "weighted": 4},
}


def of_denoising(preset: str) -> dict[str, Any]:
    """Tolerance and iteration limit of the total-variation denoising."""
    return _DENOISING[preset]


def starts_flat(preset: str) -> bool:
    """Whether the denoising begins at the flat solution's dual field rather than at zero."""
    return preset == "fast"


def steps(preset: str, estimator: str) -> int:
    """Steps of an iterated estimator; 1 of others."""
    return _STEPS[preset].get(estimator, 1)
