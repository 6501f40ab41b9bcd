"""faintspot layout: from a frame to a configuration that faintspot slopes accepts, and a picture."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.cli.cli_cases import Commands
from tests.patience import mostly_slow
from tests.shared_data import shared_file
from tests.slopes.sensor.sensor_cases import spot_frame

from faintspot import Calibration, Layout, Settings
from faintspot.base.errors import DoubtWarning
from faintspot.io import read_slopes
from faintspot.slopes.simulate import Detector

pytest.importorskip("matplotlib")

SHAPE = (150, 160)
OFFSET_ADU = 100.0


def lattice(geometry: str) -> NDArray[np.float64]:
    """Return x, y of 7 x 7 spots, 20 px apart, within SHAPE."""
    rows, columns = (axis.ravel() for axis in np.mgrid[:7, :7])
    if geometry == "square":
        return np.stack([18.3 + 20 * columns, 14.6 + 20 * rows], axis=1)
    return np.stack([13.3 + 20 * columns + 10 * (rows % 2), 22.6 + 20 * np.sqrt(0.75) * rows], axis=1)


def frames(geometry: str = "square", n_frames: int = 3) -> NDArray[np.float64]:
    """Frames with spots of 2000 e- at the lattice points, 3 e- of read noise, an offset of 100 ADU."""
    nodes = lattice(geometry) @ [1, 1j]
    return np.stack([spot_frame(nodes, SHAPE, flux_e=2000.0, seed=seed) for seed in range(n_frames)])


DOUBTS = pytest.mark.filterwarnings("ignore::faintspot.base.errors.DoubtWarning")


def is_png(path: Path) -> bool:
    content = path.read_bytes()
    return content.startswith(b"\x89PNG\r\n") and len(content) > 5000


@pytest.mark.slow
@pytest.mark.parametrize("geometry", ["square", "hexagonal"])
def test_simulated_frames_give_their_lattice(folder: Path, run: Commands, geometry: str) -> None:
    """Lattice points within 0.2 px: 3 frames of 49 spots leave 0.01 px, the fit of a common grid less."""
    np.save("a.npy", frames(geometry))
    result = run.ok("layout", "a.npy", "-o", "new.toml", "--dark", "100", "--pixels", 16)
    assert result.err == ""
    layout = Layout.load("new.toml")
    assert layout.geometry == geometry
    assert len(layout) == 49
    assert layout.pitch_px == pytest.approx(20.0, abs=0.1)
    distances = np.hypot(*(layout.centres[:, None] - lattice(geometry)[None]).transpose(2, 0, 1))
    assert np.sort(distances.min(axis=1))[-1] < 0.2
    assert is_png(folder / "new.png")
    *_, picture, following = result.out.splitlines()
    assert picture == "  picture: new.png"
    assert following == "Next: faintspot slopes a.npy --config new.toml -o slopes.zarr"
    run.ok(*following.removeprefix("Next: faintspot ").split())
    stored = read_slopes("slopes.zarr")
    assert stored.variables["valid"].all()
    # Brightest pixels of 2000 e- at 3 e-: far below 0.2 px a slope.
    assert np.abs(stored.variables["x"]).mean() < 0.2


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_slopes_do_not_depend_on_the_unit_of_the_frames(folder: Path, run: Commands) -> None:
    found, settings = [], []
    for name, scale in (("small", 1e-4), ("large", 1e4)):
        np.save(f"{name}.npy", (scale * frames()).astype(np.float32))
        run.ok("layout", f"{name}.npy", "-o", f"{name}.toml", "--pixels", 16)
        run.ok("slopes", f"{name}.npy", "-c", f"{name}.toml", "-o", f"{name}.npz")
        stored = read_slopes(f"{name}.npz").variables
        assert stored["valid"].all()
        found.append(np.stack([stored["x"], stored["y"]]))
        settings.append(Settings.load(f"{name}.toml"))
    np.testing.assert_allclose(found[0], found[1], atol=1e-4)
    assert settings[0] == settings[1]


@pytest.mark.usefixtures("no_trials", "coarse_pictures")
def test_options_are_used_or_refused(folder: Path, run: Commands) -> None:
    np.savez("a b.npz", night=frames(), day=frames())
    result = run.ok(
        *("layout", "a b.npz", "--key", "night", "-o", "new.toml", "--picture", "p.png"),
        *("--pitch-px", "20.5", "--pixels", "12", "--geometry", "square"),
    )
    assert Layout.load("new.toml").window == (12, 12)
    assert is_png(folder / "p.png")
    assert not (folder / "new.png").exists()
    assert "slopes 'a b.npz' --key night --config" in result.out


@pytest.mark.usefixtures("only_found")
def test_exists_already_and_overwrite_keeps_calibration_and_scales(folder: Path, run: Commands) -> None:
    np.save("a.npy", frames())
    scales = ("--pixel-scale-arcsec", 0.4, "--subaperture-m", 0.6, "--diameter-m", 4.2)
    run.ok("layout", "a.npy", "-o", "new.toml", "--dark", "100", "--gain-e-per-adu", "2", *scales)
    before = (folder / "new.toml").read_bytes()
    run.refused("layout", "a.npy", "-o", "new.toml", naming=("new.toml", "--overwrite"))
    assert (folder / "new.toml").read_bytes() == before
    changed = ("--pixels", "10", "--dark", "90", "--pixel-scale-arcsec", 0.5)
    run.ok("layout", "a.npy", "-o", "new.toml", "--overwrite", *changed)
    layout = Layout.load("new.toml")
    assert layout.window == (10, 10)
    assert (layout.pixel_scale_arcsec, layout.subaperture_m, layout.diameter_m) == (0.5, 0.6, 4.2)
    calibration = Calibration.load("new.toml")
    assert calibration.dark_is_known
    kept = replace(calibration, read_noise_e=None, estimated=())
    assert kept == Calibration(dark=90.0, gain_e_per_adu=2.0)


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_dark_frames_give_the_noise_of_each_pixel(folder: Path, run: Commands) -> None:
    """Variances of 40 darks are known to 23 %; bad pixels that are known stay, those that blink join them."""
    noise = np.random.default_rng(3).lognormal(1.0, 0.5, SHAPE)
    blinking = [(20, 30, 60.0)]
    camera = Detector(noise, offset_adu=100.0, gain_e_per_adu=2.0, blinking_pixels=blinking)
    np.save("a.npy", frames())
    np.save("darks.npy", camera.expose(np.zeros((40, *SHAPE)), np.random.default_rng(4)))
    np.save("list.npy", [[3, 5]])
    options = ("--dark", "darks.npy", "--gain-e-per-adu", 2, "--pixels", 16, "--bad-pixels", "list.npy")
    output = run.ok("layout", "a.npy", "-o", "new.toml", *options)
    assert "read noise of each pixel" in output.out
    calibration = Calibration.load("new.toml")
    assert [20, 30] in np.asarray(calibration.bad_pixels).tolist()
    assert [3, 5] in np.asarray(calibration.bad_pixels).tolist()
    ratio = np.delete(np.asarray(calibration.read_noise_e) / noise, 20 * SHAPE[1] + 30)
    assert np.sqrt(np.mean(np.log(ratio) ** 2)) < 0.15
    run.ok("layout", "a.npy", "-o", "number.toml", *options, "--read-noise-e", 3)
    assert Calibration.load("number.toml").read_noise_e == 3.0


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_maps_of_the_camera(folder: Path, run: Commands) -> None:
    """A cube of darks is averaged, a flat divided by its mean, bad pixels come as a map or a list."""
    rng = np.random.default_rng(2)
    dark, flat = rng.uniform(50, 150, SHAPE), rng.uniform(0.8, 1.2, SHAPE)
    bad = np.zeros(SHAPE, bool)
    bad[3, 5] = bad[40, 41] = True
    cube = (frames().astype(np.float32) - OFFSET_ADU) * flat + dark
    np.save("a.npy", cube)
    np.save("dark.npy", np.stack([dark - 3, dark + 3]))
    np.save("flat.npy", np.stack([20000 * flat, 20000 * flat]))
    np.save("map.npy", bad)
    np.save("list.npy", np.argwhere(bad))
    np.save("noise.npy", flat)
    for name, noise in (("map.npy", "3"), ("list.npy", "noise.npy")):
        options = ("--dark", "dark.npy", "--flat", "flat.npy", "--read-noise-e", noise, "--bad-pixels", name)
        run.ok("layout", "a.npy", "-o", "new.toml", "--overwrite", "--pixels", 16, *options)
        calibration = Calibration.load("new.toml")
        np.testing.assert_allclose(calibration.dark, dark)
        np.testing.assert_allclose(calibration.flat, flat / flat.mean())
        np.testing.assert_allclose(np.asarray(calibration.read_noise_e), 3.0 if noise == "3" else flat)
        np.testing.assert_array_equal(calibration.bad_pixels, np.load(name))
        assert len(Layout.load("new.toml")) == 49


@pytest.mark.slow
@DOUBTS
@pytest.mark.usefixtures("only_found")
def test_pixels_exclude_pupil_and_roi_choose_lenslets(folder: Path, run: Commands) -> None:
    np.save("a.npy", frames())
    arguments = ("layout", "a.npy", "--overwrite", "-o", "new.toml")
    run.ok(*arguments, "--pixels", "12,16")
    whole = Layout.load("new.toml")
    assert whole.window == (12, 16)
    run.ok(*arguments, "--pixels", "12,16", "--exclude", "0,7-13, 48")
    chosen = np.setdiff1d(np.arange(49), [0, *range(7, 14), 48])
    assert Layout.load("new.toml") == whole[chosen]
    run.ok(*arguments, "--pupil", "78,75,45,10")
    radius = np.hypot(*(Layout.load("new.toml").centres - (78, 75)).T)
    assert 10 <= radius.min() <= radius.max() <= 45
    assert len(radius) == np.count_nonzero(np.abs(np.hypot(*(lattice("square") - (78, 75)).T) - 27.5) <= 17.5)
    run.ok(*arguments, "--roi", "0,0,110,90")
    assert len(Layout.load("new.toml")) == 4 * 5  # rows and columns of nodes in it
    run.ok(*arguments, "--illuminated-fraction", "0.9")
    assert len(Layout.load("new.toml")) > 40


@pytest.mark.usefixtures("only_found")
def test_numbers_are_plain_and_doubt_is_said(folder: Path, run: Commands) -> None:
    np.save("a.npy", 400.0 * (frames().astype(float) - OFFSET_ADU))
    out = run.ok("layout", "a.npy", "-o", "new.toml").out
    assert "e+" not in out
    assert "doubtful" not in out
    array = frames().astype(float) - OFFSET_ADU
    array[:, :, 80:] *= 0.4
    np.save("b.npy", array)
    assert "  doubtful: " in run.ok("layout", "b.npy", "-o", "b.toml").out


@pytest.mark.usefixtures("only_found")
def test_nan_pixels_and_frames_do_not_count(folder: Path, run: Commands) -> None:
    cube = frames().astype(np.float32)
    cube[0] = np.nan
    cube[:, 30, 40] = np.inf
    np.save("a.npy", cube)
    assert run.ok("layout", "a.npy", "-o", "new.toml", "--pixels", 16).err == ""
    assert len(Layout.load("new.toml")) == 49


@DOUBTS
@pytest.mark.usefixtures("no_picture")
@pytest.mark.parametrize(
    ("name", "geometry", "shape", "lowest", "highest"),
    mostly_slow(
        1,
        [
            ("data/ciao_bench_60x224x224.npz", "square", None, 49, 49),
            ("data/auto_wfs_0037_ave.fits.gz", "square", (14, 14), 144, 152),
            ("data/test_newf9.fits.gz", "hexagonal", None, 141, 149),
        ],
    ),
)
def test_real_frames_give_their_lenslets(
    folder: Path, run: Commands, name: str, geometry: str, shape: Any, lowest: int, highest: int
) -> None:
    result = run.ok("layout", shared_file(name), "-o", "real.toml")
    layout = Layout.load("real.toml")
    assert layout.geometry == geometry
    assert lowest <= len(layout) <= highest
    if shape is not None:
        assert np.all(np.abs(layout.cells.max(axis=0) + 1 - shape) <= 1)
    run.ok("slopes", shared_file(name), "-c", "real.toml", "-o", "s.npz")
    assert read_slopes("s.npz").variables["valid"].mean() > 0.95
    assert "Next: " in result.out


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_lenslets_at_the_edge_are_left_out_or_windows_moved(folder: Path, run: Commands) -> None:
    """The spots of the first column lie 8 px from the edge, half a window of 20 px does not fit."""
    np.save("a.npy", frames()[:, :, 10:])
    result = run.ok("layout", "a.npy", "-o", "new.toml")
    assert "7 lit lenslets at the frame's edge left out" in result.out
    assert len(Layout.load("new.toml")) == 42
    assert np.abs(Layout.load("new.toml").offsets).max() < 1.1
    result = run.ok("layout", "a.npy", "-o", "moved.toml", "--move-windows")
    assert len(Layout.load("moved.toml")) == 49
    assert "windows moved off the spots" in result.out
    assert "left out" not in result.out


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_dark_level_and_hot_pixels_of_the_frame(run: Commands, folder: Path) -> None:
    array = frames()
    array[:, 5, 70] = 4000
    array[:, 80, 3] = 3000
    np.save("frames.npy", array)
    result = run.ok("layout", "frames.npy", "-o", "new.toml", "--mask-hot-pixels", "--gain-e-per-adu", 2)
    assert "2 hot pixels masked" in result.out
    calibration = Calibration.load(folder / "new.toml")
    assert calibration.bad_pixels.tolist() == [[5, 70], [80, 3]]
    # The median of some hundred background pixels with 3 ADU of noise and faint wings of the spots.
    assert calibration.dark == pytest.approx(OFFSET_ADU, abs=1.5)
    assert not calibration.dark_is_known


@pytest.mark.usefixtures("only_found")
def test_settings_without_a_layout_are_kept(folder: Path, run: Commands) -> None:
    settings = Settings(estimator="weighted", spot_fwhm_px=2.5)
    settings.save("tuned.toml")
    np.save("spots.npy", frames())
    assert "settings that tuned.toml has are kept" in run.ok("layout", "spots.npy", "-o", "tuned.toml").out
    assert Settings.load("tuned.toml") == settings
    run.refused("layout", "spots.npy", "-o", "tuned.toml", naming=("tuned.toml", "--overwrite"))


def defocused(stretch: float = 1.02) -> NDArray[np.float64]:
    """Return a frame of 11 x 11 sub-apertures, 24 px apart, whose spots lie on a wider lattice."""
    row, column = np.indices((11, 11)).reshape(2, -1) - 5
    cells = (column + 1j * row)[np.hypot(row, column) <= 5.4]
    nodes = 159.5 * (1 + 1j) + stretch * 24 * cells
    return spot_frame(nodes, (320, 320), flux_e=5000.0, width_px=np.sqrt(2), background_e=20.0)


def shown(run: Commands) -> NDArray[np.float64]:
    """Return the displacements x of the spots of `defocused` over the columns, measured with new.toml."""
    run.ok("slopes", "a.npy", "-c", "new.toml", "-o", "a.npz", "--overwrite")
    stored = read_slopes("a.npz")
    x, column = stored.variables["x"][0], stored.coordinates["column"]
    return np.array([x[column == number].mean() for number in range(11)])


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_a_stated_pitch_keeps_the_defocus_of_the_frame(folder: Path, run: Commands) -> None:
    np.save("a.npy", defocused())
    arguments = ("layout", "a.npy", "--overwrite", "-o", "new.toml")
    wanted = 0.02 * 24 * (np.arange(11) - 5.0)
    stated = run.ok(*arguments, "--pitch-px", "24")
    assert Layout.load("new.toml").pitch_px == 24.0
    assert Layout.load("new.toml").fitted == ("centre", "angle")
    assert "tilt and rotation" in stated.out
    np.testing.assert_allclose(shown(run), wanted, atol=0.05)
    fitted = run.ok(*arguments, "--pitch-px", "24", "--fit", "pitch")
    assert "tilt, defocus and rotation" in fitted.out
    assert np.abs(shown(run)).max() < 0.05
    known = run.ok(*arguments, "--pitch-px", "24", "--angle-deg", "0", "--centre", "158.5,159.5")
    assert "reference is" not in known.out
    np.testing.assert_allclose(shown(run), wanted + 1.0, atol=0.05)


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_what_was_estimated_is_estimated_again_and_what_is_stated_stays(folder: Path, run: Commands) -> None:
    """Dark level and noise, so that slopes have standard errors; the noise stated first, then estimated."""
    arguments = ("layout", "a.npy", "--overwrite", "-o", "new.toml")
    np.save("a.npy", frames() + 20)
    run.ok(*arguments)
    first = Calibration.load("new.toml")
    assert first.dark == pytest.approx(120, abs=1.5)
    assert first.read_noise_e == pytest.approx(3, rel=0.1)
    assert {"dark", "read_noise_e"} <= set(first.estimated)
    run.ok("slopes", "a.npy", "-c", "new.toml", "-o", "s.npz")
    assert np.isfinite(read_slopes("s.npz").variables["standard_error_x"]).all()
    run.ok(*arguments, "--read-noise-e", "3")
    np.save("a.npy", frames())
    result = run.ok(*arguments)
    again = Calibration.load("new.toml")
    assert again.dark == pytest.approx(100, abs=1.5)
    assert again.read_noise_e == 3.0
    assert "kept" in result.out
    assert "read_noise_e 3" in result.out


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_doubts_are_repeated_until_they_are_accepted(folder: Path, run: Commands) -> None:
    np.save("a.npy", frames(n_frames=1))
    run.ok("layout", "a.npy", "-o", "new.toml", "--pixels", 16)
    layout = Layout.load("new.toml")
    replace(layout, doubts=("8 lenslets may be dark",)).save("new.toml")
    with pytest.warns(DoubtWarning, match="8 lenslets may be dark"):
        result = run.ok("slopes", "a.npy", "-c", "new.toml", "-o", "a.npz")
    assert "every slope" not in result.out
    wavefront = run.ok("wavefront", "a.npz", "--picture", "")
    assert "8 lenslets may be dark" in wavefront.out
    assert "8 lenslets may be dark" in run.ok("layout", "--accept", "-o", "new.toml").out
    assert Layout.load("new.toml") == layout
    assert "every slope is valid" in run.ok("slopes", "a.npy", "-c", "new.toml", "-o", "b.npz").out


@pytest.mark.usefixtures("only_found")
@pytest.mark.slow
def test_one_bad_frame_does_not_decide_the_settings(folder: Path, run: Commands) -> None:
    """Overexposed, with stray light, or without flux, the first or the last; and frames written twice."""
    good = np.concatenate([frames(n_frames=7), frames(n_frames=1)]).astype(np.float64)
    expected = good[:7].round().astype(np.uint16)
    np.save("good.npy", expected)
    run.ok("layout", "good.npy", "-o", "good.toml", "--pixels", 16)
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    stray = 500 * np.exp(-0.5 * ((row - 60) ** 2 + (column - 100) ** 2) / 40**2)
    bright = 6 * (expected[0] - OFFSET_ADU) + OFFSET_ADU + stray
    for bad, wrong in product((0, 6), (bright, expected[0] * 0 + 100)):
        cube = np.insert(expected, [bad, 5], [wrong, expected[4]], axis=0)
        np.save("bad.npy", cube.astype(np.uint16))
        out = run.ok("layout", "bad.npy", "-o", "bad.toml", "--pixels", 16, "--overwrite").out
        assert out.count("left out") == 2
        assert Settings.load("bad.toml") == Settings.load("good.toml")
        assert Calibration.load("bad.toml") == Calibration.load("good.toml")
