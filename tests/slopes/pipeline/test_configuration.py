from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tests.refusals import refused

import faintspot as fs
from faintspot.base.options import PerSubaperture
from faintspot.slopes.estimators import Estimator, estimators
from faintspot.slopes.pipeline import configuration

LAYOUT = "[layout.grid]\nshape = [2, 3]\npixels = 4\n"
SETTINGS = '[estimator]\nname = "tv"\nnoise_std = 0.5\n'


def written(folder: Path, text: str) -> Path:
    path = folder / "faintspot.toml"
    path.write_text(text, encoding="utf-8")
    return path


# Round trips -----------------------------------------------------------------------------------------

N = 5


def each(values: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """One value, one for each of N sub-apertures, or a default and others in some places."""
    others = st.dictionaries(st.integers(0, N - 1), values, max_size=3)
    return st.one_of(
        values, st.lists(values, min_size=N, max_size=N), st.builds(PerSubaperture, values, others)
    )


numbers = st.floats(0, 1, width=64)
shared: dict[str, Any] = {
    "search_range_px": st.none() | each(st.floats(0.1, 100)),
    "max_bad_fraction": each(numbers),
    "flux_e": st.none() | each(st.floats(0.1, 1e6)),
}
denoised = st.builds(
    fs.Settings,
    st.just("tv"),
    noise_std=each(st.floats(0, 1e6)),
    tolerance=each(numbers),
    max_iterations=each(st.integers(1, 10_000)),
    keep_brightest=st.one_of(st.none(), each(st.integers(1, 1000))),
    rule=each(st.sampled_from(["subtract_next", "threshold", "subtract_kth"])),
    algorithm=st.sampled_from(["fgp", "chambolle"]),
    flux_floor=each(numbers),
    **shared,
)
fitted = st.builds(
    fs.Settings,
    st.just("ml"),
    model_error=each(numbers),
    steps=st.none() | st.integers(1, 100),
    spot_fwhm_px=st.none() | each(st.floats(0.5, 60)),
    **shared,
)
maps = hnp.arrays(np.float64, (6, 7), elements=st.floats(-1e6, 1e6) | st.just(np.nan))
all_calibrations = st.builds(
    fs.Calibration,
    dark=st.floats(-1e6, 1e6) | maps,
    flat=st.none() | maps,
    gain_e_per_adu=st.floats(1e-6, 1e6),
    em_gain=st.floats(1, 1e6),
    bad_pixels=st.none()
    | hnp.arrays(np.bool_, (6, 7))
    | st.lists(st.tuples(st.integers(0, 5), st.integers(0, 6)), max_size=4),
    saturation_adu=st.none() | st.floats(1, 1e9),
)


@given(denoised | fitted)
def test_settings_round_trip(tmp_path_factory: pytest.TempPathFactory, settings: fs.Settings) -> None:
    path = tmp_path_factory.mktemp("settings") / "faintspot.toml"
    settings.save(path)
    assert fs.Settings.load(path) == settings


def some_options(kind: type[Estimator]) -> dict[str, Any]:
    """A value of every option of an estimator that is not its default."""
    values: dict[str, Any] = {}
    for name, declared in kind.declared().items():
        default = kind.defaults()[name]
        if declared.choices:
            values[name] = next(choice for choice in declared.choices if choice != default)
        else:
            number = 3 if declared.whole else 0.375
            values[name] = PerSubaperture(number, {2: number}) if declared.per_subaperture else number
    return values


@pytest.mark.parametrize("name", list(estimators()))
def test_every_estimator_comes_back(name: str, tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    kind = estimators()[name]
    settings = fs.Settings(kind(**some_options(kind)), search_range_px=2.0, flux_e=[10.0, 20.0, 30.0])
    settings.save(path)
    text = path.read_text()
    assert text.startswith(f'[estimator]\nname = "{name}"\n')
    assert "[settings]\nsearch_range_px = 2.0\n" in text
    assert set(settings.estimator.chosen()) == set(kind.declared())
    assert fs.Settings.load(path) == settings
    written(tmp_path, configuration.to_text(settings))
    assert fs.Settings.load(path) == settings


@given(all_calibrations)
def test_calibration_round_trip(
    tmp_path_factory: pytest.TempPathFactory, calibration: fs.Calibration
) -> None:
    path = tmp_path_factory.mktemp("calibration") / "sensor.toml"
    calibration.save(path)
    loaded = fs.Calibration.load(path)
    assert loaded == calibration
    assert np.array_equal(loaded.maps((6, 7)), calibration.maps((6, 7)), equal_nan=True)


@given(st.integers(0, 2**32 - 1))
def test_layout_round_trip(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    rng = np.random.default_rng(seed)
    grid = fs.Layout.grid((3, 4), pixels=(5, 6), pitch=7, origin=(int(rng.integers(5)), 2))
    chosen = rng.choice(12, int(rng.integers(1, 13)), replace=False)
    layout = fs.Layout(
        grid.frame_shape,
        grid.window,
        grid.corners[chosen],
        grid.centres[chosen] + rng.uniform(-1, 1, (len(chosen), 2)),
        rng.integers(-9, 9, (len(chosen), 2)),
        str(rng.choice(["square", "hexagonal"])),
        float(rng.uniform(5, 9)),
        float(rng.uniform(-360, 360)),
    )
    path = tmp_path_factory.mktemp("layout") / "faintspot.toml"
    layout.save(path)
    loaded = fs.Layout.load(path)
    assert np.allclose(loaded.centres, layout.centres, rtol=0, atol=1e-6)  # written to a millionth of a pixel
    for name in ("frame_shape", "window", "geometry", "pitch_px", "angle_deg"):
        assert getattr(loaded, name) == getattr(layout, name)
    assert np.array_equal(loaded.corners, layout.corners)
    assert np.array_equal(loaded.cells, layout.cells)


def test_maps_lie_beside_the_file(tmp_path: Path) -> None:
    path = tmp_path / "night.1.toml"
    dark = np.random.default_rng(1).normal(size=(6, 7))
    fs.Calibration(dark, bad_pixels=np.eye(6, 7) > 0).save(path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["night.1.calibration.npz", "night.1.toml"]
    assert 'dark = "night.1.calibration.npz:dark"' in path.read_text()
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for file in list(tmp_path.glob("night*")):
        file.rename(moved / file.name)
    assert np.array_equal(fs.Calibration.load(moved / "night.1.toml").dark, dark)


def test_maps_in_files_of_ones_own(tmp_path: Path) -> None:
    mask = np.zeros((6, 7))
    mask[2, 3] = 1
    np.save(tmp_path / "hot.npy", mask)
    np.save(tmp_path / "flat.npy", np.full((6, 7), 2.0))
    path = written(tmp_path, '[calibration]\nbad_pixels = "hot.npy"\nflat = "flat.npy"\n')
    calibration = fs.Calibration.load(path)
    assert np.array_equal(calibration.bad_pixels, mask > 0)
    assert np.array_equal(calibration.flat, np.full((6, 7), 2.0))


def test_maps_are_means_of_several_frames(tmp_path: Path) -> None:
    cube = np.random.default_rng(1).normal(100, 3, (5, 6, 7))
    np.savez(tmp_path / "maps.npz", dark=cube, flat=cube / 100, bad=np.where(np.eye(6, 7) > 0, np.nan, 0))
    path = written(
        tmp_path,
        '[calibration]\ndark = "maps.npz:dark"\nflat = "maps.npz:flat"\nbad_pixels = "maps.npz:bad"\n',
    )
    calibration = fs.Calibration.load(path)
    assert np.allclose(calibration.dark, cube.mean(axis=0))
    assert np.allclose(calibration.flat, cube.mean(axis=0) / 100)
    assert np.array_equal(calibration.bad_pixels, np.eye(6, 7) > 0)


def test_the_file_is_not_taken_for_a_table(tmp_path: Path) -> None:
    path = tmp_path / "layout.est.toml"
    path.write_text(SETTINGS)
    with pytest.raises(fs.InputError) as error:
        _ = configuration.Configuration(path).layout
    assert str(error.value) == f"{path}: expected a table [layout], found estimator"


def test_all_together_and_again(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    parts = fs.Layout.grid((2, 3), pixels=4), fs.Settings(noise_std=1.0), fs.Calibration(em_gain=500.0)
    for part in (*parts, *parts):
        part.save(path)
    described = configuration.Configuration(path)
    assert (described.layout, described.settings, described.calibration) == parts
    assert path.read_text().count("[estimator]") == 1
    assert "[settings]" not in path.read_text()  # nothing that all estimators share was set


def test_comments_and_other_tables_stay(tmp_path: Path) -> None:
    text = f"# my sensor\n{LAYOUT}# of the pupil\nouter_radius = 9.5 # lenslets\n\n{SETTINGS}"
    path = written(tmp_path, text)
    fs.Settings(noise_std=2.5).save(path)
    fs.Calibration(em_gain=3.0).save(path)
    saved = path.read_text()
    assert saved.startswith(text.partition("[estimator]")[0])
    assert fs.Settings.load(path).noise_std == 2.5
    assert fs.Calibration.load(path).em_gain == 3.0
    fs.Layout.grid((1, 1), pixels=8).save(path)
    assert "# my sensor" in path.read_text()
    assert len(fs.Layout.load(path)) == 1
    assert fs.Settings.load(path).noise_std == 2.5


def test_configuration_survives_its_text(tmp_path: Path) -> None:
    parts = fs.Layout.grid((2, 3), pixels=4), fs.Settings(noise_std=1.0)
    path = written(tmp_path, configuration.to_text(*parts))
    described = configuration.Configuration(path)
    assert (described.layout, described.settings) == parts
    assert "map of (3, 4)" in configuration.to_text(fs.Calibration(flat=np.ones((3, 4))))


# Reading ---------------------------------------------------------------------------------------------


def test_a_grid_is_the_layout_of_its_numbers(tmp_path: Path) -> None:
    text = (
        "[layout.grid]\nshape = [7, 7]\npixels = [8, 10]\nouter_radius = 3.5\ninner_radius = 0.5\n"
        "pitch = 12\norigin = [3, 4]\nframe_shape = [100, 120]\n"
    )
    expected = fs.Layout.grid(
        (7, 7),
        pixels=(8, 10),
        outer_radius=3.5,
        inner_radius=0.5,
        pitch=12,
        origin=(3, 4),
        frame_shape=(100, 120),
    )
    assert fs.Layout.load(written(tmp_path, text)) == expected
    assert len(expected) == 36


def test_some_subapertures_have_other_values(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        '[estimator]\nname = "tv"\nnoise_std = { default = 2.5, 4 = 3.0 }\n'
        'rule = { default = "threshold", 0 = "subtract_kth" }\n'
        "[settings]\nflux_e = { default = 100.0, 1 = 50.0 }\n",
    )
    settings = fs.Settings.load(path)
    assert settings.values("noise_std", 6, 16).tolist() == [2.5] * 4 + [3.0, 2.5]
    assert settings.values("rule", 2, 16).tolist() == ["subtract_kth", "threshold"]
    assert settings.values("flux_e", 3, 16).tolist() == [100.0, 50.0, 100.0]


def test_no_calibration_means_electrons(tmp_path: Path) -> None:
    path = written(tmp_path, LAYOUT + SETTINGS)
    assert fs.Calibration.load(path) == fs.Calibration()
    assert configuration.Configuration(path).calibration == fs.Calibration()


def test_an_estimator_alone_is_enough(tmp_path: Path) -> None:
    path = written(tmp_path, f'{LAYOUT}[estimator]\nname = "brightest"\n')
    assert configuration.has(path, "settings")
    assert not configuration.has(path, "calibration")
    assert configuration.Configuration(path).settings == fs.Settings("brightest")


def test_files_that_cannot_be_written(tmp_path: Path) -> None:
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00[settings]")
    with refused(str(binary)):
        fs.Settings(noise_std=1.0).save(binary)
    assert binary.read_bytes() == b"\xff\xfe\x00[settings]"
    with refused("nowhere"):
        fs.Settings(noise_std=1.0).save(tmp_path / "nowhere" / "faintspot.toml")


# Laser guide star ------------------------------------------------------------------------------------

SENSOR = (
    "[layout]\npixel_scale_arcsec = 0.5\nsubaperture_m = 1.3\n[layout.grid]\nshape = [3, 4]\npixels = 10\n"
)
WINDOW = '[estimator]\nname = "window"\n[settings]\nflux_e = 200.0\n[calibration]\nread_noise_e = 1.0\n'
LASER = "[laser]\nlaunch_m = [-5.0, 0.0]\nspot_fwhm_arcsec = 1.2\nmatched_filter = true\n"


def test_spots_of_a_laser_guide_star(tmp_path: Path) -> None:
    """Places are from the middle of the pupil; a PSF or weights of their own go before."""
    path = written(tmp_path, SENSOR + WINDOW + LASER)
    described = configuration.Configuration(path)
    psf, weights = described.psf, described.weights
    x, y = np.meshgrid(1.3 * (np.arange(4) - 1.5), 1.3 * (np.arange(3) - 1.0))
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    star = fs.LaserGuideStar(places, [-5.0, 0.0], 0.5, fs.PSF.analytic("gaussian", size=1.2))
    expected = star.psf(star.focused(fs.SodiumProfile.gaussian()), radius_px=8.0)
    assert psf is not None
    np.testing.assert_allclose(psf.samples, expected.samples, atol=1e-6 * expected.samples.max())
    matched = fs.FixedWeights.matched(psf, (10, 10), flux_e=200.0, read_noise_e=1.0)
    assert isinstance(weights, fs.FixedWeights)
    np.testing.assert_allclose(weights.x, matched.x)
    own = written(tmp_path, SENSOR + WINDOW + LASER + '[psf]\nprofile = "gaussian"\n')
    psf = configuration.Configuration(own).psf
    assert psf is not None
    assert len(psf.samples) == 1


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("launch_m = [-5.0, 0.0]", "launch_m = [-5.0]"),
        ("spot_fwhm_arcsec = 1.2", "spot_fwhm_arcsec = 1.2\nfollow_every_s = -1"),
        ("matched_filter = true", "matched_filter = 1"),
        ("flux_e = 200.0", ""),
        ("read_noise_e = 1.0", ""),
        ("pixel_scale_arcsec = 0.5", ""),
    ],
)
def test_a_laser_guide_star_that_is_refused(tmp_path: Path, old: str, new: str) -> None:
    path = written(tmp_path, (SENSOR + WINDOW + LASER).replace(old, new))
    with refused(f"{path}"):
        _ = configuration.Configuration(path).weights
