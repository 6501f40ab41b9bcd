import numpy as np
import pytest

from faintspot.data import mmt_frame
from faintspot.slopes.camera.frame_checks import find_hot_pixels
from faintspot.slopes.sensor.found_layout import find_layout


def test_the_frame_has_the_lenslets_of_its_sensor() -> None:
    frame = mmt_frame()
    assert frame.dtype == np.uint16
    bad = np.zeros(frame.shape, bool)
    bad[tuple(find_hot_pixels(frame).T)] = True
    layout = find_layout(frame.astype(float), bad_pixels=bad).layout
    assert 150 <= len(layout) <= 165  # some at the edge are doubtful
    assert layout.pitch_px == pytest.approx(22.08, abs=0.05)
