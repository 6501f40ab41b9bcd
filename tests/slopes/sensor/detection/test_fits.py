"""The lattice chosen is that of the spots, not one that is coarser, finer or of another geometry."""

import numpy as np
import pytest
from benchmarks.frames.layouts import verdict
from benchmarks.frames.simulated_arrays import aberrated_array, plain_small, random_array
from numpy.typing import NDArray
from tests.patience import mostly_slow
from tests.slopes.sensor.sensor_cases import spot_frame

from faintspot.base.errors import DoubtWarning, InputError
from faintspot.slopes.sensor.detection.lenslets import find_lenslets
from faintspot.slopes.sensor.layout import Layout

PLAIN = plain_small()


@pytest.mark.parametrize(
    "index",
    [1, 31, 52, 75, 83, 112, 155],
    ids=["5 x 5", "round", "annulus", "7 x 7", "jitter", "12 spots", "even 7 x 7"],
)
def test_plain_small_arrays_are_found(index: int) -> None:
    """They came out with 2 or 1.4 times the pitch, with a spot missing, or were refused."""
    assert verdict(PLAIN[index]) == ("right", "")


def nodes(across: int, pitch_px: float, angle_deg: float = 4.0) -> NDArray[np.complex128]:
    """Return a disk of nodes about 0."""
    count = np.arange(-across, across + 1)
    cells = (count + 1j * count[:, None]).ravel() + 0.2 + 0.1j
    return np.asarray(pitch_px * np.exp(1j * np.radians(angle_deg)) * cells[np.abs(cells) < across / 2])


@pytest.mark.slow
@pytest.mark.parametrize("part", [0.3, 0.5])
def test_spots_between_the_lenslets_make_a_lattice_doubtful(part: float) -> None:
    """As many fill a part of the lattice that is finer by 1.4."""
    rng = np.random.default_rng(1)
    at = nodes(12, 20.0) + 150 * (1 + 1j)
    between = at[rng.random(len(at)) < part] + 10 * (1 + 1j) * np.exp(1j * np.radians(4.0))
    frame = spot_frame(np.concatenate([at, between]), (300, 300), flux_e=4000.0, width_px=1.4)
    doubt = find_lenslets(frame).doubt
    assert "only a part of the flux" in doubt
    with pytest.warns(DoubtWarning):
        layout = Layout.from_frame(frame)
    assert layout.doubts == (doubt,)


@pytest.mark.parametrize("seed", mostly_slow(1, range(4)))
def test_a_few_spots_anywhere_are_no_lattice(seed: int) -> None:
    """One pair of spots in each direction may be a coincidence."""
    at = np.random.default_rng(seed).uniform(10, 120, (6, 2)) @ np.array([1, 1j])
    frame = spot_frame(at, (130, 130), flux_e=5000.0, width_px=2.0)
    with pytest.raises(InputError, match=r"^frame: (found no|.* expected at least two rows)"):
        find_lenslets(frame)


@pytest.mark.parametrize("index", mostly_slow(1, range(6)))
def test_random_arrays_are_right_or_doubtful(index: int) -> None:
    assert verdict(random_array(99, index))[0] != "WRONG"


@pytest.mark.parametrize(
    ("seed", "index"), mostly_slow(1, [(1, 35), (2, 10), (2, 62), (2, 113), (3, 38), (4, 129)])
)
def test_smooth_aberrations_of_few_lenslets_are_right_or_doubtful(seed: int, index: int) -> None:
    """Displacements of up to half a pitch, whose pitch or number of lenslets was wrong without a doubt."""
    assert verdict(aberrated_array(seed, index))[0] != "WRONG"


@pytest.mark.parametrize("index", mostly_slow(1, range(4, 8)))
def test_most_aberrated_arrays_are_right(index: int) -> None:
    assert verdict(aberrated_array(5, index))[0] == "right"


@pytest.mark.parametrize(("bend", "doubtful"), [(0.02, False), (0.5, True)])
def test_few_lenslets_do_not_tell_the_pitch_under_aberrations(bend: float, doubtful: bool) -> None:
    """Coma of half a pitch at the edge of 5 x 5 lenslets."""
    at = nodes(5, 20.0, angle_deg=0.0)
    away = at / np.abs(at).max()
    coma = 2 * away * away.real + np.abs(away) ** 2
    at = at + bend * 20.0 / 2 * coma + 60 * (1 + 1j)
    frame = spot_frame(at, (120, 120), flux_e=4000.0, width_px=1.6)
    assert bool(find_lenslets(frame).doubt) == doubtful


def test_bright_spots_at_no_node_of_many_lenslets_are_doubtful() -> None:
    at = nodes(15, 12.0) + 100 * (1 + 1j)
    at[[40, 60, 80, 100]] += 6 * (1 + 1j) * np.exp(1j * np.radians(4.0))
    grid = find_lenslets(spot_frame(at, (200, 200), flux_e=4000.0, width_px=1.3))
    assert len(grid.elsewhere) == 4
    assert grid.doubt
