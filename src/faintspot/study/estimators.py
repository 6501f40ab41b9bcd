"""The built-in study of the estimators: how near they come to the limit, and how they cope with speckles."""

from __future__ import annotations

from typing import Any

from faintspot.estimators.matched import Matched
from faintspot.estimators.maximum_a_posteriori import MaximumAPosteriori
from faintspot.estimators.maximum_likelihood import MaximumLikelihood
from faintspot.estimators.trained import Trained
from faintspot.estimators.weighted import Weighted
from faintspot.estimators.window import Window
from faintspot.study.arm_names import DEFAULT_ARMS
from faintspot.study.paper import QUICK_REALISATIONS, REALISATIONS
from faintspot.study.specification import StudySpecification, Sweep

ARMS = (
    *DEFAULT_ARMS,
    *(kind.name for kind in (Window, Weighted, Matched, MaximumLikelihood, MaximumAPosteriori, Trained)),
)

_FLUXES = {
    0.1: (10, 30, 100, 300, 1000),
    1.0: (30, 80, 200, 600, 2000),
    3.0: (60, 120, 300, 1000, 3000),
    16.0: (250, 500, 1000, 2500, 6000),
}
"""Signals, e-, by read noise, e-: from where the position is lost to where noise no longer matters."""
_ELONGATED_FLUXES = {0.1: (30, 100, 300, 1000), 3.0: (120, 300, 1000, 3000), 16.0: (500, 1000, 2500, 6000)}
_D_OVER_R0 = (0.3, 0.5, 1, 2, 3, 5)
_SPECKLED_FLUXES = {0.1: (50, 200, 1000), 3.0: (200, 500, 2000)}

_CASES: tuple[dict[str, Any], ...] = (
    {"flux_e": (10, 30, 200)},
    {"flux_e": 80, "size": 1.5},
    {"flux_e": 200, "size": 2},
    {"flux_e": 30, "profile": "gaussian"},
    {"flux_e": 80, "profile": "gaussian", "size": 2},
    {"flux_e": (30, 80), "pixels": 8},
    {"flux_e": 30, "pixels": 12},
    {"flux_e": 80, "read_noise_e": 1},
    {"flux_e": 200, "read_noise_e": (3, 5)},
    {"flux_e": 800, "read_noise_e": 10},
    {"flux_e": 200, "elongation": 3},
    {"flux_e": 80, "read_noise_e": 1, "elongation": 3},
    {"flux_e": 300, "read_noise_e": 3, "elongation": 3},
    {"flux_e": 1000, "read_noise_e": 10, "elongation": 3},
    {"flux_e": 1000, "read_noise_e": 16},
    {"flux_e": 800, "read_noise_e": 16, "size": 1.5},
    {"flux_e": 2500, "read_noise_e": 16, "size": 2},
    {"flux_e": 30, "position_range_px": 3},
    {"flux_e": 200, "read_noise_e": 3, "profile": "gaussian"},
    {"flux_e": 80, "position_range_px": 4},
)
"""24 cells of very different spots and cameras."""


def estimators_study(quick: bool = False) -> StudySpecification:
    """Return the specification of the study of the estimators.

    Parameters
    ----------
    quick : bool
        A few cells of 2,000 realisations instead of 10,000.
    """
    return StudySpecification(
        name="estimators (quick)" if quick else "estimators",
        sweeps=_quick_sweeps() if quick else _full_sweeps(),
        realisations=QUICK_REALISATIONS if quick else REALISATIONS,
        arms=ARMS,
        fixed_k=(),
        corrected=True,
    )


def _full_sweeps() -> list[Sweep]:
    cases = [Sweep(f"cases {number}", **case) for number, case in enumerate(_CASES, start=1)]
    flux = [
        Sweep(f"flux {profile} {noise:g} e-", flux_e=fluxes, read_noise_e=noise, profile=profile)
        for profile in ("diffraction", "gaussian")
        for noise, fluxes in _FLUXES.items()
    ]
    elongated = [
        Sweep(f"elongated {noise:g} e-", flux_e=fluxes, read_noise_e=noise, elongation=3)
        for noise, fluxes in _ELONGATED_FLUXES.items()
    ]
    turbulence = [
        Sweep(f"turbulence {noise:g} e-", flux_e=fluxes, read_noise_e=noise, d_over_r0=_D_OVER_R0)
        for noise, fluxes in _SPECKLED_FLUXES.items()
    ]
    return [*cases, *flux, *elongated, *turbulence]


def _quick_sweeps() -> list[Sweep]:
    return [
        Sweep("flux 0.1 e-", flux_e=(10, 30, 100, 300)),
        Sweep("flux 3 e-", flux_e=(60, 120, 300, 1000), read_noise_e=3),
        Sweep("elongated", flux_e=(30, 100, 300), elongation=3),
        Sweep("turbulence", flux_e=200, d_over_r0=(0.5, 1, 3)),
    ]
