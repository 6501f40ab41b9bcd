"""What experiments found, as tables of text for the command line."""

from __future__ import annotations

import textwrap

from faintspot.compare.statistics import Estimate, paired_mean
from faintspot.loop.analysis import GROUPS, GroupRow, measurements, strehl_table
from faintspot.loop.budget import TERMS
from faintspot.loop.results import BudgetResult, InterleavedResult, MagnitudeResult
from faintspot.loop.values_with_errors import with_error
from faintspot.loop.verdict import LoopResults, loop_verdict

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
    meanings = (f"without {term}: {TERMS[term].meaning}" for term in result.terms if term in TERMS)
    return "\n".join([*lines, *meanings])


def _cell(row: GroupRow) -> str:
    return f"{with_error(Estimate(row.mean, row.standard_deviation))} ({row.count})"


def _verdict(results: LoopResults) -> list[str]:
    lines = loop_verdict(results)
    return [part for line in lines for part in textwrap.wrap(line, _WIDTH, subsequent_indent="  ")]
