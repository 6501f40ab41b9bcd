"""The two built-in studies: that of Basden et al. 2015 (arXiv:1503.06043), and that of the estimators."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.estimators.matched import Matched
from faintspot.estimators.maximum_a_posteriori import MaximumAPosteriori
from faintspot.estimators.maximum_likelihood import MaximumLikelihood
from faintspot.estimators.trained import Trained
from faintspot.estimators.weighted import Weighted
from faintspot.estimators.window import Window
from faintspot.experiments.arms import DEFAULT_ARMS
from faintspot.experiments.specification import StudySpecification, Sweep

FIGURES = ("fig2", "fig3", "fig4", "fig5", "fig6", "fig7")
REALISATIONS = 10_000
QUICK_REALISATIONS = 2_000

# Fluxes, e-: from 10 to where the noise no longer matters, closest where R falls fastest.
_LOW_NOISE = (10, 30, 50, 80, 200, 1000)  # up to 1 e- of read noise
_MIDDLE_NOISE = (10, 50, 100, 200, 400, 1000, 3000)  # 3 and 5 e-
_HIGH_NOISE = (10, 100, 200, 400, 700, 1000, 2000, 5000)  # 10 and 16 e-
_KEPT_PIXELS_FLUX = (50, 200)
_SIZES = (1.0, 1.5, 2.0)
_RANGES_PX = (1.0, 4.0)
_BOTH = ("diffraction", "gaussian")


def paper_study(quick: bool = False, figures: Sequence[str] | None = None) -> StudySpecification:
    """Return the specification of the paper's study.

    Parameters
    ----------
    quick : bool
        At most 40 cells of 2,000 realisations instead of 10,000: every figure, but with few points.
    figures : sequence of {"fig2", ..., "fig7"}, optional
        Only the cells of these figures. Default: all.

    Returns
    -------
    StudySpecification
        Its sweeps are named by the figure they belong to, as in "fig4 low noise".

    Raises
    ------
    InputError
        For an unknown figure, and for figure 1, which needs no study.
    """
    wanted = FIGURES if figures is None else tuple(figures)
    for name in wanted:
        if name == "fig1":
            raise InputError("figure 'fig1': expected fig2 to fig7; it needs no study and is on every report")
        one_of("figure", name, FIGURES)
    if not wanted:
        raise InputError("figures: expected at least one of fig2 to fig7, got none")
    sweeps = [
        sweep for sweep in (_quick_sweeps() if quick else _full_sweeps()) if sweep.name.split()[0] in wanted
    ]
    return StudySpecification(
        name="paper (quick)" if quick else "paper",
        sweeps=sweeps,
        realisations=QUICK_REALISATIONS if quick else REALISATIONS,
    )


def _full_sweeps() -> list[Sweep]:
    nyquist_low: dict[str, Any] = {"flux_e": _LOW_NOISE, "read_noise_e": (0.3, 0.5, 1.0)}
    nyquist_middle: dict[str, Any] = {"flux_e": _MIDDLE_NOISE, "read_noise_e": (3.0, 5.0)}
    nyquist_high: dict[str, Any] = {"flux_e": _HIGH_NOISE, "read_noise_e": (10.0, 16.0)}
    wide: dict[str, Any] = {"position_range_px": _RANGES_PX}
    gaussian: dict[str, Any] = {"profile": "gaussian"}
    elongated: dict[str, Any] = {"profile": _BOTH, "elongation": 3.0}
    return [
        Sweep("fig2", flux_e=_LOW_NOISE, size=_SIZES, **wide),
        Sweep("fig2 gaussian", flux_e=_LOW_NOISE, size=_SIZES, **gaussian),
        Sweep("fig3", flux_e=_LOW_NOISE, pixels=(8, 10, 12, 14, 16), profile=_BOTH),
        Sweep("fig4 lowest noise", flux_e=_LOW_NOISE, **wide),
        Sweep("fig4 lowest noise gaussian", flux_e=_LOW_NOISE, **gaussian),
        Sweep("fig4 low noise", **nyquist_low, **wide),
        Sweep("fig4 low noise gaussian", **nyquist_low, **gaussian),
        Sweep("fig4 middle noise", **nyquist_middle, **wide),
        Sweep("fig4 middle noise gaussian", **nyquist_middle, **gaussian),
        Sweep("fig4 high noise", **nyquist_high, **wide),
        Sweep("fig4 high noise gaussian", **nyquist_high, **gaussian),
        Sweep("fig5 signals", flux_e=_KEPT_PIXELS_FLUX, profile=_BOTH),
        Sweep("fig5 sizes", flux_e=_KEPT_PIXELS_FLUX[0], size=_SIZES, profile=_BOTH),
        Sweep("fig5 noises", flux_e=_KEPT_PIXELS_FLUX[0], read_noise_e=(0.1, 1, 3, 16), profile=_BOTH),
        Sweep("fig6 low noise", flux_e=_LOW_NOISE, read_noise_e=(0.1, 1.0), **elongated),
        Sweep("fig6 middle noise", flux_e=_MIDDLE_NOISE, read_noise_e=(3.0, 5.0), **elongated),
        Sweep("fig6 high noise", flux_e=_HIGH_NOISE, read_noise_e=10.0, **elongated),
        Sweep("fig7", flux_e=_HIGH_NOISE, read_noise_e=16.0, size=_SIZES, **wide),
        Sweep("fig7 gaussian", flux_e=_HIGH_NOISE, read_noise_e=16.0, size=_SIZES, **gaussian),
    ]


def _quick_sweeps() -> list[Sweep]:
    low, middle, high = (10, 30, 80, 300), (30, 80, 300, 1000), (300, 700, 1500, 5000)
    return [
        Sweep("fig2", flux_e=low, size=(1.0, 2.0)),
        Sweep("fig2 wide", flux_e=low, position_range_px=4.0),
        Sweep("fig2 gaussian", flux_e=low, profile="gaussian"),
        Sweep("fig3", flux_e=low, pixels=(10, 16)),
        Sweep("fig4 lowest noise", flux_e=low),
        Sweep("fig4 middle noise", flux_e=middle, read_noise_e=3.0),
        Sweep("fig4 high noise", flux_e=high, read_noise_e=16.0),
        Sweep("fig5 signals", flux_e=(80, 300)),
        Sweep("fig5 sizes", flux_e=80, size=(1.0, 2.0)),
        Sweep("fig5 noises", flux_e=80, read_noise_e=(0.1, 3.0)),
        Sweep("fig6 low noise", flux_e=low, elongation=3.0),
        Sweep("fig6 middle noise", flux_e=middle, read_noise_e=3.0, elongation=3.0),
        Sweep("fig7", flux_e=high, read_noise_e=16.0, size=(1.0, 2.0)),
    ]


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
        sweeps=_quick_estimator_sweeps() if quick else _full_estimator_sweeps(),
        realisations=QUICK_REALISATIONS if quick else REALISATIONS,
        arms=ARMS,
        fixed_k=(),
        corrected=True,
    )


def _full_estimator_sweeps() -> list[Sweep]:
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


def _quick_estimator_sweeps() -> list[Sweep]:
    return [
        Sweep("flux 0.1 e-", flux_e=(10, 30, 100, 300)),
        Sweep("flux 3 e-", flux_e=(60, 120, 300, 1000), read_noise_e=3),
        Sweep("elongated", flux_e=(30, 100, 300), elongation=3),
        Sweep("turbulence", flux_e=200, d_over_r0=(0.5, 1, 3)),
    ]
