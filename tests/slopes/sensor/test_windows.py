"""Windows lie on the spots, do not overlap, and are as large as a pitch of whole pixels allows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.patience import mostly_slow
from tests.refusals import refused
from tests.slopes.sensor.sensor_cases import lattice, spot_frame

import faintspot as fs
from faintspot.slopes.sensor import windows
from faintspot.slopes.sensor.found_layout import find_layout


@pytest.mark.parametrize("seed", mostly_slow(1, range(4)))
def test_windows_stay_on_their_spots_at_the_edge(seed: int) -> None:
    """The first column's windows do not fit: they are left out, the others are where they were."""
    at = lattice((7, 7), 20.0, (6.0, 12.0))
    frame = spot_frame(at, (144, 140), flux_e=5000.0, spread_px=0.5, seed=seed)
    found = find_layout(frame)
    assert len(found.layout) == 42
    assert len(found.cut) == 7
    assert found.cut[:, 0] == pytest.approx(6.0, abs=0.5)
    # Rounding to whole pixels moves a window by half a pixel at most.
    assert np.abs(found.layout.offsets).max() <= 0.51 + windows._SPREAD_PX
    moved = fs.Layout.from_frame(frame, move_windows=True)
    assert len(moved) == 49
    assert np.median(moved.offsets[:, 0]) == pytest.approx(-3.5, abs=0.6)


@pytest.mark.parametrize("pitch_px", mostly_slow(1, [16.0, 19.99, 12.005]))
@pytest.mark.parametrize("seed", mostly_slow(1, range(2)))
def test_a_pitch_of_whole_pixels_gives_windows_of_that_many(pitch_px: float, seed: int) -> None:
    # Single spots 0.28 and 0.34 pitches from their nodes were followed, with smaller windows.
    start = np.random.default_rng(seed).uniform(14, 16, 2)
    at = lattice((10, 10), pitch_px, (start[0], start[1]))
    frame = spot_frame(at, (240, 240), flux_e=3000.0, spread_px=0.06 * pitch_px, seed=seed)
    layout = fs.Layout.from_frame(frame)
    assert layout.window == (round(pitch_px), round(pitch_px))
    assert len(layout) >= 98
    assert np.abs(layout.offsets).max() <= 0.51 + windows._SPREAD_PX
    assert fs.Layout.from_frame(frame, pixels=round(pitch_px)) == layout


@given(
    st.floats(6, 40),
    st.floats(-45, 45),
    st.integers(2, 9),
    st.sampled_from(["square", "hexagonal"]),
    st.data(),
)
def test_windows_of_any_lattice_do_not_overlap(
    pitch: float, angle: float, count: int, kind: str, data: st.DataObject
) -> None:
    row, column = np.indices((count, count)).reshape(2, -1)
    ratio = 1j if kind == "square" else np.exp(1j * np.pi / 3)
    at = pitch * np.exp(1j * np.radians(angle)) * (column + row * ratio)
    middles = np.stack([at.imag, at.real], axis=1) + data.draw(st.floats(0, 1)) + 1000
    side = windows._largest_window(middles, pitch)
    spread = windows._spread(middles, side)
    assert np.abs(spread - middles).max() <= windows._SPREAD_PX + 1e-6
    assert pitch / np.sqrt(2) - 1 < side[0] <= pitch + 1
    corners = np.floor(spread - 0.5 * (np.array(side) - 1) + 0.5).astype(int)
    if side[0] <= 64 and side[0] >= 4:
        fs.Layout((2000, 2000), side, corners)


def test_a_window_may_be_oblong() -> None:
    frame = spot_frame(lattice((6, 6), 20.0, (20.0, 20.0)), (140, 140), flux_e=5000.0)
    layout = fs.Layout.from_frame(frame, pixels=(10, 18))
    assert layout.window == (10, 18)
    assert np.abs(layout.offsets).max() <= 0.51


def test_no_window_fits() -> None:
    frame = spot_frame(lattice((5, 5), 10.0, (9.0, 9.0)), (58, 58), flux_e=5000.0)
    with refused("the windows of all 25 lenslets found leave the frame", "pixels < 60"):
        fs.Layout.from_frame(frame, pixels=60)
