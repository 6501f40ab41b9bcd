"""The disk of the pupil, from the flux of sub-apertures that a known disk lights in part."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot import Layout
from faintspot.slopes.sensor.pupil import Pupil, lenslet_outlines, pupil_of

SIDE = 8
OFFSETS = (np.arange(16) + 0.5) / 16 - 0.5


def lit(n: int, radius: float, centre: tuple[float, float], hole: float = 0.0) -> NDArray[np.float64]:
    """Return the share (n, n) of each lenslet's area that an annulus lights, lengths in lenslets."""
    x = (np.arange(n)[:, None] + OFFSETS).ravel() - centre[0]
    y = (np.arange(n)[:, None] + OFFSETS).ravel() - centre[1]
    away = np.hypot(x, y[:, None])
    share: NDArray[np.float64] = ((away < radius) & (away >= hole)).reshape(n, 16, n, 16).mean(axis=(1, 3))
    return share


def disk(flux: NDArray[np.float64], **sizes: Any) -> tuple[Pupil, list[float]]:
    """Return the pupil of fluxes (n, n), of which those below a tenth are flagged, and x, y, radius."""
    layout = Layout.grid(flux.shape, pixels=SIDE, **sizes)
    pupil = pupil_of(layout, (flux.ravel() < 0.1).astype(np.uint8), 500 * flux.ravel())
    x, y = (np.array(pupil.centre_px) - (SIDE - 1) / 2) / SIDE
    return pupil, [float(x), float(y), pupil.radius_subapertures]


GHOSTS: list[list[tuple[int, int, float]]] = [[], [(1, 3, 0.3)], [(0, 7, 0.12), (11, 14, 1.0)]]


@pytest.mark.parametrize("ghosts", GHOSTS)
@pytest.mark.parametrize(("radius", "centre", "hole"), [(5.5, (8.5, 8.0), 1.6), (5.2, (8.3, 7.8), 0.0)])
def test_single_lenslets_do_not_set_the_disk(
    radius: float, centre: tuple[float, float], hole: float, ghosts: list[tuple[int, int, float]]
) -> None:
    """To 3 %: 34 lenslets at the edge, whose area in the disk is taken as linear in the distance."""
    flux = lit(15, radius, centre, hole) * np.random.default_rng(1).normal(1.0, 0.05, (15, 15))
    for x, y, share in ghosts:
        assert flux[y, x] == 0
        flux[y, x] = share
    pupil, found = disk(flux)
    np.testing.assert_allclose(found, [*centre, radius], atol=0.03 * radius)
    assert abs(pupil.radius_subapertures - radius) < 4 * pupil.error_subapertures


@pytest.mark.parametrize("n", [3, 8, 40])
def test_of_a_square_array_it_is_the_largest_circle_inside(n: int) -> None:
    assert disk(np.ones((n, n)))[1] == [(n - 1) / 2, (n - 1) / 2, n / 2]


def test_whole_lenslets_are_not_cut() -> None:
    """Also with a spot of 3 % beside the pupil, three columns from it."""
    flux = np.zeros((15, 15))
    y, x = np.mgrid[:15, :15]
    flux[np.hypot(x - 8.5, y - 8.0) < 5.5] = 1.0
    flux[8, 0] = 0.15
    pupil, found = disk(flux)
    assert found == [8.5, 8.0, 5.5]
    assert pupil.part
    assert not pupil.cuts


def test_a_stated_size_stands() -> None:
    pupil, found = disk(lit(15, 5.4, (7.2, 7.0)), subaperture_m=0.5, diameter_m=5.5)
    np.testing.assert_allclose(found, [7.2, 7.0, 5.5], atol=0.1)
    assert pupil.cuts
    assert pupil.error_subapertures == 0


@pytest.mark.parametrize(("geometry", "turn_deg"), [("square", 90.0), ("hexagonal", 60.0)])
def test_neighbours_share_a_side_half_way_between_them(geometry: str, turn_deg: float) -> None:
    """Lattices turned by 7 degrees: its sides are perpendicular to the lines to the neighbours."""
    turns = np.radians(7.0 + turn_deg * np.arange(round(360 / turn_deg)))
    directions = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    centres = np.vstack([[20.0, 20.0], 20.0 + 10.0 * directions])
    layout = Layout(
        (40, 40),
        (6, 6),
        np.rint(centres[:, ::-1] - 2.5),
        centres,
        geometry=geometry,
        pitch_px=10.0,
        angle_deg=7.0,
    )
    middle = lenslet_outlines(layout)[0] - 20.0
    along = np.sort(middle @ directions.T, axis=0)
    np.testing.assert_allclose(along[-2:], 5.0, atol=1e-9)
