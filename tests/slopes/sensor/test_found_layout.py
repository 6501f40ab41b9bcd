"""Layouts of frames whose spots an aberration moves far from their lattice, and what is said of the rest."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.patience import mostly_slow
from tests.slopes.sensor.sensor_cases import RATIOS, spot_frame

import faintspot as fs
from faintspot import Layout
from faintspot.slopes.sensor.found_layout import find_illuminated, find_layout
from faintspot.slopes.simulate import Detector, sensor_frames


@dataclass(frozen=True)
class Comatic:
    """An annular pupil whose spots coma moves by `coma` pitches across it, and turbulence by 0.05."""

    frame: NDArray[np.float64]
    nodes: NDArray[np.complex128]
    spots: NDArray[np.complex128]


def comatic(coma: float, *, geometry: str = "square", seed: int = 0) -> Comatic:
    rng, pitch_px, lenslets = np.random.default_rng(seed), 20.0, 12
    size = int((lenslets + 3) * pitch_px)
    count = np.arange(-2 * lenslets, 2 * lenslets + 1)
    cells = (count + count[:, None] * RATIOS[geometry]).ravel() + complex(*rng.uniform(-0.5, 0.5, 2))
    away = cells * np.exp(1j * rng.uniform(-0.3, 0.3)) / (lenslets / 2)
    away = away[(np.abs(away) < 1) & (np.abs(away) > 0.3)]
    nodes = (1 + 1j) * (size - 1) / 2 + away * pitch_px * lenslets / 2
    axis = np.exp(1j * rng.uniform(0, 2 * np.pi))
    x, y = (away / axis).real, (away / axis).imag
    # The gradient of r^3 sin(theta).
    moves = coma / 9 * (6 * x * y + 1j * (3 * x**2 + 9 * y**2)) * axis
    moves += 0.05 * (rng.standard_normal(len(away)) + 1j * rng.standard_normal(len(away)))
    spots = nodes + pitch_px * moves
    flux_e = 4000 * np.exp(0.15 * rng.standard_normal(len(spots)))
    frame = spot_frame(spots, (size, size), flux_e=flux_e, width_px=1.4, seed=seed, background_e=20.0)
    return Comatic(frame, nodes, spots)


def inside(layout: fs.Layout, spots: NDArray[np.complex128]) -> NDArray[np.bool_]:
    """Return (n_spots, n_windows): which spots lie in which windows."""
    first = layout.corners[:, ::-1] - 0.5
    at = np.column_stack([spots.real, spots.imag])[:, None]
    return np.asarray(((at > first) & (at < first + np.array(layout.window[::-1]))).all(axis=-1))


@pytest.mark.parametrize("geometry", ["square", "hexagonal"])
@pytest.mark.parametrize(("coma", "seed"), mostly_slow(1, [(0.6, 0), (1.0, 1), (1.4, 2), (1.4, 3)]))
def test_windows_follow_spots_that_coma_moves(geometry: str, coma: float, seed: int) -> None:
    """Every spot lies in the window of its own lenslet, and is measured from that lenslet's node."""
    truth = comatic(coma, geometry=geometry, seed=seed)
    found = find_layout(truth.frame)
    assert len(found.layout) == len(truth.nodes)
    held = inside(found.layout, truth.spots)
    assert held.any(axis=1).all()
    centres = found.layout.centres[held.argmax(axis=1)] @ [1, 1j]
    # One lattice for all: coma has a mean, and is not quite even over the pupil.
    error = centres - truth.nodes
    assert np.abs(error - error.mean()).max() < 0.2 * 20.0
    assert len(found.outside) == 0
    # Half the pitch is left for a window where coma brings neighbours together: 3 of them on an Intel
    # processor (hexagonal, 1.4).
    assert np.count_nonzero(found.clipped | found.unlike) <= 3
    slopes = fs.SlopePipeline(found.layout, fs.Settings("brightest", keep_brightest=20))(truth.frame)
    measured = centres + (np.column_stack([slopes.x, slopes.y]) @ [1, 1j])[held.argmax(axis=1)]
    assert np.abs(measured - truth.spots).max() < 0.5


def test_an_even_frame_has_windows_on_its_lattice() -> None:
    found = find_layout(comatic(0.0).frame)
    assert not found.lenslets.drifts.any()
    assert len(found.outside) == 0
    assert not (found.clipped | found.unlike).any()


def test_bright_spots_outside_all_windows_are_named() -> None:
    """Two ghosts far from the pupil are; a cosmic ray of one sharp track and a faint ghost are not."""
    truth = comatic(0.0, seed=3)
    ghosts = np.array([14.0 + 17.0j, 270.0 + 21.0j])
    flux_e = np.concatenate([np.full(len(truth.spots), 4000.0), [4000.0, 4000.0, 100.0]])
    at = np.concatenate([truth.spots, ghosts, [20 + 280j]])
    frame = spot_frame(at, truth.frame.shape, flux_e=flux_e, width_px=1.4)
    frame[275:277, 275:277] += 1500.0
    found = find_layout(frame)
    assert np.sort(found.outside @ [1, 1j]) == pytest.approx(ghosts, abs=0.5)
    assert len(find_layout(frame, pixels=12).outside) == 2


