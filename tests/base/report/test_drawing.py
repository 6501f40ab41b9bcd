"""Drawing: places of sub-apertures, limits of colours, files."""

import sys

import numpy as np
import pytest

from faintspot.base.errors import MissingExtraError
from faintspot.base.report.plots import limits_of, new_figure, plain_ticks, png, svg
from faintspot.slopes.sensor.drawing import subaperture_shapes
from faintspot.slopes.sensor.layout import Layout


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
        "slopes.recorded.layout_picture",
        "slopes.recorded.report.pictures",
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
