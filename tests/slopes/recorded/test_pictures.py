"""What pictures are made of: windows in place, chosen sub-apertures, positions, files."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from tests.slopes.recorded.recorded_cases import SETTINGS, method_of, sensor, simulated, two_methods

from faintspot.base.report.plots import png
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.recorded import pictures
from faintspot.slopes.recorded.pictures import (
    Example,
    assembled,
    example_subapertures,
    sensor_figure,
)
from faintspot.slopes.recorded.statistics import MeasuredSlopes, jitter
from faintspot.slopes.sensor.layout import Layout


def test_assembled_windows_are_the_frame() -> None:
    layout = Layout.grid((3, 4), pixels=8, pitch=10, origin=(5, 2), frame_shape=(60, 50))
    frame = np.random.default_rng(0).normal(size=layout.frame_shape)
    sheet = assembled(layout, layout.images(frame))
    inside = np.isfinite(sheet)
    assert np.count_nonzero(inside) == len(layout) * layout.pixels
    np.testing.assert_array_equal(sheet[inside], frame[5:33, 2:40][inside])


def test_example_subapertures_are_ordered_by_flux() -> None:
    layout = sensor()
    stages = SlopePipeline(layout, SETTINGS).explain(simulated(layout, 1)[0][0])
    chosen = example_subapertures(stages)
    flux = stages.slopes.flux
    assert list(chosen) == ["faintest", "median", "brightest"]
    assert flux[chosen["faintest"]] == flux.min()
    assert flux[chosen["brightest"]] == flux.max()
    assert np.count_nonzero(flux < flux[chosen["median"]]) == 4


def test_example_positions_are_from_the_windows_middle() -> None:
    plain = sensor()
    moved = Layout(plain.frame_shape, plain.window, plain.corners, plain.centres + 0.25)
    frame = simulated(plain, 1)[0][0]
    truth = np.zeros((9, 2))
    found = [
        Example(layout, {"TV": SlopePipeline(layout, SETTINGS).explain(frame)}, 0, truth).positions()
        for layout in (plain, moved)
    ]
    # Where the centre is does not move the spot in the picture (float32 slopes).
    np.testing.assert_allclose(found[0]["TV"], found[1]["TV"], atol=1e-5)
    np.testing.assert_allclose(found[1]["truth"], 0.25)


def test_invalid_positions_are_not_marked() -> None:
    layout = sensor()
    stages = SlopePipeline(layout, SETTINGS).explain(np.zeros(layout.frame_shape))
    assert np.isnan(Example(layout, {"TV": stages}).positions()["TV"]).all()
    assert list(example_subapertures(stages)) == ["none is valid"]


def test_a_raw_frame_in_electrons_is_not_shown_twice() -> None:
    from faintspot.slopes.camera.calibration import Calibration

    layout = sensor()
    frame = simulated(layout, 1)[0][0]
    for dark, shown in ((0.0, ["calibrated"]), (1.0, ["raw", "calibrated"])):
        stages = {"TV": SlopePipeline(layout, SETTINGS, Calibration(dark=dark)).explain(frame)}
        example = Example(layout, stages, steps=TotalVariation.steps_shown[:2])
        assert list(example.shown_steps) == shown


def test_users_style_is_neither_used_nor_changed() -> None:
    layout = sensor((1, 1))
    stages = {"TV": SlopePipeline(layout, SETTINGS).explain(simulated(layout, 1)[0][0])}
    plain = png(sensor_figure(Example(layout, stages)).figure)
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert png(sensor_figure(Example(layout, stages)).figure) == plain
        assert matplotlib.rcParams["font.size"] == 30


def slopes(wild: float = 0.0, n: int = 100, usual: float = 0.1) -> MeasuredSlopes:
    x = np.full((2, n), usual)
    x[:, 1] += wild
    return method_of("TV", x, np.zeros_like(x), x + 5)


def test_arrows_are_cut_where_a_few_are_wild() -> None:
    assert pictures.longest_arrow([slopes()]) == (0.1, 0)
    longest, number = pictures.longest_arrow([slopes(50.0)])
    assert longest == pytest.approx(0.15)
    assert number == 1
    assert pictures.longest_arrow([slopes(usual=0.0)]) == (1.0, 0)
    figure = pictures.arrows_figure([slopes(50.0)], Layout.grid((10, 10), pixels=8)).figure
    arrows: Any = next(item for item in figure.axes[0].collections if hasattr(item, "U"))
    assert np.hypot(arrows.U, arrows.V).max() == pytest.approx(longest)


def test_outlines_are_left_out_of_big_sensors() -> None:
    def drawn(side: int) -> int:
        method = slopes(n=side**2)
        made = pictures.arrows_figure([method], Layout.grid((side, side), pixels=8))
        return len(made.figure.axes[0].collections)

    assert drawn(30) == drawn(2) - 1


def test_one_frame_has_a_map_of_the_flux_alone() -> None:
    layout = sensor()
    frames = simulated(layout, 2)[0]
    for n_frames, titles in ((1, ["TV: flux"]), (2, ["TV: median flux", "valid frames", "jitter"])):
        method = two_methods(layout, frames[:n_frames])[0][0]
        figure = pictures.maps_figure([method], [jitter(method, method.valid)], layout).figure
        assert [title for panel in figure.axes if (title := panel.get_title())] == titles
