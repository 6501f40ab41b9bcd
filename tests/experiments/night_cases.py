"""Nights whose differences are known."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.experiments.night.protocol import Night, NightPlan, label_of

PLAN = NightPlan(strengths=(4, 6, 4, 6), repeats=(4, 2, 4, 2), gap_frames=0)
BLOCK_S = 600 / 250  # s, a block with its settling
DRIFT_S = 40.0
NOISE = 0.02


def night_with(
    seed: int = 0,
    *,
    effect: float = 0.0,
    best: float = 0.0,
    bias_of_r0: float = 0.0,
    paired: bool = True,
    plan: NightPlan = PLAN,
) -> Night:
    """Return a night in which TV adds `effect`, and `best` more for strengths of 0.6 to 1.1.

    The logarithm of r0 drifts (correlation time 40 s) and takes the Strehl ratio with it; methods with TV
    measure r0 too large by a factor exp(bias_of_r0).
    """
    rng = np.random.default_rng(seed)
    entries = [
        (number, *plan.entries(number)[block % len(plan.entries(number))])
        for number in range(plan.sets)
        for block in range(plan.blocks(number))
    ]
    labels = tuple(dict.fromkeys(label_of(name, strength) for _, name, strength in entries))
    strength = np.array([strength for _, _, strength in entries])
    count = len(entries)
    start_s = np.linspace(0.0, BLOCK_S * (count - 1), count, dtype=np.float64)
    drift = drifting(rng, start_s)
    seen = 0.4 + 0.12 * drift - 0.01 * drift**2 + 0.015 * rng.standard_normal(count)
    change = np.where(strength > 0, effect, 0.0) + np.where((strength >= 0.6) & (strength <= 1.1), best, 0.0)
    noise, noise_alone = NOISE * rng.standard_normal((2, count))
    r0 = 0.12 * np.exp(0.3 * drift + 0.08 * rng.standard_normal(count) + bias_of_r0 * (strength > 0))
    unknown = np.full(count, np.nan)
    return Night(
        labels=labels,
        settings=tuple(f"settings of {label}" for label in labels),
        reference=0,
        set_names=tuple(plan.set_name(number) for number in range(plan.sets)),
        set_number=np.array([number for number, _, _ in entries]),
        method=np.array([labels.index(label_of(name, strength)) for _, name, strength in entries]),
        strength=strength,
        start_s=start_s,
        duration_s=np.full(count, 2.0),
        strehl=seen + change + noise,
        strehl_error=np.full(count, NOISE),
        phase_rad2=unknown,
        phase_error_rad2=unknown,
        r0_m=r0,
        r0_error_m=0.08 * r0,
        true_r0_m=0.12 * np.exp(0.3 * drift),
        paired_strehl=seen + noise_alone if paired else unknown,
        overhead_s=BLOCK_S - 2.0,
        wavelength_m=1.65e-6,
        source="synthetic",
        configuration="",
    )


def drifting(rng: np.random.Generator, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a drift of variance 1 with an exponential correlation."""
    correlation = np.exp(-np.abs(time_s[:, None] - time_s) / DRIFT_S) + 1e-9 * np.eye(len(time_s))
    return np.linalg.cholesky(correlation) @ rng.standard_normal(len(time_s))


def without_r0(night: Night) -> Night:
    """Return the night with no measured r0."""
    return replace(night, r0_m=np.full(len(night.strehl), np.nan))
