"""Slopes of frames say what they are."""

import re

import numpy as np

import faintspot as fs

LAYOUT = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, inner_radius=0.5)


def slopes_of(*shape: int) -> fs.Slopes:
    frames = np.random.default_rng(1).poisson(20.0, (*shape, *LAYOUT.frame_shape)).astype(np.float32)
    return fs.SlopePipeline(LAYOUT, fs.Settings("brightest", keep_brightest=9))(frames)


def test_slopes_say_what_they_are_in_one_line() -> None:
    expected = r"frames 1, sub-apertures 36, valid 100 %, rms of x, y [\d.]+, [\d.]+ px, median flux \d+ e-"
    assert re.fullmatch(rf"Slopes\({expected}\)", repr(slopes_of()))
    assert "frames 4" in repr(slopes_of(4))
    dark = fs.SlopePipeline(LAYOUT, fs.Settings("brightest"))(np.zeros(LAYOUT.frame_shape, np.float32))
    assert repr(dark) == "Slopes(frames 1, sub-apertures 36, valid 0 %)"
