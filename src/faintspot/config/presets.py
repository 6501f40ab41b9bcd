"""Presets: how much work an estimator does, where nothing else is said.

"accurate" goes on until more work changes little. "fast" does a small fixed amount, after which the slope
error is within 1 % of the converged one at the strength that suits the spots: docs/fast.md says where not.
"""

from __future__ import annotations

from typing import Any

PRESETS = ("accurate", "fast")

_DENOISING: dict[str, dict[str, Any]] = {
    "accurate": {"tolerance": 2e-2, "max_iterations": 200},
    "fast": {"tolerance": 0.0, "max_iterations": 8},
}


def of_denoising(preset: str) -> dict[str, Any]:
    """Tolerance and iteration limit of the total-variation denoising."""
    return _DENOISING[preset]
