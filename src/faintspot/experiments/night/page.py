"""The page, the JSON summary and the Zarr store of a night."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.files import write_atomically
from faintspot.base.report import page
from faintspot.base.report.plots import FLUX_GREY, METHOD_COLOURS, WIDTH, Line, Panel
from faintspot.base.report.texts import Texts, with_error
from faintspot.base.statistics import Estimate
from faintspot.base.text_files import to_json
from faintspot.experiments.night.analysis import (
    ALL_STRENGTHS,
    BEST,
    Difference,
    by_strength,
    differences,
    group_means,
    groups,
    lines,
    verdicts,
    with_reference,
)
from faintspot.experiments.night.paper import (
    PAPER_CORRELATION,
    PAPER_MEANS,
    compare_with_paper,
    paper_exposures,
)
from faintspot.experiments.night.protocol import COUNTS, Night
from faintspot.loop.simulation.configuration import LoopConfiguration

Shown = dict[str, tuple[NDArray[np.bool_], dict[str, object]]]
"""Blocks and style of what is drawn, by name."""

_TEXT = Texts("faintspot.experiments.night")
_REFERENCE_STYLE: dict[str, object] = {"color": "#000000", "marker": "o"}
_TV_STYLES: dict[str, dict[str, object]] = {
    ALL_STRENGTHS: {"color": "#8a8a8a", "marker": "^"},
    BEST: {"color": METHOD_COLOURS[0], "marker": "s"},
}
_MARKERS = "Dv<>P"
_POINT: dict[str, object] = {"ls": "", "ms": 5, "elinewidth": 0.7, "alpha": 0.85}


def panels_figure(night: Night) -> page.FigureWithData:
    """Draw Strehl ratio against time, measured r0 and strength, with errors."""
    label, shown = f"Strehl ratio at {night.wavelength_m * 1e6:.3g} µm", _shown(night)
    lowest = float(np.nanmin(night.strehl - np.nan_to_num(night.strehl_error)))
    bottom: dict[str, Any] = {"y": label, "y_range": (min(0.5 * lowest, 1.1 * lowest), None)}
    starts = [night.start_s[night.set_number == number][0] / 60 for number in np.unique(night.set_number)[1:]]
    sets = {start: {"color": FLUX_GREY, "lw": 1.2, "zorder": 0} for start in starts}
    points = [*_points(night, shown, night.middle_s / 60), *_paper_means(night)]
    panels = [Panel(points, "time (min)", at=sets, legend=True, **bottom)]
    if np.isfinite(night.r0_m).any():
        points = _points(night, shown, night.r0_m * 100, night.r0_error_m * 100)
        fits = _regressions(night)
        panels.append(Panel([*_unnamed(points), *fits], "measured r0 at 500 nm (cm)", legend=True, **bottom))
    if night.has_strengths:
        panels.append(_of_strengths(night, shown, bottom))
    values: dict[str, Any] = {
        "seconds": float(np.median(night.duration_s)),
        "reference": night.labels[night.reference],
        "strengths": night.has_strengths,
    }
    options: dict[str, Any] = {"width": 0.72 * WIDTH, "columns": 3, "legend": "outside upper center"}
    rows = [[panel] for panel in panels]
    return _TEXT.figure("panels", rows, 4.1 * len(panels), values, **options)


def _shown(night: Night) -> Shown:
    """Return blocks and style of what is drawn, by name; each block once, the reference last."""
    every = groups(night)
    others = [name for name in every if name not in _TV_STYLES]
    styles = _TV_STYLES | {
        name: {"color": METHOD_COLOURS[1 + index % 3], "marker": _MARKERS[index % len(_MARKERS)]}
        for index, name in enumerate(others)
    }
    shown = {name: (rows, styles[name]) for name, rows in every.items()}
    if BEST in every:
        rows, style = shown.pop(ALL_STRENGTHS)
        shown = {"TV, other strengths": (rows & ~every[BEST], style), **shown}
    return shown | {night.labels[night.reference]: (night.is_reference, _REFERENCE_STYLE)}


def _points(night: Night, shown: Shown, x: Floats, x_error: Floats | None = None) -> list[Line]:
    return [
        Line(
            name,
            x[rows],
            night.strehl[rows],
            night.strehl_error[rows],
            {**_POINT, **style},
            x_error=None if x_error is None else x_error[rows],
        )
        for name, (rows, style) in shown.items()
    ]


def _paper_means(night: Night) -> list[Line]:
    """Return the means of the paper's Table 1 as lines as long as the sets."""
    if not (night.has_strengths and len(night.set_names) == len(PAPER_MEANS)):
        return []
    colours = {"no TV": "#000000", "all strengths": "#8a8a8a", "0.6 to 1.1": METHOD_COLOURS[0]}
    found = []
    for number, means in enumerate(PAPER_MEANS):
        minutes = night.start_s[night.set_number == number][[0, -1]] / 60
        for (name, colour), mean in zip(colours.items(), means, strict=True):
            style, first = {"color": colour, "lw": 1.5, "ls": "--"}, number == 0
            found.append(Line(f"paper, {name}", minutes, [mean, mean], style=style, in_legend=first))
    return found


