"""Maps over all frames: arrows that are cut, outlines, and maps of one frame."""

from typing import Any

import numpy as np
import pytest
from tests.slopes.recorded.recorded_cases import sensor, simulated, two_methods

from faintspot.slopes.recorded.report import maps
from faintspot.slopes.recorded.statistics import MeasuredSlopes, summarise
from faintspot.slopes.sensor.layout import Layout


def slopes(wild: float = 0.0, n: int = 100, usual: float = 0.1) -> MeasuredSlopes:
    x = np.full((2, n), usual)
    x[:, 1] += wild
    nothing = np.zeros(x.shape, np.uint8)
    return MeasuredSlopes("TV", x, np.zeros_like(x), x + 5, flags=nothing, iterations=nothing)


def test_arrows_are_cut_where_a_few_are_wild() -> None:
    assert maps.longest_arrow([summarise(slopes())]) == (0.1, 0)
    longest, number = maps.longest_arrow([summarise(slopes(50.0))])
    assert longest == pytest.approx(0.15)
    assert number == 1
    assert maps.longest_arrow([summarise(slopes(usual=0.0))]) == (1.0, 0)


def test_drawn_arrows_are_no_longer_than_the_limit() -> None:
    layout = Layout.grid((10, 10), pixels=8)
    summaries = [summarise(slopes(50.0))]
    figure = maps.slope_arrows([slopes(50.0)], summaries, layout)
    arrows: Any = next(item for item in figure.axes[0].collections if hasattr(item, "U"))
    assert np.hypot(arrows.U, arrows.V).max() == pytest.approx(maps.longest_arrow(summaries)[0])


def test_outlines_are_left_out_of_big_sensors() -> None:
    def drawn(side: int) -> int:
        method = slopes(n=side**2)
        figure = maps.slope_arrows([method], [summarise(method)], Layout.grid((side, side), pixels=8))
        return len(figure.axes[0].collections)

    assert drawn(30) == drawn(2) - 1


def test_one_frame_has_a_map_of_the_flux_alone() -> None:
    layout = sensor()
    frames = simulated(layout, 2)[0]
    for n_frames, titles in ((1, ["TV: flux"]), (2, ["TV: median flux", "TV: valid frames"])):
        method = two_methods(layout, frames[:n_frames])[0][0]
        figure = maps.flux_and_validity([method], [summarise(method)], layout)
        assert [title for panel in figure.axes if (title := panel.get_title())] == titles
