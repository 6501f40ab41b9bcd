"""Presets: amount of work of an estimator if its own options are not set.

"accurate" iterates until further iterations have little effect. "fast" makes a small fixed number of
iterations. Its slope error is within 1 % of the converged one at the strength that suits the spots;
exceptions are listed in docs/results/iterations.md.
"""

from __future__ import annotations

from typing import Any

PRESETS = ("accurate", "fast")

_DENOISING: dict[str, dict[str, Any]] = {
    "accurate": {"tolerance": 2e-2, "max_iterations": 200},
    "fast": {"tolerance": 0.0, "max_iterations": 8},
}


def of_denoising(preset: str) -> dict[str, Any]:
    """Return tolerance and iteration limit of the total-variation denoising."""
    return _DENOISING[preset]
