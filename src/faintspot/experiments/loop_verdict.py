"""Sentences and tables of text on closed-loop results."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from faintspot.ao_loop.files import BUDGET_FILE, INTERLEAVED_FILE, MAGNITUDE_FILE
from faintspot.base.errors import InputError
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.total_variation import TotalVariation
from faintspot.estimators.window import Window
from faintspot.experiments.budget import TERMS
from faintspot.experiments.loop_analysis import (
    GROUPS,
    NO_TV,
    TV,
    TV_BEST,
    GroupRow,
    Measurements,
    differences_by_flux,
    differences_by_strength,
    gains_in_magnitude,
    measurements,
    strehl_table,
)
from faintspot.experiments.loop_arms import VARIANTS
from faintspot.experiments.loop_results import (
    BudgetResult,
    InterleavedResult,
    MagnitudeResult,
    gain_in_words,
    in_words,
    with_error,
)
from faintspot.experiments.statistics import Estimate, paired_mean
from faintspot.report.texts import Texts

NOWHERE = "TV raises the Strehl ratio nowhere beyond its error"
REFERENCES = (Window.name, BrightestPixels.name)
"""Names of the arms that others are compared with: the strongest that systems run, then the usual one."""


@dataclass(frozen=True, eq=False)
class LoopResults:
    """Results in a folder; None: not run."""

    interleaved: InterleavedResult | None = None
    magnitude: MagnitudeResult | None = None
    budget: BudgetResult | None = None

    @classmethod
    def load(cls, folder: str | Path) -> LoopResults:
        """Read the results in a folder.

        Raises
        ------
        InputError
            When there are none, or one cannot be read.
        """
        folder = Path(folder)
        results = cls(
            InterleavedResult.load(folder) if (folder / INTERLEAVED_FILE).exists() else None,
            MagnitudeResult.load(folder / MAGNITUDE_FILE) if (folder / MAGNITUDE_FILE).exists() else None,
            BudgetResult.load(folder / BUDGET_FILE) if (folder / BUDGET_FILE).exists() else None,
        )
        if results.interleaved is None and results.magnitude is None and results.budget is None:
            raise InputError(
                f"{folder}: no results of a loop: expected {INTERLEAVED_FILE}, {MAGNITUDE_FILE} or "
                f"{BUDGET_FILE}"
            )
        return results


def loop_verdict(results: LoopResults) -> list[str]:
    """Return what the results say about TV, and then about the other ways to measure slopes."""
    comparisons: list[Estimate | None] = []
    lines = []
    if results.interleaved is not None:
        table = measurements(results.interleaved)
        lines += _interleaved_lines(table)
        comparisons += [row.difference for row in strehl_table(table)]
        comparisons += [row.difference for row in differences_by_strength(table)]
    if results.magnitude is not None:
        lines += _magnitude_lines(results.magnitude)
        # What the denoising itself does: against the same without it.
        tv, reference = tv_arm(results.magnitude), reference_arms(results.magnitude)[-1]
        if tv is not None and tv != reference:
            comparisons += differences_by_flux(results.magnitude, tv, reference)
    return _headline(comparisons) + lines


def reference_arms(result: MagnitudeResult) -> list[int]:
    """Return the arms that others are compared with: those of `REFERENCES` that are there, else the first."""
    return [result.names.index(name) for name in REFERENCES if name in result.names] or [0]


def tv_arm(result: MagnitudeResult) -> int | None:
    """Return the arm with TV, or None."""
    return result.names.index(TotalVariation.name) if TotalVariation.name in result.names else None


def options_that_may_pay(result: MagnitudeResult) -> list[tuple[str, int, int]]:
    """Return what arms of a pair differ by, the arm with it and the one without, for each of `VARIANTS`."""
    names = result.names
    return [
        (variant.label, arm, names.index(name.replace(ending, "")))
        for ending, variant in VARIANTS.items()
        for arm, name in enumerate(names)
        if ending in name and name.replace(ending, "") in names
    ]


def better_and_worse(result: MagnitudeResult, arm: int, reference: int) -> tuple[str, str]:
    """Return at which fluxes an arm's Strehl is above and below another's beyond its error, in words.

    "" for none.
    """
    decided = [each.decided for each in differences_by_flux(result, arm, reference)]
    if decided == [1] * len(decided):
        return "all fluxes", ""
    if decided == [-1] * len(decided):
        return "", "all fluxes"
    above, below = (
        ", ".join(
            f"{photons:.3g}" for photons, sign in zip(result.photons, decided, strict=True) if sign == wanted
        )
        for wanted in (1, -1)
    )
    unit = " photo-electrons"
    return above and above + unit, below and below + unit


def _headline(comparisons: list[Estimate | None]) -> list[str]:
    known = [each for each in comparisons if each is not None and np.isfinite(each.low)]
    if not known:
        return ["Too few measurements to say whether TV raises the Strehl ratio."] if comparisons else []
    gains, losses = (sum(each.decided == sign for each in known) for sign in (1, -1))
    if gains:
        first = f"TV raises the Strehl ratio beyond its error in {gains} of {len(known)} comparisons"
    else:
        first = NOWHERE
    return [
        f"{first}; it lowers it beyond its error in {losses} of {len(known)} comparisons."
        if losses
        else f"{first}."
    ]


def _interleaved_lines(table: Measurements) -> list[str]:
    rows = {row.group: row for row in strehl_table(table)}
    if NO_TV not in rows:
        return ["Interleaved observations: no measurement without TV yet."]
    return [
        f"Interleaved, {name}: Strehl {row.mean:.3f} in {row.count} measurements against "
        f"{rows[NO_TV].mean:.3f} in {rows[NO_TV].count} without; paired difference "
        f"{in_words(row.difference)}, "
        f"{_judgement(row.difference)}."
        for name, row in rows.items()
        if name in (TV, TV_BEST)
    ]


def _magnitude_lines(result: MagnitudeResult) -> list[str]:
    references, lines = reference_arms(result), []
    for place, reference in enumerate(references):
        others = [arm for arm in range(len(result.labels)) if arm not in references[: place + 1]]
        lines += [_comparison(result, arm, reference) for arm in others]
    for option, arm, without in options_that_may_pay(result):
        above, below = better_and_worse(result, arm, without)
        found = f"pays at {above}" if above else "pays nowhere beyond its error"
        found += f", costs at {below}" if below else ""
        lines.append(f"{result.labels[arm]} against {result.labels[without]}: {option} {found}.")
    return lines


def _comparison(result: MagnitudeResult, arm: int, reference: int) -> str:
    above, below = better_and_worse(result, arm, reference)
    parts = [f"more Strehl beyond its error at {above}"] if above else []
    parts += [f"less Strehl beyond its error at {below}"] if below else []
    found = "; ".join(parts) if parts else "no difference beyond its error at any flux"
    gain = _gain_in_magnitude(result, arm, reference)
    return f"Magnitudes, {result.labels[arm]} against {result.labels[reference]}: {found}{gain}."


def _gain_in_magnitude(result: MagnitudeResult, arm: int, reference: int) -> str:
    """Return the gain at the middle one of the Strehl ratios at which there is one."""
    every = gains_in_magnitude(result, arm, reference)
    gains = [each for each in every if np.isfinite(each.gain.value)]
    if not gains:
        return ""
    middle = gains[len(gains) // 2]
    if np.isnan(middle.gain.low):
        return f"; gain in limiting magnitude: {middle.why_not}"
    return f"; limiting magnitude at Strehl {middle.strehl:g}: {gain_in_words(middle)} mag"


def _judgement(estimate: Estimate | None) -> str:
    if estimate is None or not np.isfinite(estimate.low):
        return "too few to judge"
    return {1: "more beyond its error", -1: "less beyond its error", 0: "within its error"}[estimate.decided]


_WIDTH = 100


def interleaved_summary(result: InterleavedResult) -> str:
    """Return mean and standard deviation of the measurements of each group in each set, and the verdict."""
    table = measurements(result)
    lines = ["Strehl ratio".ljust(30) + "".join(f"{group:>25s}" for group in GROUPS)]
    for number, name in [*enumerate(result.set_names), (None, "all sets")]:
        rows = {row.group: row for row in strehl_table(table, number)}
        cells = (_cell(rows[group]) if group in rows else "-" for group in GROUPS)
        lines.append(f"{name:30s}" + "".join(f"{cell:>25s}" for cell in cells))
    lines.append("± standard deviation of the measurements, whose number is in brackets; turbulence drifts")
    return "\n".join([*lines, "", *_verdict(LoopResults(interleaved=result))])


def magnitude_summary(result: MagnitudeResult) -> str:
    """Return the Strehl ratio of every arm at every flux with its standard error, and the verdict."""
    width = max(map(len, result.labels)) + 2
    lines = [
        "photo-electrons".ljust(width) + "".join(f"{flux:>14g}" for flux in result.photons),
        "magnitude".ljust(width) + "".join(f"{magnitude:>14.1f}" for magnitude in result.magnitudes),
    ]
    for label, curve in zip(result.labels, result.strehl, strict=True):
        cells = (with_error(paired_mean(runs)) for runs in curve)
        lines.append(label.ljust(width) + "".join(f"{cell:>14s}" for cell in cells))
    lines.append(f"± standard error from {result.strehl.shape[-1]} realisations of the air")
    return "\n".join([*lines, "", *_verdict(LoopResults(magnitude=result))])


def budget_summary(result: BudgetResult) -> str:
    """Return the Strehl ratio and the rms wavefront of every arm without each term."""
    width = max(map(len, result.terms)) + 2
    column = max(30, *(len(label) + 2 for label in result.labels))
    lines = ["without".ljust(width) + "".join(label.rjust(column) for label in result.labels)]
    for number, term in enumerate(result.terms):
        cells = (
            f"{with_error(paired_mean(result.strehl[arm, number]))}  "
            f"{with_error(paired_mean(result.residual_nm[arm, number]), 0)} nm"
            for arm in range(len(result.labels))
        )
        lines.append(term.ljust(width) + "".join(cell.rjust(column) for cell in cells))
    lines += ["Strehl ratio and rms wavefront with their standard errors", ""]
    texts = Texts("faintspot.experiments")["terms"]
    meanings = (f"without {term}: {texts[term]}" for term in result.terms if term in TERMS)
    return "\n".join([*lines, *meanings])


def _cell(row: GroupRow) -> str:
    return f"{with_error(Estimate(row.mean, row.standard_deviation))} ({row.count})"


def _verdict(results: LoopResults) -> list[str]:
    lines = loop_verdict(results)
    return [part for line in lines for part in textwrap.wrap(line, _WIDTH, subsequent_indent="  ")]
