"""The study of Basden et al. 2015 (arXiv:1503.06043): which cells its figures need, and its report.

Figure 1 is a picture and needs no cell; figure 5 (R against the number of kept pixels) uses cells of the
others, but for 50 electrons at 16 of read noise. A cell that several figures share is computed once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from faintspot.checks import one_of
from faintspot.errors import InputError
from faintspot.study.specification import StudySpecification, Sweep

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
