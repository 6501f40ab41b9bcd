"""Pipelines with modules: the built-in slopes where modules do what is built in; refusals in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.realtime.module_cases import CALIBRATION, LAYOUT, SETTINGS, assert_same, frames, module, pipeline

import faintspot as fs
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.module_loading import load_module

Flag = fs.SubapertureFlag
EXAMPLE = Path(__file__).parents[2] / "examples" / "median_module.py"
N = len(LAYOUT)
ALL = {
    "tv": SETTINGS,
    "plain": SETTINGS.replace(estimator="brightest"),
    "threshold": SETTINGS.replace(rule="threshold"),
    "each": SETTINGS.replace(noise_std=np.linspace(0, 3, N), keep_brightest=np.arange(N) + 3),
    "smoothed": fs.Settings(estimator="smoothed", keep_brightest=9),
    "thresholded": fs.Settings(estimator="thresholded", threshold_e=2.0),
    "automatic": fs.Settings(noise_std="auto", keep_brightest="auto", flux_e=200.0),
    "weighted": fs.Settings(estimator="weighted"),
    "ml": fs.Settings(estimator="ml", search_range_px=1.5),
    "map": fs.Settings(estimator="map", flux_e=200.0),
}
ERRORS = ("standard_error_x", "standard_error_y")
FLOATS = ("x", "y", "flux", *ERRORS)


@pytest.mark.parametrize("name", list(ALL))
def test_without_modules_nothing_changes(name: str) -> None:
    plain = pipeline(ALL[name])
    modular = ModularPipeline(plain, {})
    for frame in [*frames(3), frames(1)[0].astype(np.float32), frames(1)[0] // 256]:
        found, expected = modular(frame), plain(frame)
        if name == "thresholded":  # what has bad pixels is measured in lanes offline, in rows here
            for each in FLOATS:
                np.testing.assert_allclose(
                    getattr(found, each), getattr(expected, each), rtol=1e-5, atol=1e-5
                )
        assert_same(found, expected, but=FLOATS if name == "thresholded" else ())
    assert (plain(frames(1)[0]).flags != 0).any()


# What is built in, as modules.
BACKGROUND = "return fs.brightest_pixels(images, 9)"
CENTROID = "return fs.centre_of_gravity(images)"


def test_calibration_as_built_in(tmp_path: Path) -> None:
    """Where there are no bad pixels, which a module fills as it likes."""
    good = fs.SlopePipeline(LAYOUT, SETTINGS, fs.Calibration(100.0, gain_e_per_adu=0.5, read_noise_e=1.0))
    body = "return (images - np.float32(100)) * np.float32(0.5)"
    modular = ModularPipeline(good, module(tmp_path, "calibrate", body))
    for frame in frames(3):
        assert_same(modular(frame), good(frame))


def test_denoising_as_built_in(tmp_path: Path) -> None:
    body = "return fs.tv_denoise(images, settings.noise_std, tolerance=settings.tolerance, "
    body += "max_iterations=settings.max_iterations)"
    modular = ModularPipeline(pipeline(), module(tmp_path, "denoise", body))
    for frame in frames(3):
        found, expected = modular(frame), pipeline()(frame)
        informing = np.uint8(Flag.INFEASIBLE_STRENGTH | Flag.NOT_CONVERGED)
        assert_same(found, expected, but=("iterations", "flags", *ERRORS))
        assert np.array_equal(found.flags, expected.flags & ~informing)
        # The light of the denoised image instead of the noisy one: to what the noise changes of it.
        ratio = found.standard_error_x[found.valid] / expected.standard_error_x[found.valid]
        assert np.all(np.abs(ratio - 1) < 0.2)


@pytest.mark.parametrize("name", ["tv", "plain", "smoothed"])
def test_background_as_built_in(tmp_path: Path, name: str) -> None:
    modules = module(tmp_path, "background", BACKGROUND)
    modular, plain = ModularPipeline(pipeline(ALL[name]), modules), pipeline(ALL[name])
    for frame in frames(3):
        found = modular(frame)
        assert_same(found, plain(frame), but=ERRORS)
        assert np.all(np.isinf(found.standard_error_x))


@pytest.mark.parametrize("name", ["tv", "threshold", "smoothed", "thresholded"])
def test_centroid_as_built_in(tmp_path: Path, name: str) -> None:
    modular = ModularPipeline(pipeline(ALL[name]), module(tmp_path, "centroid", CENTROID))
    for frame in frames(3):
        assert_same(modular(frame), pipeline(ALL[name])(frame), but=ERRORS)


def test_all_stages_at_once(tmp_path: Path) -> None:
    good = fs.SlopePipeline(LAYOUT, SETTINGS, fs.Calibration(100.0, gain_e_per_adu=0.5))
    bodies = {
        "calibrate": "return (images - np.float32(100)) * np.float32(0.5)",
        "denoise": "return fs.tv_denoise(images, 1.0)",
        "background": BACKGROUND,
        "centroid": CENTROID,
    }
    modules = {stage: module(tmp_path, stage, body, stage)[stage] for stage, body in bodies.items()}
    modular = ModularPipeline(good, dict(reversed(modules.items())))
    assert list(modular.modules) == list(bodies)
    for frame in frames(2):
        found, expected = modular(frame), good(frame)
        assert_same(found, expected, but=("iterations", "flags", *ERRORS))


@pytest.mark.parametrize("estimator", ["ml", "weighted"])
def test_modules_before_estimators_that_know_the_spot(tmp_path: Path, estimator: str) -> None:
    """A denoiser that changes nothing changes no slope; a centroid takes the estimator's place."""
    plain = pipeline(ALL[estimator])
    identity = ModularPipeline(plain, module(tmp_path, "denoise", "return images"))
    assert_same(identity(frames(1)[0]), plain(frames(1)[0]))
    centroid = ModularPipeline(plain, module(tmp_path, "centroid", "return np.zeros((len(images), 2))"))
    assert np.all(np.abs(centroid(frames(1)[0]).x) <= 1.5)


