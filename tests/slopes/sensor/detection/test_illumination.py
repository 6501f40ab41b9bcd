"""Which lenslets are lit, on simulated sensors that differ in all that a finder might take for granted."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.patience import mostly_slow
from tests.refusals import refused
from tests.slopes.sensor.sensor_cases import Sensor, check_regular

from faintspot.slopes.sensor.detection.lenslets import find_lenslets

SIZES = [(4, 16, 10), (6, 24, -70), (10, 8, 3), (10, 40, 44.5), (14, 22, -17), (20, 12, 29.5), (40, 8, 61)]
WIDTHS = [(30, 5.2, 0.15), (12, 8.0, 0.2), (4, 100.0, 0.02), (4, 60.0, 0.2), (5, 33.0, 0.05)]


@pytest.mark.parametrize(
    "sensor",
    mostly_slow(
        2,
        [
            {},
            {"geometry": "hexagonal"},
            {"pitch_px": 8.0, "lenslets": 20, "width": 0.11},
            {"pitch_px": 33.3, "lenslets": 9, "inner": 0.0},
            {"spider": 0.6},
            {"geometry": "hexagonal", "spider": 0.6, "lenslets": 16},
            {"lenslets": 5, "inner": 0.0},
            {"haze_e": 500.0},
            {"width": 0.2, "haze_e": 1000.0, "flux_e": 20000.0},
            {"hot_pixels": 60},
            {"scatter": 0.5},
            {"gain_e_per_adu": 5.0, "flux_e": 5000.0},
            {"gain_e_per_adu": 10.0, "flux_e": 3000.0, "bits": 8, "offset_adu": 0.0, "background_e": 0.0},
            {"outside": 0.1},
            {"outside": 0.1, "scatter": 0.4},
            {"outside": 0.2, "lenslets": 15},
            *(
                {"geometry": geometry, "lenslets": n, "pitch_px": pitch_px, "angle_deg": angle_deg}
                | {"inner": 0.3 if n > 6 else 0.0, "width": 0.09, "flux_e": 8.0 * pitch_px**2}
                | {"hot_pixels": n**2 // 4}
                for geometry in ("square", "hexagonal")
                for n, pitch_px, angle_deg in SIZES
            ),
            *(
                {"geometry": geometry, "lenslets": n, "pitch_px": pitch_px, "width": width, "angle_deg": 4.0}
                | {"inner": 0.0, "flux_e": 3000.0 * max(width * pitch_px, 0.8), "scatter": 0.0}
                for geometry in ("square", "hexagonal")
                for n, pitch_px, width in WIDTHS
            ),
        ],
    ),
    ids=lambda sensor: ", ".join(f"{name} {value}" for name, value in sensor.items()) or "plain",
)
def test_lattice_and_pupil_are_found(sensor: dict[str, Any]) -> None:
    """One lenslet in fifty may fall either way: a dim or displaced one at the pupil's edge."""
    truth = Sensor(1, **sensor)
    grid = find_lenslets(truth.frame())
    check_regular(grid)
    assert (grid.geometry, grid.doubt) == (truth.geometry, "")
    # The spots are displaced by 0.06 pitch rms per axis. The fit's pitch has an error of
    # 0.06 / sqrt(sum |node|^2), the sum over n nodes being about n * lenslets^2 / 6 (or more). Four
    # standard errors are allowed for: less than 0.5 % from 14 lenslets on.
    count = np.count_nonzero(truth.illuminated)
    tolerance = max(4 * 0.06 * np.sqrt(6 / count) / truth.lenslets, 0.001)
    assert grid.pitch_px == pytest.approx(truth.pitch_px, rel=tolerance)
    turn = 90 if truth.geometry == "square" else 60
    turned = (grid.angle_deg - truth.angle_deg + turn / 2) % turn - turn / 2
    assert abs(np.radians(turned)) < tolerance
    # Four parameters are fitted to 2 n coordinates: rms error 0.06 * sqrt(4 / n) per node, 3 % at n = 12.
    assert np.sqrt(np.mean(truth.errors(grid) ** 2)) < max(2 * 0.06 * np.sqrt(4 / count), 0.02)
    assert max(truth.wrong(grid)) <= max(1, 0.02 * count)