def _unnamed(points: list[Line]) -> list[Line]:
    return [replace(line, in_legend=False) for line in points]


def _regressions(night: Night) -> list[Line]:
    """Return the regression lines with their correlation."""
    styles = {**_TV_STYLES, night.labels[night.reference]: _REFERENCE_STYLE}
    ends = np.array([np.nanmin(night.r0_m), np.nanmax(night.r0_m)])
    return [
        Line(
            f"{line.name}: r = {line.correlation:.2f}",
            100 * ends,
            line.intercept + line.slope_per_m.value * ends,
            style={"color": styles.get(line.name, {"color": METHOD_COLOURS[1]})["color"], "lw": 1.5},
        )
        for line in lines(night)
    ]


def _of_strengths(night: Night, shown: Shown, bottom: dict[str, Any]) -> Panel:
    """Return blocks against strength, and the ranges at the height of the reference plus their difference."""
    reference = night.strehl[night.is_reference]
    mean, scatter = float(np.nanmean(reference)), float(np.nanstd(reference))
    strengths = night.strength[night.strength > 0]
    across, height = [strengths.min(), strengths.max()], [mean, mean]
    band = Line("mean without TV", across, height, [scatter, scatter], {"color": "black", "lw": 1}, band=True)
    drawn = [band, *_unnamed(_points(night, shown, night.strength))]
    ranges = by_strength(night)
    if ranges:
        found = [each.measured for _, each in ranges]
        ends = [each.value - each.low for each in found], [each.high - each.value for each in found]
        style = {"color": METHOD_COLOURS[1], "marker": "s", "ms": 8, "lw": 2, "capsize": 4}
        middle, y = [strength for strength, _ in ranges], [mean + each.value for each in found]
        drawn.append(Line("ranges of strengths", middle, y, ends, style))
    above = None
    if night.counts_per_e is not None:
        most, in_counts = float(night.counts_per_e.max()), night.strength_unit == COUNTS
        other = ("e⁻", 1 / most) if in_counts else ("counts", most)
        ticks = np.linspace(0, across[1], 5)
        above = ticks, (ticks * other[1]).tolist(), f"strength ({other[0]}, full gain)"
    return Panel(drawn, f"strength ({night.strength_unit})", legend=True, above=above, **bottom)


SUMMARY_FILE, PAGE_FILE = "night.json", "night.html"
# Attributes in JSON.
_DIFFERENCE = (
    "name",
    "blocks",
    "measured",
    "without_r0",
    "paired",
    "hours",
    "hours_needed",
    "is_long_enough",
)
_LINE = ("name", "slope_per_m", "intercept", "correlation", "blocks")
_VERDICT = ("statement", "outcome", "measured", "significance", "paired", "paired_outcome", "hours_needed")


