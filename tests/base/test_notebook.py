from __future__ import annotations

import re
from xml.etree import ElementTree

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


def test_slopes_are_a_table() -> None:
    rows = ElementTree.fromstring(slopes_of(4)._repr_html_()).findall("tr")
    assert [cell.text for cell in rows[1]] == ["sub-apertures", "36"]


def test_a_layout_is_a_picture_with_a_window_each() -> None:
    figure = ElementTree.fromstring(LAYOUT._repr_html_())
    windows = figure.findall("svg/g/rect")
    assert len(windows) == 36
    row, column = LAYOUT.corners[0]
    assert windows[0].attrib["x"] == str(column)
    assert windows[0].attrib["y"] == str(LAYOUT.frame_shape[0] - row - 8)  # rows count from below
    assert "36 sub-apertures of 8 x 8 px" in str(figure.findtext("figcaption"))


def test_a_psf_is_brightest_in_its_middle() -> None:
    figure = ElementTree.fromstring(fs.PSF.analytic(size=1.2, radius_px=6.0)._repr_html_())
    pixels = figure.findall("svg/g/rect")
    brightest = max(pixels, key=lambda pixel: float(pixel.attrib["fill-opacity"]))
    side = float(figure.find("svg").attrib["viewBox"].split()[2])  # type: ignore[union-attr]
    assert float(brightest.attrib["x"]) == float(brightest.attrib["y"]) == (side - 1) / 2