@pytest.mark.parametrize("part", mostly_slow(1, [0.2, 0.25, 0.3, 0.4]))
def test_a_dim_edge_is_taken_or_left_whole(part: float) -> None:
    """Its lenslets scatter by 15 %, and the dividing flux lies where few are."""
    truth = Sensor(1, lenslets=14)
    offset = truth.nodes.real + 0.3 * truth.nodes.imag
    dim = truth.illuminated & (offset > np.quantile(offset[truth.illuminated], 0.88))
    truth.flux_e[dim] *= part
    grid = find_lenslets(truth.frame())
    found = grid.centres[:, 0] + 1j * grid.centres[:, 1]
    taken = np.count_nonzero(np.abs(truth.nodes[dim, None] - found).min(axis=1) < 0.3 * truth.pitch_px)
    count = np.count_nonzero(dim)
    assert taken <= 0.1 * count or taken >= 0.9 * count or grid.doubt
    assert taken >= 0.9 * count or part < 0.4


@pytest.mark.parametrize("seed", range(2))
def test_ghosts_are_left_out(seed: int) -> None:
    """Four as bright as spots far from the pupil, off the lattice or on it, and four dim ones anywhere."""
    truth = Sensor(seed, lenslets=12)
    rng = np.random.default_rng(100 + seed)
    edge = np.abs(truth.nodes[:, None] - truth.nodes[truth.illuminated]).min(axis=1) / truth.pitch_px
    far = rng.choice(np.flatnonzero(edge > 1.6), 4, replace=False)
    dim = rng.choice(np.flatnonzero(~truth.illuminated), 4, replace=False)
    truth.flux_e[far] = 2000.0
    truth.flux_e[dim] += 200.0
    truth.nodes[far[:2]] += 5.0
    grid = find_lenslets(truth.frame())
    missing, false = truth.wrong(grid)
    assert missing <= 1
    assert false == 0


@pytest.mark.slow
def test_faint_spots_are_doubtful() -> None:
    faint = Sensor(1, lenslets=16, flux_e=100.0)
    grid = find_lenslets(faint.frame())
    assert grid.doubt
    # 100 e- in a spot of 1.4 px over 5.4 e- of noise: 3.7 standard deviations.
    missing, false = faint.wrong(grid)
    assert missing < 0.2 * np.count_nonzero(faint.illuminated)
    assert false < 0.05 * np.count_nonzero(faint.illuminated)


@pytest.mark.slow
def test_illuminated_fraction_is_strict_and_of_the_median() -> None:
    truth = Sensor(3, lenslets=14, scatter=0.4)
    frame = truth.frame()
    flux = find_lenslets(frame).flux
    for part in (0.5, 1.0):
        chosen = find_lenslets(frame, illuminated_fraction=part).flux
        # The lattice is fitted to the lenslets that are lit, so that the flux differs a little.
        np.testing.assert_allclose(np.sort(chosen), np.sort(flux[flux >= part * np.median(flux)]), rtol=0.01)
    dim = Sensor(3, lenslets=14, outside=0.1)
    assert len(find_lenslets(dim.frame(), illuminated_fraction=0.03).flux) > 0.95 * len(dim.nodes)


def test_pupil_is_taken_as_given() -> None:
    """Lit or not, within the disk or annulus in pixels."""
    truth = Sensor(4, lenslets=12, inner=0.4)
    middle = (truth.size - 1) / 2
    grid = find_lenslets(truth.frame(), pupil=(middle + 10, middle, 100.0, 30.0))
    distance = np.hypot(truth.nodes.real - middle - 10, truth.nodes.imag - middle)
    assert abs(len(grid.cells) - np.count_nonzero((distance <= 100) & (distance >= 30))) <= 3
    radius = np.hypot(grid.centres[:, 0] - middle - 10, grid.centres[:, 1] - middle)
    assert radius.max() <= 100
    assert radius.min() >= 30
    assert grid.doubt == ""
    with refused("0 of its lenslets lie in the pupil given"):
        find_lenslets(truth.frame(), pupil=(-500, 0, 10))