def test_spots_at_their_window_s_edge_and_unlike_their_neighbours_are_doubtful() -> None:
    truth = comatic(0.0, seed=4)
    inner = int(np.argmin(np.abs(np.abs(truth.nodes - truth.nodes.mean()) - 90)))
    truth.spots[inner] = truth.nodes[inner] + 6.0
    frame = spot_frame(truth.spots, truth.frame.shape, flux_e=4000.0, width_px=1.4)
    found = find_layout(frame)
    moved = np.argmin(np.abs(found.layout.centres @ [1, 1j] - truth.nodes[inner]))
    assert np.flatnonzero(found.unlike).tolist() == [moved]
    assert not found.clipped.any()
    narrow = find_layout(frame, pixels=11)
    assert narrow.clipped[moved]
    assert not narrow[np.arange(len(narrow.layout)) != moved].unlike.any()


@pytest.mark.parametrize("place", mostly_slow(1, ["inside", "at the edge", "beside another ghost"]))
def test_a_ghost_in_a_dark_lenslet_is_not_taken_for_its_spot(place: str) -> None:
    """It has a sixth of the flux of the spots around it, a tenth of a pitch off the node."""
    truth = comatic(0.0, seed=4)
    away = np.abs(truth.nodes - truth.nodes.mean())
    ghosts = [int(np.argmax(away)) if place == "at the edge" else int(np.argmin(np.abs(away - 90)))]
    if place == "beside another ghost":
        ghosts.append(int(np.argsort(np.abs(truth.nodes - truth.nodes[ghosts[0]]))[1]))
    truth.spots[ghosts] = truth.nodes[ghosts] + 2.0
    flux_e = np.where(np.isin(np.arange(len(truth.spots)), ghosts), 4000.0 / 6, 4000.0)
    found = find_layout(spot_frame(truth.spots, truth.frame.shape, flux_e=flux_e, width_px=1.4))
    near = np.abs(found.layout.centres @ [[1], [1j]] - truth.nodes[ghosts]).min(axis=1) < 5.0
    assert (found.unlike == near).all()


def structured(kind: str, geometry: str, seed: int) -> tuple[NDArray[np.float64], int]:
    """Return a frame of lenslets 25.6 px apart, each with the same several peaks, and their number."""
    rng = np.random.default_rng(seed)
    size, pitch_px = 380, 25.6
    count = np.arange(-30, 31)
    turn = np.exp(1j * rng.uniform(-0.07, 0.07))
    nodes = (1 + 1j) * size / 2 + pitch_px * turn * (count + count[:, None] * RATIOS[geometry]).ravel()
    nodes = nodes[np.abs(nodes - (1 + 1j) * size / 2) < 0.42 * size]
    # 3 x 3 peaks on the lattice that has 13 nodes a cell, or peaks anywhere.
    grid = (np.arange(-1, 2) + 1j * np.arange(-1, 2)[:, None]).ravel() * pitch_px / (3 + 2j) * turn
    radius, angle = np.sqrt(rng.uniform(0, 0.1, 6)), rng.uniform(0, 2 * np.pi, 6)
    peaks = grid if kind == "grid" else pitch_px * radius * np.exp(1j * angle)
    moved = nodes + 0.03 * pitch_px * (rng.standard_normal(len(nodes)) + 1j * rng.standard_normal(len(nodes)))
    at = (moved[:, None] + peaks - peaks.mean()).ravel()
    return spot_frame(at, (size, size), flux_e=900.0, width_px=1.0, background_e=30.0, seed=seed), len(nodes)


@pytest.mark.slow
@pytest.mark.parametrize("geometry", ["square", "hexagonal"])
@pytest.mark.parametrize("kind", ["grid", "anywhere"])
def test_the_lattice_is_not_that_of_the_structure_in_the_spots(kind: str, geometry: str) -> None:
    frame, count = structured(kind, geometry, 0)
    grid = find_layout(frame).lenslets
    assert grid.geometry == geometry
    assert grid.pitch_px == pytest.approx(25.6, rel=0.02)
    assert abs(len(grid.cells) - count) <= 0.15 * count or grid.doubt


def test_lit_spots_in_no_sub_aperture_are_counted() -> None:
    """Two ghosts and the lenslets at the edge of the frame."""
    truth = comatic(0.0, seed=3)
    at = np.append(truth.spots, [14.0 + 17.0j, 270.0 + 21.0j])
    frame = spot_frame(at, truth.frame.shape, flux_e=4000.0, width_px=1.4)
    assert fs.Layout.from_frame(frame).spots_left_out == 2
    cut = find_layout(frame[:, :-30])
    assert cut.layout.spots_left_out == 2 + len(cut.cut) > 2


PUPIL = Layout.grid((10, 12), pixels=2, outer_radius=5.2, inner_radius=1.2)


def frame(layout: Layout = PUPIL, flux_e: float = 200.0, n: int = 30, offset: float = 0.0) -> NDArray[Any]:
    frames, _ = sensor_frames(
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
    inside = np.hypot(*(2 * np.indices((10, 10)) - 9)) <= 4
    assert found.layout.cells.tolist() == np.argwhere(inside).tolist()


def test_the_fraction_decides() -> None:
    image = np.kron(np.array([[0.0, 1.0, 1.0], [0.0, 0.5, 1.0], [0.0, 0.1, 1.0]]), np.ones((2, 2)))
    for fraction, count in ((0.05, 6), (0.3, 5), (0.6, 4)):
        found = find_illuminated(image, (3, 3), has_dark=True, illuminated_fraction=fraction)
        assert len(found.layout) == count
