"""Plots of lines: what is drawn, and limits that are left to the data."""

import numpy as np
import pytest

from faintspot.base.report.plots import Line, Panel, plot


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
