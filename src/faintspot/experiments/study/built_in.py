"""The built-in studies: that of Basden et al. 2015 (arXiv:1503.06043), and that of the estimators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.experiments.study.specification import StudySpecification

FIGURES = ("fig2", "fig3", "fig4", "fig5", "fig6", "fig7")
NIGHT = "night"
"""Name of the paper's observations beside those of its figures."""


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
    names = FIGURES if figures is None else tuple(figures)
    for name in names:
        if name == "fig1":
            raise InputError("figure 'fig1': expected fig2 to fig7; it needs no study and is on every report")
        one_of("figure", name, FIGURES)
    if not names:
        raise InputError("figures: expected at least one of fig2 to fig7, got none")
    study = _study("paper", quick)
    return replace(study, sweeps=[sweep for sweep in study.sweeps if sweep.name.split()[0] in names])


def estimators_study(quick: bool = False) -> StudySpecification:
    """Return the specification of the study of the estimators.

    Parameters
    ----------
    quick : bool
        A few cells of 2,000 realisations instead of 10,000.
    """
    return _study("estimators", quick)


def _study(name: str, quick: bool) -> StudySpecification:
    """Read a study that comes with the package."""
    file = f"{name}{'-quick' if quick else ''}.toml"
    text = files("faintspot.experiments.study").joinpath("studies", file).read_text(encoding="utf-8")
    return StudySpecification.from_text(text, file)
