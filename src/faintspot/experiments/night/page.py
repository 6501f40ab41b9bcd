"""The page, the JSON summary and the Zarr store of a night."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.files import write_atomically
from faintspot.base.json_text import to_json
from faintspot.base.report.page import Badge, Cell, Page, Section, Table, configuration_section, write_page
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.analysis import (
    ALL_STRENGTHS,
    BEST,
    Difference,
    by_strength,
    differences,
    group_means,
    groups,
    lines,
    significance,
)
from faintspot.experiments.night.blocks import NIGHT_STORE, Night
from faintspot.experiments.night.figures import panels_figure
from faintspot.experiments.night.protocol import PAPER_MEANS
from faintspot.experiments.night.verdicts import FAILS, HOLDS, OPEN, NightVerdict, verdicts
from faintspot.experiments.words import NOTHING, number_or_dash, signed, with_error, with_interval
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration

SUMMARY_FILE, PAGE_FILE = "night.json", "night.html"
_TEXT = Texts("faintspot.experiments.night")
_COLOURS = {HOLDS: "good", FAILS: "bad", OPEN: "grey"}


def write_night(night: Night, folder: str | Path) -> list[Path]:
    """Write a night to a folder: `night.zarr`, `night.json` and `night.html` with its figures.

    Raises
    ------
    InputError
        When a file cannot be written.
    MissingExtraError
        When zarr, matplotlib or jinja2 is not installed.
    """
    folder = Path(folder)
    night.save(folder / NIGHT_STORE)
    text = to_json(night_summary(night), indent=2)
    write_atomically(folder / SUMMARY_FILE, text + "\n")
    pages = write_page(night_page(night), folder / PAGE_FILE)
    return [folder / NIGHT_STORE, folder / SUMMARY_FILE, *pages]


def night_summary(night: Night) -> dict[str, Any]:
    """Return differences, verdicts, lines and means as plain values for JSON; null is not known."""
    reference = night.method == night.reference
    named = [
        (night.labels[night.reference], reference),
        *((group.name, group.rows) for group in groups(night)),
    ]
    return {
        "source": night.source,
        "reference": night.labels[night.reference],
        "hours": _plain(night.hours),
        "methods": [
            {"label": label, "settings": text}
            for label, text in zip(night.labels, night.settings, strict=True)
        ],
        "means": {
            name: [
                {"set": where, "mean": _plain(mean), "standard_deviation": _plain(scatter), "blocks": count}
                for where, (mean, scatter, count) in zip(
                    [*night.set_names, "all"], group_means(night, rows), strict=True
                )
            ]
            for name, rows in named
        },
        "differences": [_difference_values(each) for each in differences(night)],
        "by_strength": [
            {"mean_strength_e": _plain(strength), **_difference_values(each)}
            for strength, each in by_strength(night)
        ],
        "against_r0": [
            {
                "method": line.name,
                "slope_per_m": _values(line.slope_per_m),
                "intercept": _plain(line.intercept),
                "correlation": _plain(line.correlation),
                "blocks": line.blocks,
            }
            for line in lines(night)
        ],
        "verdicts": [
            {
                "statement": each.statement,
                "outcome": each.outcome,
                "measured": _values(each.measured),
                "significance": _plain(each.significance),
                "in_the_same_turbulence": _values(each.paired),
                "outcome_in_the_same_turbulence": each.paired_outcome or None,
                "hours_needed": _plain(each.hours_needed),
            }
            for each in verdicts(night)
        ],
    }


def night_summary_text(night: Night) -> str:
    """Return verdicts and differences as lines of text."""
    found = [f"{each.statement}: {each.outcome}; {_effect(each)}" for each in verdicts(night)]
    return "\n".join([*found, *_conclusions(night)])


def night_sections(night: Night) -> list[Section]:
    """Return the sections of a night, for a page of its own or another one."""
    return [
        _verdicts_section(night),
        Section("night-panels", _TEXT["panels.title"], figures=[panels_figure(night)]),
        Section("night-means", _TEXT["table1.title"], tables=[_means_table(night)]),
        _differences_section(night),
        _seeing_section(night),
        Section("night-settings", _TEXT["settings.title"], tables=[_settings_table(night)]),
    ]


def night_page(night: Night) -> Page:
    """Return the page of a night."""
    configuration = _configuration(night)
    name = "" if configuration is None else f": “{configuration.name}”"
    sections = night_sections(night)
    if night.configuration:
        sections.append(configuration_section(night.configuration))
    return Page(_TEXT("page.title", name=name), _facts(night), sections)


def verdict_in_words(verdict: NightVerdict) -> str:
    """Return the measured effect, the one in the same turbulence and the hours for 3 sigma."""
    paired = ""
    if verdict.paired_outcome:
        paired = f"; in the same turbulence {with_interval(verdict.paired)}"
    return f"{_effect(verdict)}{paired}; 3 σ take {in_hours(verdict.hours_needed)} of alternating"


def in_hours(hours: float) -> str:
    """Return a duration in minutes, hours or nights of eight hours."""
    if not math.isfinite(hours):
        return NOTHING
    if hours < 1:
        return f"{60 * hours:.2g} min" if 60 * hours < 9.95 else f"{60 * hours:.0f} min"
    return f"{hours:.1f} h" if hours < 9.95 else f"{hours:,.0f} h".replace(",", " ")


def _conclusions(night: Night) -> list[str]:
    """Return one sentence for each difference."""
    return [
        _TEXT(
            "page.conclusion",
            name=each.name,
            value=with_interval(each.measured),
            significance=_sigma(each.measured),
            length=_length(each),
        )
        for each in differences(night)
    ]


def _length(difference: Difference) -> str:
    if math.isinf(difference.hours_needed) and difference.shared_error > 0:
        return str(_TEXT["page.never"])
    if not math.isfinite(difference.hours_needed):
        return str(_TEXT["page.unknown"])
    values = {"hours": in_hours(difference.hours), "needed": in_hours(difference.hours_needed)}
    return _TEXT(f"page.{'long_enough' if difference.is_long_enough else 'too_short'}", **values)


def _sigma(estimate: Estimate) -> str:
    value = significance(estimate)
    return f"{signed(value, 1)} σ" if math.isfinite(value) else NOTHING


def _effect(verdict: NightVerdict) -> str:
    unit = f" {verdict.unit}" if verdict.unit else ""
    return f"{with_interval(verdict.measured)}{unit}, {_sigma(verdict.measured)}"


def _verdicts_section(night: Night) -> Section:
    found = verdicts(night)
    title = _TEXT["verdicts.title"]
    if not found:
        return Section("night-verdicts", title, missing=_TEXT["verdicts.missing"])
    rows: list[list[str | Cell]] = [
        [
            each.statement,
            Cell(badge=Badge(each.outcome, _COLOURS[each.outcome]), small=_effect(each)),
            Cell(each.paired_outcome, small=with_interval(each.paired)) if each.paired_outcome else NOTHING,
            in_hours(each.hours_needed),
        ]
        for each in found
    ]
    table = replace(_TEXT.table("verdicts", rows), prose=True)
    return Section("night-verdicts", title, tables=[table], points=_conclusions(night))


def _means_table(night: Night) -> Table:
    reference = night.labels[night.reference]
    named = [(reference, night.method == night.reference)]
    named += [(group.name, group.rows) for group in groups(night)]
    columns = [group_means(night, rows) for _, rows in named]
    of_paper = {reference: 0, ALL_STRENGTHS: 1, BEST: 2}
    with_paper = len(night.set_names) == len(PAPER_MEANS) and BEST in dict(named)
    rows: list[list[str | Cell]] = []
    for row, where in enumerate([*night.set_names, "all sets"]):
        cells: list[str | Cell] = [where]
        for (name, _), column in zip(named, columns, strict=True):
            mean, scatter, count = column[row]
            small = f"± {number_or_dash(scatter, 3)} ({count})"
            if with_paper and name in of_paper and row < len(PAPER_MEANS):
                small += f"; paper {number_or_dash(float(PAPER_MEANS[row, of_paper[name]]), 3)}"
            cells.append(Cell(number_or_dash(mean, 3), small=small))
        rows.append(cells)
    missing = with_paper and not np.isfinite(PAPER_MEANS).any()
    paper = _TEXT["table1.paper"] if missing else ""
    return _TEXT.table("table1", rows, [name for name, _ in named], paper=paper)


def _differences_section(night: Night) -> Section:
    reference = night.labels[night.reference]
    rows: list[list[str | Cell]] = [
        [
            each.name,
            f"{each.blocks}",
            with_interval(each.measured),
            with_interval(each.without_r0),
            _sigma(each.measured),
            with_interval(each.paired),
            in_hours(each.hours),
            in_hours(each.hours_needed),
        ]
        for each in differences(night)
    ]
    effect = "paired" if night.is_paired else "measured"
    tables = [_TEXT.table("differences", rows, reference=reference, effect=effect)]
    ranges: list[list[str | Cell]] = [
        [
            each.name,
            f"{each.blocks}",
            with_interval(each.measured),
            with_interval(each.paired),
            in_hours(each.hours_needed),
        ]
        for _, each in by_strength(night)
    ]
    if ranges:
        tables.append(_TEXT.table("strengths", ranges, reference=reference))
    return Section("night-differences", _TEXT("differences.title", reference=reference), tables=tables)


def _seeing_section(night: Night) -> Section:
    fits = lines(night)
    if not fits:
        return Section("night-r0", _TEXT["seeing.title"], missing=_TEXT["seeing.missing"])
    text = [_TEXT["seeing.text"]]
    ratio = (night.r0_m / night.true_r0_m)[np.isfinite(night.r0_m / night.true_r0_m)]
    if len(ratio):
        within = 100 * float(np.mean(np.abs(ratio - 1) < 0.1))
        text.append(_TEXT("seeing.truth", ratio=np.median(ratio), within=within, count=len(ratio)))
    rows: list[list[str | Cell]] = [
        [
            line.name,
            with_error(Estimate(line.slope_per_m.value / 100, line.slope_per_m.standard_error / 100), 4),
            f"{line.correlation:.2f}",
            f"{line.blocks}",
        ]
        for line in fits
    ]
    return Section("night-r0", _TEXT["seeing.title"], text, [_TEXT.table("seeing", rows)])


def _settings_table(night: Night) -> Table:
    rows = [[label, text] for label, text in zip(night.labels, night.settings, strict=True)]
    return replace(_TEXT.table("settings", rows), prose=True, folded=f"{len(rows)} methods")


def _configuration(night: Night) -> LoopConfiguration | None:
    try:
        return LoopConfiguration.from_text(night.configuration) if night.configuration else None
    except InputError:
        return None


def _facts(night: Night) -> Mapping[str, str]:
    r0, how = night.true_r0_m, "the simulation’s"
    if not np.isfinite(r0).any():
        r0, how = night.r0_m, "measured"
    has_r0 = bool(np.isfinite(r0).any())
    values = {
        "sets": len(night.set_names),
        "blocks": len(night.strehl),
        "seconds": float(np.median(night.duration_s)),
        "overhead": night.overhead_s,
        "hours": in_hours(night.hours),
        "source": night.source,
        "methods": f"{len(night.labels)}, compared with {night.labels[night.reference]}",
        "low": float(np.nanmin(r0)) if has_r0 else math.nan,
        "high": float(np.nanmax(r0)) if has_r0 else math.nan,
        "how": how,
        "um": night.wavelength_m * 1e6,
    }
    return {name: _TEXT(f"facts.{name}", **values) for name in _TEXT["facts"] if has_r0 or name != "r0"}


def _difference_values(difference: Difference) -> dict[str, Any]:
    return {
        "method": difference.name,
        "blocks": difference.blocks,
        "at_equal_r0": _values(difference.measured),
        "without_r0": _values(difference.without_r0),
        "in_the_same_turbulence": _values(difference.paired),
        "hours": _plain(difference.hours),
        "hours_needed": _plain(difference.hours_needed),
        "is_long_enough": difference.is_long_enough,
    }


def _values(estimate: Estimate | None) -> dict[str, Any] | None:
    if estimate is None or not math.isfinite(estimate.value):
        return None
    return {
        "value": _plain(estimate.value),
        "standard_error": _plain(estimate.standard_error),
        "low": _plain(estimate.low),
        "high": _plain(estimate.high),
        "pieces": estimate.count,
    }


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None
