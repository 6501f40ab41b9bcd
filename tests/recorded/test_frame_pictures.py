"""What pictures are made of: windows in place, chosen sub-apertures, positions, files."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import pytest
from tests.recorded.recorded_cases import SETTINGS, sensor, simulated
from tests.shared_data import shared_file

from faintspot.errors import InputError
from faintspot.pipeline import SlopePipeline
from faintspot.recorded.frame_pictures import Example, assembled, example_subapertures, whole_sensor
from faintspot.report import layout_picture
from faintspot.report.drawing import limits_of, new_figure, png, subaperture_shapes
from faintspot.sensor.layout import Layout


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
    from faintspot.sensor.calibration import Calibration

    layout = sensor()
    frame = simulated(layout, 1)[0][0]
    same = Example(layout, {"TV": SlopePipeline(layout, SETTINGS).explain(frame)})
    other = SlopePipeline(layout, SETTINGS, Calibration(dark=1.0)).explain(frame)
    assert same.raw_is_calibrated
    assert not Example(layout, {"TV": other}).raw_is_calibrated


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


def test_users_style_is_neither_used_nor_changed() -> None:
    layout = sensor((1, 1))
    stages = {"TV": SlopePipeline(layout, SETTINGS).explain(simulated(layout, 1)[0][0])}
    plain = png(whole_sensor(Example(layout, stages)))
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "black"}):
        assert png(whole_sensor(Example(layout, stages))) == plain
        assert matplotlib.rcParams["font.size"] == 30


def test_layout_picture_is_a_png(tmp_path: Path) -> None:
    layout = sensor()
    frames = simulated(layout, 2)[0]
    frames[:, 3, 3] = np.nan
    layout_picture(frames, layout, tmp_path / "layout.png")
    assert (tmp_path / "layout.png").read_bytes().startswith(b"\x89PNG")
    layout_picture(np.zeros(layout.frame_shape), layout, tmp_path / "dark.png")
    with pytest.raises(InputError, match="frame"):
        layout_picture(frames[:, 1:], layout, tmp_path / "other.png")
    with pytest.raises(InputError, match="does not exist"):
        layout_picture(frames, layout, tmp_path / "none" / "layout.png")


def test_layout_picture_of_a_real_frame(tmp_path: Path) -> None:
    frame = np.load(shared_file("data/ciao_bench_60x224x224.npz"))["frames"].mean(axis=0)
    layout = Layout.grid((8, 8), pixels=27, frame_shape=frame.shape)
    layout_picture(frame, layout, tmp_path / "layout.png")
    assert (tmp_path / "layout.png").stat().st_size > 10_000


def test_an_empty_figure_is_written() -> None:
    assert png(new_figure(1.0, 1.0)).startswith(b"\x89PNG")