def test_modules_may_write_into_what_they_are_given(tmp_path: Path) -> None:
    body = "images *= 2\nreturn images"
    modular = ModularPipeline(pipeline(ALL["plain"]), module(tmp_path, "denoise", body))
    data, expected = frames(1)[0], pipeline(ALL["plain"])(frames(1)[0])
    for _ in range(2):
        assert np.array_equal(modular(data).x, expected.x)
    assert np.array_equal(data, frames(1)[0])


def test_the_example_module() -> None:
    from scipy.ndimage import median_filter

    median = load_module(EXAMPLE)
    images = np.random.default_rng(1).normal(size=(3, 9, 8)).astype(np.float32)
    found = median.make(LAYOUT, SETTINGS)(images)
    expected = median_filter(images, (1, 3, 3))
    assert np.array_equal(found[:, 1:-1, 1:-1], expected[:, 1:-1, 1:-1])
    assert np.array_equal(found[:, 0], images[:, 0])
    assert ModularPipeline(pipeline(), {"denoise": median})(frames(1)[0]).valid.any()
    assert sum(bool(line) for line in EXAMPLE.read_text().splitlines()) <= 20


def test_not_finite_is_flagged(tmp_path: Path) -> None:
    """A module that fails only where it was not tried: that sub-aperture is invalid, no other one is."""
    body = "images[images.max(axis=(1, 2)) > 1e6] = np.nan\nreturn images"
    frame = frames(1)[0].astype(np.float32)
    broken = frame.copy()
    broken[LAYOUT.corners[7, 0] + 2, LAYOUT.corners[7, 1] + 2] = 1e7
    for stage in ("calibrate", "denoise", "background"):
        text = f"images = images - 100\n{body}" if stage == "calibrate" else body
        modular = ModularPipeline(pipeline(), module(tmp_path, stage, text))
        found, before = modular(broken), modular(frame)
        assert found.flags[7] & Flag.NO_LIGHT
        assert found.x[7] == found.y[7] == 0
        others = np.arange(N) != 7
        assert np.array_equal(found.x[others], before.x[others])
    text = f"{body.replace('return images', '')}\nreturn images[:, 0, :2]"
    modular = ModularPipeline(pipeline(), module(tmp_path, "centroid", text))
    assert modular(broken).flags[7] & Flag.NO_LIGHT


