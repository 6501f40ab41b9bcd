"""The tables of the closed-loop report."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence

from faintspot.base.json_text import parse_json
from faintspot.base.report.page import Table
from faintspot.base.report.texts import Texts, with_error, with_interval
from faintspot.base.statistics import paired_mean
from faintspot.experiments.closed_loop.methods import LOOP_GAIN
from faintspot.experiments.closed_loop.results import MagnitudeResult, gains_in_magnitude

_TEXT = Texts("faintspot.experiments")


def gain_table(result: MagnitudeResult, methods: Sequence[int], reference: int) -> Table:
    """Return the gains in limiting magnitude of methods over a reference at equal Strehl."""
    gains = {result.labels[method]: gains_in_magnitude(result, method, reference) for method in methods}
    rows = [
        [name, *(with_interval(gain, 2) for gain in of_method.values())] for name, of_method in gains.items()
    ]
    columns = [f"at Strehl {level:g}" for level in next(iter(gains.values()), {})]
    return _TEXT.table("tables.gain", rows, columns, reference=result.labels[reference])


def strehl_table(result: MagnitudeResult) -> Table:
    """Return the Strehl ratio of every method at each flux."""
    rows = [
        [label, *(with_error(paired_mean(runs)) for runs in of_method)]
        for label, of_method in zip(result.labels, result.strehl, strict=True)
    ]
    return _TEXT.table("tables.strehl", rows, _stars(result))


def settings_table(result: MagnitudeResult) -> Table:
    """Return the tuned loop gain and settings of every method at each flux."""
    rows = [
        [label, *map(_settings_words, choices, settings)]
        for label, choices, settings in zip(result.labels, result.choices, result.settings, strict=True)
    ]
    return _TEXT.table("tables.settings", rows, _stars(result))


def in_columns(table: Table) -> str:
    """Return a table of texts as lines for a terminal."""
    rows = [[str(cell) for cell in row] for row in (table.header, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(map(str.rjust, row[1:], widths[1:])) for row in rows)
    return "\n".join(f"{row[0]:{widths[0]}}  {line}" for row, line in zip(rows, lines, strict=True))


def _stars(result: MagnitudeResult) -> list[str]:
    stars = zip(result.photons, result.magnitudes, strict=True)
    return [f"{photons:.3g} e⁻, {magnitude:.1f} mag" for photons, magnitude in stars]


def _settings_words(choice: str, text: str) -> str:
    """Return tuned values as one line."""
    if not text:
        return "not tuned yet"
    options = [item for table in tomllib.loads(text).values() for item in table.items() if item[0] != "name"]
    words = (
        f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in options
    )
    return ", ".join([f"gain {parse_json(choice)[LOOP_GAIN]:.2g}", *words])
