"""Grids whose place is known: windows, and which cells are illuminated."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.simulated import frames_of

from faintspot import Layout
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.found_layout import find_illuminated
from faintspot.slopes.simulate import Detector

PUPIL = Layout.grid((10, 12), pixels=2, outer_radius=5.2, inner_radius=1.2)


def frame(layout: Layout = PUPIL, flux_e: float = 200.0, n: int = 30, offset: float = 0.0) -> NDArray[Any]:
    frames, _ = frames_of(
        layout,
        n,
        flux_e=flux_e,
        position_range_px=0.3,
        detector=Detector(read_noise_e=3.0, offset_adu=offset),
        rng=np.random.default_rng(1),
    )
    return np.asarray(frames.mean(axis=0, dtype=float))


@pytest.mark.parametrize(("offset", "has_dark"), [(0.0, True), (0.0, False), (1000.0, False)])
@pytest.mark.parametrize("flux_e", [20.0, 2000.0])
def test_illuminated_quad_cells(offset: float, has_dark: bool, flux_e: float) -> None:
    found = find_illuminated(frame(flux_e=flux_e, offset=offset), (10, 12), has_dark=has_dark)
    assert found.layout.corners.tolist() == PUPIL.corners.tolist()
    assert found.layout.cells.tolist() == PUPIL.cells.tolist()
    assert found.layout.window == (2, 2)
    assert np.median(found.unlit) == pytest.approx(offset, abs=0.5)
    assert found.doubt == ""


def test_all_cells_are_illuminated_where_none_is_clearly_dark() -> None:
    whole = Layout.grid((6, 6), pixels=2)
    for has_dark, doubtful in ((False, True), (True, False)):
        found = find_illuminated(frame(whole), (6, 6), has_dark=has_dark)
        assert len(found.layout) == 36
        assert bool(found.doubt) == doubtful


@pytest.mark.parametrize("n", [2, 4, 7, 20])
def test_illuminated_cells_are_not_taken_for_dark_ones(n: int) -> None:
    """Flux that scatters by 0.4, as scintillation makes it."""
    for seed in range(20):
        flux = np.exp(0.4 * np.random.default_rng(seed).normal(size=(n, n)))
        found = find_illuminated(np.kron(500 + flux, np.ones((2, 2))), (n, n))
        assert len(found.layout) == n * n
        assert found.doubt


def test_noise_is_said() -> None:
    noise = np.random.default_rng(1).normal(size=(20, 20))
    assert find_illuminated(noise, (10, 10), has_dark=True).doubt


def test_windows_in_the_middle_of_cells_of_a_region() -> None:
    image = np.zeros((50, 60))
    image[5:45, 10:50] = 100.0
    found = find_illuminated(image, (10, 10), pixels=2, has_dark=True, roi=(10, 5, 50, 45))
    assert len(found.layout) == 100
    assert found.layout.corners[0].tolist() == [6, 11]
    assert found.layout.corners[-1].tolist() == [42, 47]
    assert found.layout.pitch_px == 4.0
    assert not found.layout.offsets.any()


def test_pitch_that_is_not_a_whole_number() -> None:
    found = find_illuminated(np.ones((41, 45)), (6, 7), has_dark=True)
    assert found.layout.window == (6, 6)
    assert len(found.layout) == 42
    assert np.abs(found.layout.offsets).max() <= 0.5
    assert found.layout.corners.max(axis=0).tolist() == [35, 39]


def test_a_pupil_decides_whatever_the_flux() -> None:
    found = find_illuminated(np.zeros((20, 20)), (10, 10), pupil=(9.5, 9.5, 4.0))
    assert sorted(map(tuple, found.layout.cells.tolist())) == [
        (row, column)
        for row in range(10)
        for column in range(10)
        if np.hypot(2 * row - 9, 2 * column - 9) <= 4
    ]


def test_the_fraction_decides() -> None:
    image = np.kron(np.array([[0.0, 1.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.1, 1.0]]), np.ones((2, 2)))
    for fraction, count in ((0.05, 6), (0.3, 5), (0.6, 4)):
        assert (
            len(find_illuminated(image, (3, 3), has_dark=True, illuminated_fraction=fraction).layout) == count
        )


@pytest.mark.parametrize(
    ("image", "shape", "options", "naming"),
    [
        (np.ones((20, 20)), (12, 10), {}, "cells of at least"),
        (np.ones((20, 20)), (10, 10), {"pixels": 3}, "within a cell"),
        (np.zeros((20, 20)), (10, 10), {"has_dark": True}, "no cell is illuminated"),
        (
            np.ones((20, 20)),
            (10, 10),
            {"illuminated_fraction": 2.0, "has_dark": True},
            "illuminated_fraction",
        ),
        (np.ones((20, 20)), (10, 10), {"roi": (0, 0, 30, 20)}, "roi"),
    ],
)
def test_refused(image: NDArray[Any], shape: tuple[int, int], options: dict[str, Any], naming: str) -> None:
    with pytest.raises(InputError, match=naming):
        find_illuminated(image, shape, **options)
