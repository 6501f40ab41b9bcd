"""One page made of sections: everything is in it, escaped, and nothing from elsewhere."""

import base64
from pathlib import Path

import pytest
from tests.refusals import refused
from tests.slopes.recorded.recorded_cases import Page as Reader

from faintspot.base.report.page import (
    FigureWithData,
    Report,
    Section,
    Table,
    TableCell,
    configuration_section,
)
from faintspot.base.report.plots import new_figure

pytestmark = pytest.mark.usefixtures("coarse_pictures")


def sections() -> list[Section]:
    cell = TableCell("text", "holds", "small")
    figures = [
        FigureWithData("data", "With data", "Caption 1.", new_figure(1, 1), "x,y\n1,2.5\n"),
        FigureWithData("picture", "Without", "Caption 2.", new_figure(2, 1)),
    ]
    with_file = Table(["c"], [["d"]], csv=("rows.csv", "c\nd,é\n"))
    return [
        Section("first", "First <1>", ["A paragraph & more.", ["a point"]], missing="None of it."),
        Section("tables", "Tables", [Table(["", "b"], [["<a>", cell]], "A caption."), with_file]),
        Section("last", "Last", figures),
        configuration_section("noise_std = 1 # <b>"),
    ]


def page(**changes: object) -> Report:
    return Report("A <title>", {"Sources": "a & b"}, sections(), **changes)  # type: ignore[arg-type]


def test_everything_is_on_the_page() -> None:
    reader = Reader(page(warnings=["look <here>"], remark="Units.").html())
    assert reader.ids == ["first", "tables", "last", "configuration"]
    for words in (
        "A <title>",
        "a & b",
        "look <here>",
        "What to look at first",
        "First <1>",
        "a point",
        "None of it.",
        "holds",
        "small",
        "A caption.",
        "Caption 2.",
        "The configuration as TOML text",
        "noise_std = 1 # <b>",
        "Units.",
    ):
        assert words in reader.text
    assert {"class": "badge good"} in [found for tag, found in reader.tags if tag == "span"]
    links = [value for value in reader.values("href") if value.startswith("#")]
    assert links == ["#first", "#tables", "#last", "#configuration"]


def test_links_lead_nowhere_else() -> None:
    reader = Reader(page().html())
    for attribute in ("src", "href"):
        assert all(value.startswith(("data:", "#")) for value in reader.values(attribute))
    assert "script" not in [tag for tag, _ in reader.tags]


def test_figures_with_data_can_be_saved_and_pictures_are_png() -> None:
    reader = Reader(page().html())
    saved = {
        found["download"]: base64.b64decode((found["href"] or "").partition(",")[2])
        for tag, found in reader.tags
        if tag == "a" and "download" in found
    }
    assert saved["data.csv"] == b"x,y\n1,2.5\n"
    assert saved["rows.csv"].decode() == "c\nd,é\n"
    assert set(saved) == {"data.csv", "rows.csv"}
    assert [source[:15] for source in reader.values("src")] == ["data:image/svg+", "data:image/png;"]


def test_an_unknown_configuration_is_said() -> None:
    assert configuration_section(" ").missing == "The configuration of this run is not known."
    assert configuration_section("", "Specification").title == "Specification"


def test_the_page_is_written(tmp_path: Path) -> None:
    page().write(tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text(encoding="utf-8") == page().html()
    with refused("cannot be written"):
        page().write(tmp_path / "none" / "a.html")
