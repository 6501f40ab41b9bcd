"""The texts of pages: each is asked for by a module that reads its file; sentences, cells and columns."""

import re
import tomllib
from collections.abc import Iterator, Mapping
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from faintspot.base.report.page import TableCell
from faintspot.base.report.texts import Texts, Words
from faintspot.base.statistics import Estimate

PACKAGES = (
    "faintspot.experiments",
    "faintspot.experiments.night",
    "faintspot.loop.telemetry",
    "faintspot.slopes.recorded",
    "faintspot.slopes.wavefront",
)


def tables(content: Mapping[str, Any], above: str = "") -> Iterator[str]:
    for name, value in content.items():
        yield f"{above}{name}"
        if isinstance(value, dict) and name not in ("columns", "about"):
            yield from tables(value, f"{above}{name}.")


def made(texts: Mapping[str, Any]) -> Texts:
    found = Texts("faintspot.experiments")
    found._tables = dict(texts)
    return found


@pytest.mark.parametrize("package", PACKAGES)
def test_texts_and_modules_name_each_other(package: str) -> None:
    every = [path.read_text(encoding="utf-8") for path in Path(str(files("faintspot"))).rglob("*.py")]
    code = "\n".join(text for text in every if f'Texts("{package}")' in text)
    own = "\n".join(text for text in every if f'_TEXT = Texts("{package}")' in text)
    text = files(package).joinpath("texts.toml").read_text(encoding="utf-8")
    names = set(tables(tomllib.loads(text)))
    asked = set(re.findall(r'_TEXT(?:\.\w+)?[(\[]\s*"([^"]+)"', own))
    assert asked
    assert asked - names == set()
    unused = [
        name
        for name in names
        if not any(
            re.search(rf'"{re.escape(part)}["\[.]', code)
            for part in (name[:end] for end in range(1, len(name) + 1))
        )
    ]
    assert unused == []


def test_sentences_are_left_out_without_their_values() -> None:
    text = made(
        {"a": ["{shown}One.", "{number:.1f} px.", "{part.real} of it."], "b": {"x": "{c}", "y": "{d}"}}
    )
    assert text("a", shown=True, number=2.0, part=3) == "One. 2.0 px. 3 of it."
    assert text("a", shown=False, number=float("nan"), part=None) == "– px."
    assert text.lines("a", shown=None, number=1.0, part=None) == ["1.0 px."]
    assert text.facts("b", {"c": "known"}, d=None) == {"x": "known"}
    otherwise = made({"a": ["{rate:.0f} Hz.", "{rate:not}No rate."]})
    assert [otherwise("a", rate=rate) for rate in (7.0, None)] == ["7 Hz.", "No rate."]


def test_a_table_is_filled_in_from_records() -> None:
    columns = {
        "name": "{name}",
        "of {other}": ["{value:interval}", "{few}too few"],
        "badge": {"badge": "{outcome}", "small": "{number:.2f}"},
        "unknown": "{nothing} px",
        "± NaN": "{number:.1f} ± {number:.1f}",
    }
    about = {"of best": "About {other}.", "unknown": "Not said."}
    text = made({"t": {"columns": columns, "only_known": True, "caption": "It.", "about": about}})
    first = SimpleNamespace(
        name="a", value=Estimate(1.0, 0.1), few=None, outcome="holds", number=1.0, nothing=None
    )
    second = {**vars(first), "value": None, "few": True, "outcome": "", "number": float("nan")}
    table = text.table("t", [first, second], other="best")
    assert table.header == ["name", "of best", "badge", "± NaN"]
    cell = TableCell(badge="holds", small="1.00")
    assert table.rows[0] == ["a", "+1.000 (+0.804 to +1.196)", cell, "1.0 ± 1.0"]
    assert table.rows[1] == ["a", "too few", "–", "–"]
    assert table.caption == "It. About best."


def test_a_section_without_parts_has_a_reason() -> None:
    text = made({"part.a": "", "s": {"title": "T{n}", "text": "Text.", "missing": "None of {n}."}})
    empty = text.section("s", None, [], n=2)
    assert (empty.name, empty.title, list(empty.parts), empty.missing) == ("s", "T2", [], "None of 2.")
    whole = text.section("s", ["a point"], missing="Half.", n=2)
    assert (whole.parts, whole.missing) == (["Text.", ["a point"]], "Half.")


def test_formats_by_name() -> None:
    for form, value, words in (
        ("hours", 0.05, "3 min"),
        ("hours", 2.25, "2.2 h"),
        ("hours", 12345.0, "12\u202f345 h"),
        ("hours", float("inf"), "–"),
        ("percent", 0.0004, "< 0.1 %"),
        ("percent 0", 0.25, "25 %"),
        ("significant 4", 1.5, "1.500"),
        ("sigma", Estimate(2.0, 1.0), "+2.0 σ"),
    ):
        assert Words().format(f"{{value:{form}}}", value=value).replace(" ", "\u202f") == words.replace(
            " ", "\u202f"
        )
