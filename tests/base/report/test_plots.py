"""Plots of lines: what is drawn, and limits that are left to the data."""

import sys

import numpy as np
import pytest

from faintspot.base.errors import MissingExtraError
from faintspot.base.report.plots import Line, Panel, limits_of, new_figure, plain_ticks, plot, png, svg
from faintspot.slopes.sensor.drawing import subaperture_shapes
from faintspot.slopes.sensor.layout import Layout


def test_lines_levels_and_legend() -> None:
    bars = Line("a", [1, 10, 100], [1.0, np.nan, 4.0], [0.1, 0.1, np.nan], {"marker": "o"})
    band = Line("b", [1, 100], [2.0, 2.0], ([0.5, 0.5], [1.0, 1.0]), {"color": "red"}, band=True)
    level = {3.0: {"label": "level"}}
    figure = plot(
        [[Panel([bars, band], "x (px)", "y", x_ticks=(1, 10, 1000), levels=level), Panel([], "")]], 3.0
    )
    left, _ = figure.axes
    assert np.asarray(left.lines[0].get_xdata(), float).tolist() == [1, 100]
    assert len(left.collections) == 2  # of the bars and the band
    assert [label.get_text() for label in left.get_xticklabels()] == ["1", "10", "1000"]
    assert [text.get_text() for text in figure.legends[0].texts] == ["a", "b", "level"]


def test_panels_that_share_an_axis_show_all_lines() -> None:
    panels = [Panel([Line("", [0, 1], [0.0, height])], "x") for height in (1.0, 5.0)]
    figure = plot([panels], 3.0, legend="", shared=True)
    assert all(axes.get_ylim()[1] > 5 for axes in figure.axes)
    figure = plot([[Panel([], "")]], 3.0, legend="")
    figure.axes[0].bar([1], [7.0])
    assert figure.axes[0].get_ylim()[1] == pytest.approx(7.35)


@pytest.mark.parametrize(("geometry", "area"), [("square", 1.0), ("hexagonal", np.sqrt(3) / 2)])
def test_shapes_tile_the_plane(geometry: str, area: float) -> None:
    layout = Layout((60, 60), (8, 8), np.array([[10, 10], [30, 30]]), geometry=geometry, pitch_px=10.0)
    x, y = subaperture_shapes(layout)[0].T
    found = 0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))
    assert found == pytest.approx(0.96**2 * area * 100)
    assert np.hypot(x - 13.5, y - 13.5).max() < 7.1


def test_limits_are_never_empty() -> None:
    assert limits_of(np.array([np.nan])) == (0.0, 1.0)
    low, high = limits_of(np.array([3.0, 3.0]))
    assert low < high
    assert limits_of(np.array([1.0, np.nan]), np.array([5.0]), low=0.0) == (0.0, 5.0)


def test_an_empty_figure_is_written() -> None:
    assert png(new_figure(1.0, 1.0)).startswith(b"\x89PNG")


def test_svg_is_the_same_bytes_for_the_same_figure() -> None:
    first, second = (svg(new_figure(1.0, 1.0)) for _ in range(2))
    assert first == second
    assert b"<svg" in first


def test_missing_matplotlib_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for module in (
        "base.report.plots",
        "slopes.sensor.drawing",
        "slopes.recorded.pictures",
    ):
        for name in ("faintspot.base.report.plots", f"faintspot.{module}"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        with pytest.raises(MissingExtraError, match=r"faintspot\[report\]"):
            __import__(f"faintspot.{module}")


def test_plain_ticks_are_at_their_places_alone() -> None:
    axes = new_figure(3.0, 3.0).subplots()
    axes.set_xscale("log")
    axes.set_xlim(0.5, 20000)
    plain_ticks(axes.xaxis, (1, 30, 10000))
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "30", "10000"]
    assert len(axes.get_xticks(minor=True)) == 0
