import gzip
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.patience import mostly_slow
from tests.refusals import refused
from tests.shared_data import shared_file
from tests.slopes.sensor.sensor_cases import Sensor, check_regular, lattice, spot_frame

from faintspot.base.errors import InputError
from faintspot.slopes.sensor.detection.lenslets import find_lenslets


@pytest.mark.parametrize("geometry", mostly_slow(1, ["square", "hexagonal"]))
def test_five_sigma_spots(geometry: str) -> None:
    # Noise of a background of 35 and 3 of read noise: 6.6; 5 of them in a Gaussian matched filter.
    flux_e = 5 * 6.6 * np.sqrt(4 * np.pi) * 1.3
    shape: dict[str, Any] = {"geometry": geometry, "lenslets": 14, "pitch_px": 22.0, "width": 1.3 / 22}
    truth = Sensor(1, **shape, flux_e=flux_e, scatter=0.0, background_e=35.0)
    grid = find_lenslets(truth.frame())
    assert grid.geometry == geometry
    assert grid.pitch_px == pytest.approx(22, rel=0.005)
    assert np.sqrt(np.mean(truth.errors(grid) ** 2)) < 0.05
    # A ratio of 5 with a standard deviation of 1 lies below the threshold of 4 in one case of six.
    missing, false = truth.wrong(grid)
    count = np.count_nonzero(truth.illuminated)
    assert missing < 0.3 * count
    assert false < 0.05 * count


def test_flux_is_that_of_the_spots() -> None:
    grid = find_lenslets(Sensor(1, flux_e=3000.0, scatter=0.0).frame())
    # 2.5 standard deviations hold 95.6 % of a Gaussian; the width is found to 25 %.
    assert np.median(grid.flux) == pytest.approx(3000.0, rel=0.15)


def test_hint_and_geometry_are_obeyed() -> None:
    frame = Sensor(5, pitch_px=16.0).frame()
    grid = find_lenslets(frame, geometry="square", pitch_px=17.5)
    assert grid.pitch_px == pytest.approx(16.0, rel=0.01)
    with pytest.raises(InputError, match="lattice"):
        find_lenslets(frame, pitch_px=5.0)


def test_cube_beats_cosmic_rays_and_bad_pixels_may_be_nan() -> None:
    truth = Sensor(6, pitch_px=16.0)
    cube = np.repeat(truth.frame()[None], 5, axis=0)
    cube[2, 40:60, 40:60] += 1e5
    bad = np.zeros(cube.shape[1:], dtype=bool)
    bad[:, 30] = True
    cube[:, bad] = np.nan
    before = cube.copy()
    grid = find_lenslets(cube, bad_pixels=bad)
    np.testing.assert_array_equal(cube, before)
    assert grid.pitch_px == pytest.approx(16.0, rel=0.01)
    assert truth.wrong(grid)[0] <= 2
    np.testing.assert_allclose(grid.flux, find_lenslets(cube[0], bad_pixels=bad).flux, rtol=1e-9)


def spots_at(positions: list[tuple[int, int]]) -> NDArray[np.float64]:
    y, x = np.mgrid[:120, :130]
    image = np.random.default_rng(3).normal(10, 1, y.shape)
    for row, column in positions:
        image += 200 * np.exp(-((y - row) ** 2 + (x - column) ** 2) / 8)
    return np.asarray(image)


@pytest.mark.parametrize(
    "image",
    mostly_slow(
        2,
        [
            spots_at([]),
            spots_at([(11, 20), (30, 100), (58, 47), (70, 113), (101, 9), (109, 76)]),
            np.full((64, 64), 7.0),
            np.zeros((64, 64), dtype=np.int16),
            np.add.outer(np.arange(64.0), np.arange(70.0)),
            np.ones(5),
            np.ones((2, 2, 20, 20)),
            np.ones((4, 40)),
            np.full((40, 40), np.nan),
        ],
    ),
    ids=["noise", "scattered spots", "flat", "zero", "gradient", *"abcd"],
)
def test_no_lattice_is_an_error_in_one_line(image: NDArray[Any]) -> None:
    with refused("frame"):
        find_lenslets(image)


@pytest.mark.parametrize(
    ("words", "options"),
    [
        ("geometry", {"geometry": "round"}),
        ("pitch_px = 2: expected 4 to", {"pitch_px": 2}),
        ("pitch_px = 40: expected 4 to 31.25", {"pitch_px": 40}),
        ("illuminated_fraction = 2", {"illuminated_fraction": 2}),
        ("bad_pixels", {"bad_pixels": np.zeros((3, 3), dtype=bool)}),
        ("bad_pixels", {"bad_pixels": np.ones((50, 60), dtype=bool)}),
        ("pupil: expected x, y, radius", {"pupil": (1, 2)}),
        ("pupil: expected radius > inner radius", {"pupil": (50, 50, 10, 20)}),
        ("pupil", {"pupil": "round"}),
        ("roi: expected x0, y0, x1, y1", {"roi": (1, 2, 3)}),
        ("roi = 10, 0, 5, 20: expected x0 < x1", {"roi": (10, 0, 5, 20)}),
        ("within the frame's 60 columns and 50 rows", {"roi": (0, 0, 61, 50)}),
        ("roi = 0.5", {"roi": (0.5, 0, 10, 10)}),
    ],
)
def test_lenslets_refuse_wrong_options(words: str, options: dict[str, Any]) -> None:
    with refused(words):
        find_lenslets(np.eye(50, 60), **options)


