"""The picture of a layout on its frame."""

from pathlib import Path

import numpy as np
import pytest
from tests.refusals import refused
from tests.shared_data import shared_file
from tests.slopes.recorded.recorded_cases import sensor, simulated

from faintspot.slopes.sensor.drawing import layout_picture
from faintspot.slopes.sensor.layout import Layout


@pytest.mark.usefixtures("coarse_pictures")
def test_layout_picture_is_a_png(tmp_path: Path) -> None:
    layout = sensor()
    frames = simulated(layout, 2)[0]
    frames[:, 3, 3] = np.nan
    layout_picture(frames, layout, tmp_path / "layout.png")
    assert (tmp_path / "layout.png").read_bytes().startswith(b"\x89PNG")
    layout_picture(np.zeros(layout.frame_shape), layout, tmp_path / "dark.png")
    with refused("frame"):
        layout_picture(frames[:, 1:], layout, tmp_path / "other.png")
    with refused("does not exist"):
        layout_picture(frames, layout, tmp_path / "none" / "layout.png")


@pytest.mark.slow
def test_layout_picture_of_a_real_frame(tmp_path: Path) -> None:
    frame = np.load(shared_file("data/ciao_bench_60x224x224.npz"))["frames"].mean(axis=0)
    layout = Layout.grid((8, 8), pixels=27, frame_shape=frame.shape)
    layout_picture(frame, layout, tmp_path / "layout.png")
    assert (tmp_path / "layout.png").stat().st_size > 10_000
