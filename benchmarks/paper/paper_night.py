"""The paper's night in both units of the strength: `python -m benchmarks paper_night ELECTRONS COUNTS`

writes the tables of docs/results/paper.md from two folders of `faintspot loop night`, one of them with
`--unit counts`.
"""

import json
from pathlib import Path
from typing import Any

import click
import numpy as np

from benchmarks.results import PAGES, origin_now, publish_tables
from faintspot.base.report.texts import in_hours, with_error
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.analysis import Difference, by_strength, differences
from faintspot.experiments.night.page import paper_sentences
from faintspot.experiments.night.paper import (
    PAPER_MEANS,
    PAPER_SCATTERS,
    PaperColumn,
    compare_with_paper,
    paper_exposures,
    set_columns,
)
from faintspot.experiments.night.protocol import NIGHT_FILE, Night
from faintspot.experiments.paper.claims import paper_rows

Tables = dict[str, dict[str, Any]]
_FOLDER = click.Path(exists=True, file_okay=False, path_type=Path)
_COMMAND = "faintspot loop night canary, and with --unit counts; python -m benchmarks paper_night"


@click.command()
@click.argument("electrons", type=_FOLDER)
@click.argument("counts", type=_FOLDER)
def run_command(electrons: Path, counts: Path) -> None:
    """Store the tables of two finished nights for the documentation, and print what they say."""
    nights = Night.load(electrons / NIGHT_FILE), Night.load(counts / NIGHT_FILE)
    click.echo(publish(*nights))
    for night in nights:
        click.echo("\n".join([f"[{night.strength_unit}]", *paper_sentences(night)]))


def publish(electrons: Night, counts: Night, pages: Path = PAGES) -> Path:
    """Write tables, sentences and the night's verdicts to the file that the page takes them from."""
    path = pages / "paper.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    sentences = [" ".join(paper_sentences(night)) for night in (electrons, counts)]
    data["figures"] |= {"in_electrons": sentences[0], "in_counts": sentences[1]}
    path.write_text(json.dumps(data, ensure_ascii=False), encoding="utf-8")
    rows = paper_rows(None, electrons)
    of_night = [[row.part, row.statement, f"**{row.verdict}**", row.number] for row in rows]
    verdicts = data["tables"]["verdicts"]
    of_study = [row for row in verdicts["rows"] if row[0] != rows[0].part]
    publish_tables(path, {"verdicts": {**verdicts, "rows": of_study + of_night}}, {})
    return publish_tables(path, tables_of(electrons, counts), origin_now(_COMMAND))


def tables_of(electrons: Night, counts: Night) -> Tables:
    """Return the tables of the page by name."""
    return {
        "night": _means(electrons),
        "night_paper": _beside_the_paper(electrons, counts),
        "night_differences": _differences(electrons, counts),
    }


def _means(night: Night) -> dict[str, Any]:
    """Return the paper's columns beside those of a night."""
    rows = []
    exposures = paper_exposures()
    for number, columns in enumerate(set_columns(night)):
        row = [f"{number + 1}: {night.set_names[number]}"]
        for column, blocks in enumerate(columns):
            values = night.strehl[blocks]
            paper = PAPER_MEANS[number, column], PAPER_SCATTERS[number, column], exposures[number, column]
            for mean, scatter, count in (paper, (values.mean(), values.std(ddof=1), len(values))):
                row.append(f"{mean:.3f} ± {scatter:.3f} ({count})")
        rows.append(row)
    ours = [
        np.mean([night.strehl[each[column]].mean() for each in set_columns(night)]) for column in range(3)
    ]
    of_paper = PAPER_MEANS.mean(axis=0)
    pairs = zip(of_paper, ours, strict=True)
    rows.append(["mean of the sets", *(f"{mean:.3f}" for pair in pairs for mean in pair)])
    names = "without TV", "TV, all strengths", "TV, 0.6 to 1.1"
    header = ["set", *(f"{name}: {whose}" for name in names for whose in ("paper", "here"))]
    return {"title": "The night", "columns": header, "rows": rows}


def _beside_the_paper(electrons: Night, counts: Night) -> dict[str, Any]:
    """Return the differences of Table 1 beside those of both nights."""
    both = [each for each in map(compare_with_paper, (electrons, counts)) if each is not None]
    columns: list[list[str]] = []
    for name in ("every", "best"):
        parts: list[PaperColumn] = [getattr(each, name) for each in both]
        paper = _cells(*parts[0].paper, parts[0].paper_mean)
        columns.append([*paper, "", f"{parts[0].chance:.3f}"])
        for part in parts:
            square = f"{part.chi_square:.1f} ({part.probability:.2g})"
            columns.append([*_cells(*part.ours, part.our_mean), square, ""])
    sets = [str(number + 1) for number in range(len(PAPER_MEANS))]
    names = [*sets, "mean of the sets", "chi-square (probability)", "chance without a difference"]
    ranges = "all strengths", "0.6 to 1.1"
    header = [f"{part}: {whose}" for part in ranges for whose in ("paper", "here, e⁻", "here, counts")]
    rows = [list(row) for row in zip(names, *columns, strict=True)]
    return {"title": "Table 1 and both units", "columns": ["set", *header], "rows": rows}


def _cells(*estimates: Estimate) -> list[str]:
    return [with_error(each, sign=True) for each in estimates]


def _differences(electrons: Night, counts: Night) -> dict[str, Any]:
    """Return the differences of groups and ranges of strengths of both nights."""
    rows = []
    for night in (electrons, counts):
        every = [*differences(night), *(each for _, each in by_strength(night))]
        rows += [[night.strength_unit, *_row(each)] for each in every]
    columns = [
        "unit",
        "strengths",
        "alternating, at equal r0",
        "in the same turbulence",
        "alternating for 3 σ",
    ]
    return {"title": "Differences by strength", "columns": columns, "rows": rows}


def _row(difference: Difference) -> list[str]:
    paired = "" if difference.paired is None else with_error(difference.paired, 4, sign=True)
    needed = in_hours(difference.hours_needed) if np.isfinite(difference.hours_needed) else "–"
    return [difference.name, with_error(difference.measured, 4, sign=True), paired, needed]