def test_region_of_interest() -> None:
    """Another sensor's spots beside it, on another lattice, do not disturb."""
    first, second = Sensor(5), Sensor(6, pitch_px=13.0, lenslets=18)
    frame = np.zeros((max(first.size, second.size), first.size + second.size))
    frame += np.median(first.frame())
    frame[: second.size, : second.size] = second.frame()
    frame[: first.size, second.size :] = first.frame()
    grid = find_lenslets(frame, roi=(second.size, 0, frame.shape[1], first.size))
    first.nodes += second.size
    assert grid.pitch_px == pytest.approx(20.0, rel=0.01)
    assert max(first.wrong(grid)) <= 1


def _beam(factor: float, cut: float = np.inf) -> tuple[Sensor, NDArray[np.bool_]]:
    """Return a Gaussian beam that falls by a factor at the radius, dark beyond a cut, and its clear spots."""
    truth = Sensor(7, lenslets=14, inner=0.0, scatter=0.0, outside=1.0)
    offset = truth.nodes - (truth.size - 1) / 2 * (1 + 1j)
    truth.flux_e = 40000.0 * factor ** -((np.abs(offset) / (7 * truth.pitch_px)) ** 2)
    truth.flux_e[offset.real > cut * truth.pitch_px] = 0.0
    edge = np.minimum.reduce([truth.nodes.real, truth.nodes.imag])
    edge = np.minimum(edge, truth.size - 1 - np.maximum(truth.nodes.real, truth.nodes.imag))
    truth.illuminated = truth.flux_e > 0
    return truth, (edge > 4) & (truth.flux_e > 900.0)  # 900 e- in 1.4 px and 5.4 e- of noise: 0.06 px


@pytest.mark.parametrize("cut", mostly_slow(1, [np.inf, 3.0]))
@pytest.mark.parametrize("factor", [3.0, 30.0])
def test_every_clear_spot_of_a_beam_is_taken(factor: float, cut: float) -> None:
    truth, clear = _beam(factor, cut)
    grid = find_lenslets(truth.frame())
    found = grid.centres[:, 0] + 1j * grid.centres[:, 1]
    assert np.abs(truth.nodes[clear, None] - found).min(axis=1).max() < 0.3 * truth.pitch_px
    assert truth.wrong(grid)[1] == 0
    assert grid.doubt == ""


def test_clear_spots_below_the_illuminated_fraction_are_named() -> None:
    truth, clear = _beam(30.0)
    grid = find_lenslets(truth.frame(), illuminated_fraction=0.3)
    at = np.concatenate([grid.spots, grid.elsewhere]) @ [1, 1j]
    assert len(grid.spots) < 0.7 * np.count_nonzero(clear)
    assert np.abs(truth.nodes[clear, None] - at).min(axis=1).max() < 0.3 * truth.pitch_px


def test_dim_lenslets_at_the_edge_of_an_even_pupil_are_named() -> None:
    truth = Sensor(3, lenslets=12, flux_e=20000.0)
    edge = np.abs(truth.nodes[:, None] - truth.nodes[truth.illuminated]).min(axis=1) / truth.pitch_px
    dim = np.flatnonzero((edge > 0.5) & (edge < 1.2) & (np.abs(truth.nodes - truth.nodes.mean()) > 100))[::3]
    truth.flux_e[dim] = 1500.0
    grid = find_lenslets(truth.frame())
    assert truth.wrong(grid)[1] == 0
    elsewhere = grid.elsewhere @ [1, 1j]
    assert len(elsewhere) == len(dim)
    assert np.abs(truth.nodes[dim, None] - elsewhere).min(axis=1).max() < 0.3 * truth.pitch_px
