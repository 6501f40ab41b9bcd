"""Presets: amount of work of an estimator if its own options are not set.

"accurate" iterates until further iterations have little effect. "fast" makes a small fixed number of
iterations. Its slope error is within 1 % of the converged one at the strength that suits the spots;
exceptions are listed in docs/results/tv_settings.md.
"""

from __future__ import annotations

from typing import Any

PRESETS = ("accurate", "fast")

FEW_KEPT = 32
"""Pixels whose centre of gravity does not depend on the shallow background, which converges last."""
_DENOISING: dict[str, dict[str, object]] = {
    "accurate": {"tolerance": 2.5e-3, "max_iterations": 480},
    "fast": {"tolerance": 0.0, "max_iterations": 8},
}
_ACCURATE_OF_FEW = {"tolerance": 0.0, "max_iterations": 24}


def of_denoising(preset: str, *, keeps_few: bool = False) -> dict[str, Any]:
    """Return tolerance and iteration limit of the total-variation denoising.

    `keeps_few`: at most `FEW_KEPT` pixels are kept of the image.
    """
    return _ACCURATE_OF_FEW if preset == "accurate" and keeps_few else _DENOISING[preset]