@pytest.mark.parametrize(
    ("stage", "body", "message"),
    [
        ("denoise", "return images[1:]", r"module module \(denoise\): expected shape \(20, 8, 8\), got"),
        ("centroid", "return images", r"expected shape \(20, 2\)"),
        ("background", "return images.astype(int)", "expected an array of float32 or float64, got int64"),
        ("denoise", "return images.tolist()", "expected an array of float32 or float64, got list"),
        ("denoise", "pass", "got NoneType"),
        (
            "denoise",
            "return images / images.sum()",
            "NaN or infinite for 20 sub-apertures in a trial",
        ),
        ("centroid", "return np.full((len(images), 2), np.inf)", "NaN or infinite"),
        ("denoise", "return images.nothing", "AttributeError: 'numpy.ndarray' object has no attribute"),
        ("denoise", "raise ValueError('two\\nlines')", "ValueError: two lines"),
        ("background", "time.sleep(0.02)\nreturn images", r"us of it there; expected at most 10000 us"),
    ],
)
def test_refused(tmp_path: Path, stage: str, body: str, message: str) -> None:
    with pytest.raises(fs.InputError, match=message) as caught:
        ModularPipeline(pipeline(), module(tmp_path, stage, body), budget_s=0.01)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("    raise KeyError('psf')", r"make: KeyError: 'psf'"),
        ("    return None", "make: expected that it returns a function, got NoneType"),
    ],
)
def test_make_fails(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "made.py"
    path.write_text(f"STAGE = 'denoise'\ndef make(layout, settings):\n{text}\n")
    with pytest.raises(fs.InputError, match=message):
        ModularPipeline(pipeline(), {"denoise": load_module(path)})


def test_never_returns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("faintspot.realtime.modular.TRIAL_LIMIT_S", 0.3)
    modules = module(tmp_path, "denoise", "while True:\n    pass")
    with pytest.raises(fs.InputError, match=r"module module \(denoise\): did not return within 0\.3 s"):
        ModularPipeline(pipeline(), modules)


def test_wrong_use(tmp_path: Path) -> None:
    modules = module(tmp_path, "denoise", "return images")
    with pytest.raises(fs.InputError, match="expected one for 'background'"):
        ModularPipeline(pipeline(), {"background": modules["denoise"]})
    with pytest.raises(fs.InputError, match=r"settings\.flux_e"):
        ModularPipeline(
            fs.SlopePipeline(LAYOUT, fs.Settings(noise_std="auto", spot_fwhm_px=2.0), CALIBRATION), modules
        )
    modular = ModularPipeline(pipeline(), modules)
    with pytest.raises(fs.InputError, match="frame: expected shape"):
        modular(np.zeros((2, 2)))


def test_nan_in_frames(tmp_path: Path) -> None:
    """The built-in calibration has filled them before a module sees them."""
    frame = frames(1)[0].astype(np.float32)
    frame[1:4, 1:4] = np.nan
    modular = ModularPipeline(pipeline(), module(tmp_path, "centroid", CENTROID))
    assert_same(modular(frame), pipeline()(frame), but=ERRORS)


def test_a_sub_aperture_that_is_all_bad_says_no_more(tmp_path: Path) -> None:
    frame = frames(1)[0].astype(np.float32)
    frame[:8, :8] = np.nan
    modular = ModularPipeline(pipeline(), module(tmp_path, "centroid", CENTROID))
    assert_same(modular(frame), pipeline()(frame), but=ERRORS)
    assert modular(frame).flags[0] == Flag.TOO_MANY_BAD_PIXELS


def test_light_is_compared_with_the_image_before_the_background_was_taken_off(tmp_path: Path) -> None:
    plain = pipeline(SETTINGS.replace(flux_floor=0.3))
    bright = frames(1)[0] // 2 + 1000  # a sky of which the spots are a small part
    expected = plain(bright)
    assert expected.valid.any()
    assert np.count_nonzero(expected.flags & Flag.NO_LIGHT) > 3
    modular = ModularPipeline(plain, module(tmp_path, "background", BACKGROUND))
    assert_same(modular(bright), expected, but=ERRORS)


def test_positions_outside_the_window_are_invalid(tmp_path: Path) -> None:
    body = "positions = np.zeros((len(images), 2))\npositions[3] = 0, 4.1\nreturn positions"
    found = ModularPipeline(pipeline(), module(tmp_path, "centroid", body))(frames(1)[0])
    assert found.flags[3] & Flag.NO_LIGHT
    assert found.x[3] == found.y[3] == 0


def test_negative_pixels_of_a_background_module_count(tmp_path: Path) -> None:
    settings = ALL["plain"].replace(search_range_px=None)
    modular = ModularPipeline(pipeline(settings), module(tmp_path, "background", "return images - 0.5"))
    frame = frames(1)[0]
    images = pipeline(settings).explain(frame).calibrated - np.float32(0.5)
    found = modular(frame)
    reference = (
        pipeline(settings)(frame).x
        - fs.centre_of_gravity(pipeline(settings).explain(frame).background_subtracted)[:, 0]
    )
    expected = fs.centre_of_gravity(images)[:, 0] + reference
    assert images.min() < 0
    # To float32 rounding of positions of a few px, taken apart and put together again.
    np.testing.assert_allclose(found.x[found.valid], expected[found.valid], atol=1e-5)


def test_a_centroid_in_place_of_an_estimator_that_knows_the_spot(tmp_path: Path) -> None:
    """Light is the sum of the image, and nothing is iterated."""
    plain = pipeline(ALL["ml"])
    found = ModularPipeline(plain, module(tmp_path, "centroid", CENTROID))(frames(1)[0])
    total = plain.explain(frames(1)[0]).calibrated.sum(axis=(1, 2))
    np.testing.assert_allclose(found.flux, total, rtol=1e-5, atol=1e-3)  # the order of a float32 sum
    assert np.all(found.iterations == 0)
