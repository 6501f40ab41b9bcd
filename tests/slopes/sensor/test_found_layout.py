"""Layouts of frames whose spots an aberration moves far from their lattice, and what is said of the rest."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.slopes.sensor.sensor_cases import spot_frame

import faintspot as fs
from faintspot.slopes.sensor.found_layout import find_layout

RATIOS = {"square": 1j, "hexagonal": np.exp(1j * np.pi / 3)}


@dataclass(frozen=True)
class Comatic:
    """An annular pupil whose spots coma moves by `coma` pitches across it, and turbulence by 0.05."""

    frame: NDArray[np.float64]
    nodes: NDArray[np.complex128]
    spots: NDArray[np.complex128]


def comatic(
    coma: float, *, geometry: str = "square", seed: int = 0, pitch_px: float = 20.0, lenslets: int = 12
) -> Comatic:
    rng = np.random.default_rng(seed)
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
@pytest.mark.parametrize(("coma", "seed"), [(0.6, 0), (1.0, 1), (1.4, 2), (1.4, 3)])
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


@pytest.mark.parametrize("place", ["inside", "at the edge", "beside another ghost"])
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