def write_night(night: Night, folder: str | Path) -> list[Path]:
    """Write the numbers and the page of a night to a folder: `night.json` and `night.html`.

    Raises
    ------
    InputError
        When a file cannot be written.
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    folder = Path(folder)
    text = to_json(night_summary(night), indent=2)
    write_atomically(folder / SUMMARY_FILE, text + "\n")
    night_page(night).write(folder / PAGE_FILE)
    return [folder / name for name in (SUMMARY_FILE, PAGE_FILE)]


def night_summary(night: Night) -> dict[str, Any]:
    """Return differences, verdicts, lines and means as plain values for JSON; null is not known."""
    sets = [*night.set_names, "all"]
    return {
        "source": night.source,
        "reference": night.labels[night.reference],
        "hours": plain(night.hours),
        "methods": [
            {"label": label, "settings": text}
            for label, text in zip(night.labels, night.settings, strict=True)
        ],
        "means": {
            name: [
                {"set": where, **{key: plain(value) for key, value in values.items()}}
                for where, values in zip(sets, group_means(night, rows), strict=True)
            ]
            for name, rows in with_reference(night).items()
        },
        "differences": [plain_record(each, _DIFFERENCE) for each in differences(night)],
        "by_strength": [
            {"mean_strength": plain(strength), **plain_record(each, _DIFFERENCE)}
            for strength, each in by_strength(night)
        ],
        "against_r0": [plain_record(line, _LINE) for line in lines(night)],
        "verdicts": [plain_record(each, _VERDICT) for each in verdicts(night)],
        "paper": paper_sentences(night),
    }


def plain(value: object) -> Any:
    """Return a value for JSON: numbers to six digits, estimates with their intervals; None is not known."""
    if isinstance(value, Estimate):
        if not math.isfinite(value.value):
            return None
        return {**plain_record(value, ("value", "standard_error", "low", "high")), "pieces": value.count}
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return None if value == "" else value


def plain_record(record: object, attributes: Sequence[str]) -> dict[str, Any]:
    """Return attributes of an object as values for JSON."""
    return {name: plain(getattr(record, name)) for name in attributes}


def night_summary_text(night: Night) -> str:
    """Return verdicts and differences as lines of text."""
    judged = (_TEXT("lines.verdict", each) for each in verdicts(night))
    return "\n".join([*judged, *paper_sentences(night), *_conclusions(night)])


def night_sections(night: Night) -> list[page.Section]:
    """Return the sections of a night, for a page of its own or another one."""
    names = {"reference": night.labels[night.reference]}
    statements = _TEXT.table("night-verdicts", verdicts(night))
    compared = _TEXT.table(
        "night-differences", differences(night), effect="paired" if night.is_paired else "measured", **names
    )
    settings = list(zip(night.labels, night.settings, strict=True))
    panels = _TEXT.section("night-panels", panels_figure(night), strengths=night.has_strengths)
    means, table = _TEXT.section("night-means", _means_table(night)), paper_table(night)
    between = _TEXT.section("night-differences", compared, **names)
    return [
        *([_TEXT.section("night-verdicts", statements)] if statements else [between]),
        *([_TEXT.section("night-paper", " ".join(paper_sentences(night)), table)] if table else []),
        panels,
        means,
        *([between] if statements else []),
        _TEXT.section("night-r0", _TEXT.table("night-r0", lines(night)), **_quality_of_r0(night)),
        _TEXT.section("night-settings", _TEXT.table("night-settings", settings)),
    ]


def night_page(night: Night) -> page.Report:
    """Return the page of a night."""
    configuration = LoopConfiguration.of_results(night.configuration)
    name = "" if configuration is None else f": “{configuration.name}”"
    sections = night_sections(night)
    if night.configuration:
        sections.append(page.configuration_section(night.configuration))
    return page.Report(_TEXT("page.title", name=name), _facts(night), sections)


def _conclusions(night: Night) -> list[str]:
    """Return one sentence for each difference, and whether the night was long enough for it."""
    return [
        f"{_TEXT('lines.conclusion', each)} {_TEXT(f'lines.{_length(each)}', each)}"
        for each in differences(night)
    ]


def _length(difference: Difference) -> str:
    if math.isinf(difference.hours_needed) and difference.shared_error > 0:
        return "never"
    if not math.isfinite(difference.hours_needed):
        return "unknown"
    return "long_enough" if difference.is_long_enough else "too_short"


def _means_table(night: Night) -> page.Table:
    named = with_reference(night)
    columns = [group_means(night, rows) for rows in named.values()]
    rows: list[list[str | page.TableCell]] = []
    for row, where in enumerate([*night.set_names, "all sets"]):
        values = [column[row] for column in columns]
        cells = [
            page.TableCell(_TEXT("night-means.cell", each), small=_TEXT("night-means.small", each))
            for each in values
        ]
        rows.append([where, *cells])
    return _TEXT.table("night-means", rows, list(named))


def paper_sentences(night: Night) -> list[str]:
    """Return what the paper's Table 1 and a night say about each other; empty where they have other sets."""
    compared = compare_with_paper(night)
    if compared is None:
        return []
    by_name = {line.name: line.correlation for line in lines(night)}
    correlation = {"correlation": by_name.get(ALL_STRENGTHS), "of_paper": PAPER_CORRELATION}
    return _TEXT.lines("night-paper.sentences", compared, **correlation)


def paper_table(night: Night) -> page.Table | None:
    """Return the paper's Table 1 beside the means of a night, and the differences of both."""
    compared = compare_with_paper(night)
    if compared is None:
        return None
    columns: list[list[str]] = []
    for means in (PAPER_MEANS, compared.means):
        columns.append([f"{mean:.3f}" for mean in (*means[:, 0], means[:, 0].mean())])
    for column in (compared.every, compared.best):
        for sets, mean in ((column.paper, column.paper_mean), (column.ours, column.our_mean)):
            columns.append([with_error(each, sign=True) for each in (*sets, mean)])
    names = [*night.set_names, "mean of the sets"]
    exposures = ", ".join(map(str, paper_exposures()[:2].ravel()))
    return _TEXT.table("night-paper", list(zip(names, *columns, strict=True)), exposures=exposures)


def _quality_of_r0(night: Night) -> dict[str, Any]:
    """Return the measured over the true r0, where both are known."""
    ratio = (night.r0_m / night.true_r0_m)[np.isfinite(night.r0_m / night.true_r0_m)]
    if not len(ratio):
        return {"ratio": None}
    within = 100 * float(np.mean(np.abs(ratio - 1) < 0.1))
    return {"ratio": np.median(ratio), "within": within, "count": len(ratio)}


def _facts(night: Night) -> Mapping[str, str]:
    is_simulated = bool(np.isfinite(night.true_r0_m).any())
    r0 = night.true_r0_m if is_simulated else night.r0_m
    has_r0 = bool(np.isfinite(r0).any())
    return _TEXT.facts(
        "facts",
        night,
        sets=len(night.set_names),
        blocks=len(night.strehl),
        seconds=float(np.median(night.duration_s)),
        methods=f"{len(night.labels)}, compared with {night.labels[night.reference]}",
        low=float(np.nanmin(r0)) if has_r0 else None,
        high=float(np.nanmax(r0)) if has_r0 else None,
        how="the simulation’s" if is_simulated else "measured",
        um=night.wavelength_m * 1e6,
    )
