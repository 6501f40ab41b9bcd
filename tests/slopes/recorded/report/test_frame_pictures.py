"""What pictures are made of: windows in place, chosen sub-apertures, positions, files."""

import matplotlib
import numpy as np
from tests.slopes.recorded.recorded_cases import SETTINGS, sensor, simulated

from faintspot.base.report.plots import png
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.recorded.report.frame_pictures import (
    Example,
    assembled,
    coarseness,
    coarser,
    example_subapertures,
    whole_sensor,
)
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
        Example(layout, {"TV": SlopePipeline(layout, SETTINGS).explain(frame)}, truth).positions()
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


def test_raw_in_electrons_is_recognised() -> None:
    from faintspot.slopes.camera.calibration import Calibration

    layout = sensor()
    frame = simulated(layout, 1)[0][0]
    same = Example(layout, {"TV": SlopePipeline(layout, SETTINGS).explain(frame)})
    other = SlopePipeline(layout, SETTINGS, Calibration(dark=1.0)).explain(frame)
    assert same.raw_is_calibrated
    assert not Example(layout, {"TV": other}).raw_is_calibrated


def test_users_style_is_neither_used_nor_changed() -> None:
    layout = sensor((1, 1))
    stages = {"TV": SlopePipeline(layout, SETTINGS).explain(simulated(layout, 1)[0][0])}
    plain = png(whole_sensor(Example(layout, stages)))
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert png(whole_sensor(Example(layout, stages))) == plain
        assert matplotlib.rcParams["font.size"] == 30


def test_a_big_sensor_is_shown_coarser_and_its_spots_stay() -> None:
    small, big = sensor(), Layout.grid((60, 60), pixels=16)
    assert coarseness(small) == 1
    assert coarseness(big) == 3
    sheet = np.full((7, 5), np.nan)
    sheet[1, 1], sheet[2, 3], sheet[6, 4] = 5.0, 2.0, 1.0
    found = coarser(sheet, 3)
    np.testing.assert_array_equal(found, [[5.0, 2.0], [np.nan, np.nan], [np.nan, 1.0]])
    assert coarser(sheet, 1) is sheet


def test_a_raw_frame_in_electrons_is_not_shown_twice_alone() -> None:
    layout = sensor()
    stages = {"ml": SlopePipeline(layout, SETTINGS).explain(simulated(layout, 1)[0][0])}
    assert list(Example(layout, stages, steps=TotalVariation.steps_shown[:2]).shown_steps) == ["raw"]
    assert len(Example(layout, stages, steps=TotalVariation.steps_shown).shown_steps) == 4