def bench_frames(name: str) -> NDArray[np.int16]:
    with np.load(shared_file(name)) as archive:
        return np.asarray(archive["frames"])


def fits_frame(name: str) -> NDArray[np.float64]:
    fits = pytest.importorskip("astropy.io.fits")
    with gzip.open(shared_file(name)) as file, fits.open(file) as hdus:
        return np.asarray(hdus[0].data, dtype=np.float64)


@pytest.mark.parametrize("binned", mostly_slow(1, [False, True]))
@pytest.mark.parametrize("single", [False, True])
def test_bench_frames_have_64_lenslets(binned: bool, single: bool) -> None:
    frames = bench_frames("data/ciao_bench_60x224x224.npz")
    if binned:
        frames = frames.reshape(60, 112, 2, 112, 2).sum(axis=(2, 4))
    grid = find_lenslets(frames[17] if single else frames)
    check_regular(grid)
    assert grid.geometry == "square"
    assert grid.pitch_px == pytest.approx(27.48 / (1 + binned), rel=0.002)
    # All 8 x 8; the ninth row and column are cut by the frame's edge.
    assert len(grid.cells) == 64
    assert grid.cells.max() == 7


def test_bench_edge_frames() -> None:
    grid = find_lenslets(bench_frames("data/ciao_bench_edge_60x56x224.npz"))
    assert grid.geometry == "square"
    # Partly lit lenslets have shifted spots, and the two rows are no good lever: 1 %.
    assert grid.pitch_px == pytest.approx(27.48, rel=0.01)
    # Seven lit ones above, seven partly lit ones below; the eighth column is cut by the edge.
    assert len(grid.cells) == 14
    assert "less than half" in grid.doubt
    assert grid.cells.max(axis=0).tolist() == [1, 6]


@pytest.mark.parametrize(
    ("name", "geometry", "pitch_px", "angle_deg", "illuminated"),
    mostly_slow(
        1,
        [
            ("mmirs_wfs_0150", "square", 22.08, -0.5, 157),
            ("auto_wfs_0037_ave", "square", 30.41, 0.0, 148),
            ("test_newf9", "hexagonal", 37.14, 28.5, 145),
            ("f9wfs_20200225-205600", "hexagonal", 35.02, 28.6, 143),
        ],
    ),
)
def test_telescope_frames_have_their_grid(
    name: str, geometry: str, pitch_px: float, angle_deg: float, illuminated: int
) -> None:
    grid = find_lenslets(fits_frame(f"data/{name}.fits.gz"))
    check_regular(grid)
    assert grid.geometry == geometry
    assert grid.pitch_px == pytest.approx(pitch_px, rel=0.002)
    assert grid.angle_deg == pytest.approx(angle_deg, abs=0.2)
    # Counts that this finder gave and pictures of the windows bear out; a few dim ones at the pupil's edge
    # may fall either way.
    assert abs(len(grid.cells) - illuminated) <= 4
    if geometry == "square":
        assert grid.cells[:, 1].max() == 13
    # Nothing is lit behind the central obstruction.
    middle = grid.centres.mean(axis=0)
    assert np.hypot(*(grid.centres - middle).T).min() > 1.2 * grid.pitch_px


def test_reference_frame_is_illuminated_all_over() -> None:
    """17 x 17, of which three corners of the lowest row and two beside are dark or cut."""
    grid = find_lenslets(fits_frame("data/f5_hecto_ref.fits.gz"))
    assert grid.geometry == "square"
    assert grid.pitch_px == pytest.approx(29.67, rel=0.001)
    assert 282 <= len(grid.cells) <= 287
    assert grid.cells.max(axis=0).tolist() == [16, 16]


@pytest.mark.parametrize(
    ("width_px", "photons", "seed"), mostly_slow(1, [(0.5, 8, 2), (0.6, 15, 3), (0.8, 8, 2), (0.7, 60, 1)])
)
def test_sharp_spots_on_a_clipped_background_are_not_hot(width_px: float, photons: float, seed: int) -> None:
    """Half of them look like hot pixels: most neighbours are 0. 30 real ones are as bright as spots."""
    nodes = lattice((14, 14), 17.0, (18.0, 18.0))
    shape: dict[str, Any] = {"flux_e": photons, "spread_px": 0.3, "width_px": width_px, "seed": seed}
    frame = spot_frame(nodes, (258, 258), **shape, read_noise_e=0.2, offset_adu=0.0)
    frame[tuple(np.random.default_rng(seed).integers(0, 258, (2, 30)))] += photons
    found = find_lenslets(frame.astype(np.uint16))
    assert found.doubt == ""
    assert len(found.cells) >= 195
    assert found.pitch_px == pytest.approx(17.0, rel=0.005)


@pytest.mark.parametrize("place", ["beside the pupil", "far away", "between the spots"])
def test_a_spot_that_was_taken_for_a_hot_pixel_is_listed(place: str) -> None:
    """A bright pixel at the node of a dark lenslet of the pupil's edge may be its spot, others are not."""
    frame = spot_frame(lattice((6, 6), 12.0, (20.0, 20.0))[1:], (150, 150), flux_e=4000.0)
    y, x = {"beside the pupil": (20, 20), "far away": (140, 140), "between the spots": (50, 50)}[place]
    frame[y, x] += 2000.0
    expected = [[20.0, 20.0]] if place == "beside the pupil" else []
    assert find_lenslets(frame).elsewhere.tolist() == expected
