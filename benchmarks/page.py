"""The page of a run: one HTML file that needs nothing else, in the style of faintspot's reports."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.figures import CAPTIONS
from benchmarks.measuring import Row, Table
from benchmarks.results import Benchmark, Results
from benchmarks.showing import number
from faintspot.errors import MissingExtraError
from faintspot.report.drawing import png
from faintspot.report.page import data_uri, style, write_report

_PIXELS_PER_INCH = 90


@dataclass(frozen=True)
class Paragraph:
    """A part of a module's own words: a text, or the items of a list."""

    text: str
    items: list[str]


def page(results: Results) -> str:
    """Return the page as HTML.

    Raises
    ------
    MissingExtraError
        When jinja2 or matplotlib is not installed.
    """
    try:
        import jinja2
    except ImportError:
        raise MissingExtraError("jinja2", "web", "Making a page") from None
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    template = environment.from_string(Path(__file__).with_name("page.html").read_text(encoding="utf-8"))
    targets = [
        {
            "name": row.name,
            "table": table.title,
            "benchmark": benchmark.name,
            "measured": _decisive(row),
            "target": row.target,
            "met": row.met,
        }
        for benchmark in results.benchmarks
        for table in benchmark.tables
        for row in table.rows
        if row.target
    ]
    return template.render(
        title="faintspot: benchmarks",
        style=style(),  # all pages look the same
        facts={
            "begun": results.started.replace("T", " "),
            **results.fingerprint,
            "load average": " | ".join(
                each.load for each in (*results.benchmarks[:1], *results.benchmarks[-1:])
            )
            + " (before the first and the last benchmark; over 1, 5 and 15 minutes)",
        },
        failures=[f"{each.name}: {each.failure}" for each in results.benchmarks if each.failure],
        targets=sorted(targets, key=lambda target: target["met"] is not False),
        reached=sum(target["met"] is True for target in targets),
        sections=[_section(benchmark) for benchmark in results.benchmarks],
        versions=results.versions,
    )


def write_page(results: Results, path: Path) -> None:
    """Write the page; an existing file is replaced."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_report(path, page(results))


def paragraphs(text: str) -> list[Paragraph]:
    """Cut a module's docstring into paragraphs and lists; its first line, the title, is left out."""
    parts = []
    for block in text.strip().split("\n\n")[1:]:
        first, *items = f"\n{block}".split("\n- ")
        if first.strip():
            parts.append(Paragraph(" ".join(first.split()), []))
        if items:
            parts.append(Paragraph("", [" ".join(item.split()) for item in items]))
    return parts


def _decisive(row: Row) -> str:
    """Return the numbers that a target is about: those with a spread, else the last one."""
    columns = [column for column in row.values if column in row.spread] or list(row.values)[-1:]
    return ", ".join(f"{column} {number(row.values[column])}" for column in columns)


def _section(benchmark: Benchmark) -> dict[str, Any]:
    title = " ".join(benchmark.about.strip().partition("\n\n")[0].split()).removesuffix(".")
    about = paragraphs(benchmark.about)
    return {
        "name": benchmark.name,
        "title": title or benchmark.name,
        "about": about[:1],
        "details": about[1:],
        "tables": [_table(table) for table in benchmark.tables],
        "pictures": _pictures(benchmark),
        "failure": benchmark.failure,
        "seconds": f"{benchmark.seconds:.0f}",
        "load": benchmark.load,
    }


def _table(table: Table) -> dict[str, Any]:
    columns = list(dict.fromkeys(column for row in table.rows for column in row.values))
    with_targets = any(row.target for row in table.rows)
    return {
        "title": table.title,
        "header": ["", *columns, *(["target", "met"] if with_targets else [])],
        "with_targets": with_targets,
        "rows": [
            {"name": row.name, "cells": _cells(row, columns), "target": row.target, "met": row.met}
            for row in table.rows
        ],
        "notes": table.notes,
    }


def _cells(row: Row, columns: list[str]) -> list[dict[str, str]]:
    return [
        {
            "value": number(row.values[column]) if column in row.values else "",
            "spread": f"{100 * row.spread[column]:.1f} %"
            if math.isfinite(row.spread.get(column, math.nan))
            else "",
        }
        for column in columns
    ]


def _pictures(benchmark: Benchmark) -> list[dict[str, Any]]:
    if benchmark.name not in CAPTIONS:
        return []
    draw, caption = CAPTIONS[benchmark.name]
    figure = draw({table.name: table for table in benchmark.tables})
    if figure is None:
        return []
    width = int(_PIXELS_PER_INCH * figure.get_figwidth())
    return [{"data": data_uri("png", png(figure)), "caption": caption, "width": width}]
