import importlib
import importlib.metadata
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.adapters.adapter_cases import (
    ESTIMATORS,
    EVERYTHING,
    FAINT_E,
    POSITIONS,
    PSF,
    READ_NOISE,
    SIDE,
    N,
    images,
    noisy,
)
from tests.refusals import refused

import faintspot as fs
from faintspot import MissingExtraError, Settings
from faintspot.adapters.base import (
    ToolSlopes,
    UntestedVersionWarning,
    check_matrix,
    check_version,
    parts_of,
    predicted,
    window_corners,
)

LAYOUT = fs.Layout.stacked(N, (SIDE, SIDE))


def tool(settings: Settings, **options: Any) -> ToolSlopes:
    return ToolSlopes(LAYOUT, settings, READ_NOISE, **{"psf": PSF, **options})


def tall(stack: np.ndarray) -> np.ndarray:
    return stack.reshape(-1, SIDE)


@pytest.mark.parametrize("name", ["brightest", "map", pytest.param("window", marks=pytest.mark.slow)])
def test_calibration_does_not_depend_on_its_flux(name: str) -> None:
    # The frame is brought to the same flux first; pixels are rounded to float32, and flux that the pipeline
    # is told counts in steps of up to 10 % ("map").
    slopes = []
    for flux in (FAINT_E, 1e3, 5e6):
        measured = tool(ESTIMATORS[name])
        slopes.append(measured.measure(tall(images(flux)), noise_free=True))
        assert measured.last.valid.all()
    np.testing.assert_allclose(slopes[1:], [slopes[0], slopes[0]], rtol=0, atol=2e-4)
    # Spots within 1 px, where all of these see at least 0.7 of a displacement, and none more than 1.2 of it.
    gain = np.polyfit(POSITIONS.T.ravel(), slopes[0].ravel(), 1)[0]
    assert 0.7 < gain < 1.2


def test_a_recording_has_no_slopes_that_were_not_measured() -> None:
    measured, stack = tool(EVERYTHING), images()
    stack[2] = 0.0
    slopes = measured.measure(tall(stack))
    expected = np.where(np.arange(N) == 2, np.nan, slopes).ravel()
    for given in (slopes, slopes.ravel()):
        np.testing.assert_array_equal(measured.recorded(given), expected)
    with refused("slopes", "18", "4"):
        measured.recorded(np.zeros(4))


def test_slopes_and_their_errors_are_in_the_tools_unit() -> None:
    """With an axis that is opposite to the frame's."""
    of_tool, in_px = tool(EVERYTHING, unit_per_px=(2.0, -0.5)), tool(EVERYTHING)
    frame = tall(noisy(np.random.default_rng(1)))
    slopes, expected = of_tool.measure(frame), in_px.measure(frame)
    np.testing.assert_allclose(slopes, [2.0 * expected[0], -0.5 * expected[1]])
    x, y = in_px.standard_errors
    assert np.isfinite(x).sum() >= 8  # one spot is lost
    np.testing.assert_allclose(of_tool.standard_errors, [2.0 * x, 0.5 * y])
    np.testing.assert_array_equal(x, in_px.last.standard_error_x)


def test_calibrating_is_a_block_that_ends() -> None:
    measured = tool(Settings("window", flux_e=FAINT_E))
    bright = tall(images(1e5))
    seen = [measured.noise_free]
    with measured.calibrating(500.0):
        calibrated = measured.measure(bright)
        with measured.calibrating():
            seen.append(measured.noise_free)
        seen.append(measured.noise_free)
    assert [*seen, measured.noise_free] == [False, True, True, False]
    np.testing.assert_allclose(calibrated, measured.measure(bright, noise_free=True), atol=1e-6)
    # Over a mean flux of 40 e-, the sums of 100,000 e- are slopes beyond the window.
    assert np.abs(measured.measure(bright)).max() > 100 * np.abs(calibrated).max()


def test_calibrations_that_say_nothing_are_refused() -> None:
    frames = np.zeros((4, N * SIDE, SIDE))
    frames[1], frames[3, : 2 * SIDE] = np.nan, tall(images())[: 2 * SIDE]
    for frame, words in (
        (frames[0], ["expected flux in the sub-apertures"]),
        (frames[1], ["expected finite numbers"]),
        (np.ones((4, 4)), ["expected shape"]),
        (frames[3], ["9 sub-apertures", "got 2"]),
    ):
        with refused(*words):
            tool(EVERYTHING).measure(frame, noise_free=True)
    for options in ({"calibration_flux_e": 0.0}, {"flux_frames": 0.5}, {"psf": None}):
        with refused(*options):
            tool(Settings("ml"), **options)


def test_mean_flux_is_followed_where_nobody_says_it() -> None:
    rng, middle = np.random.default_rng(2), np.zeros((N, 2))
    measured = tool(Settings("window"))
    known_yet = []
    for _ in range(100):
        measured.measure(tall(noisy(rng, positions=middle)))
        known_yet.append(measured.flux is not None)
    assert known_yet == 19 * [False] + 81 * [True]
    # 100 frames of 40 e-; the sum under the window has a noise of 10 e- or less, its mean of 1.
    assert measured.flux is not None
    np.testing.assert_allclose(measured.flux.flux_e, FAINT_E, atol=6.0)
    known = measured.pipeline.plan.sensor.flux_e
    np.testing.assert_allclose(known, measured.flux.flux_e, rtol=0.1)
    measured.measure(tall(images(1e6)), noise_free=True)
    assert measured.flux.flux_e.max() < 60.0  # calibrations do not count


def test_mean_flux_that_is_known_or_not_wanted() -> None:
    for settings, options in (
        (Settings("window", flux_e=FAINT_E), {}),
        (Settings("window"), {"flux_frames": None}),
    ):
        rng, measured = np.random.default_rng(2), tool(settings, **options)
        before = measured.pipeline
        for _ in range(30):
            measured.measure(tall(noisy(rng)))
        assert measured.flux is None
        assert measured.pipeline is before


def test_a_prior_draws_slopes_towards_it() -> None:
    measured = tool(Settings("map", flux_e=5.0, prior_std_px=0.2))
    frame = tall(noisy(np.random.default_rng(3), 5.0))
    to_left, to_right = (measured.measure(frame, prior_px=np.full(2 * N, x)) for x in (-0.6, 0.6))
    assert (to_right - to_left).mean() > 0.3  # 5 electrons say little: most of 1.2 px


def test_a_version_that_was_not_tested_is_said_once(monkeypatch: pytest.MonkeyPatch) -> None:
    check_version.cache_clear()
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "2.1.0rc1")
    with pytest.warns(UntestedVersionWarning, match=r"Tool 2.1.0rc1: .* tested with 2.0.3"):
        check_version("Tool", "tool", "2.0.3")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_version("Tool", "tool", "2.0.3")
        check_version("Tool", "tool", "2.1")
    check_version.cache_clear()


def test_matrices_of_a_calibration_gone_wrong() -> None:
    for matrix, message in (
        (np.full((3, 4), np.nan), "12 NaN or infinite of 12"),
        (np.zeros((3, 4)), "zeros only"),
        (np.ones(3), "at least 2 dimensions"),
    ):
        with refused(message):
            check_matrix("interaction matrix", matrix)
    assert check_matrix("interaction matrix", np.eye(2)).shape == (2, 2)


class Predictor:
    def predict(self, slopes: np.ndarray) -> np.ndarray:
        return 2 * slopes


def test_predictions_come_from_callables_and_objects() -> None:
    last = np.arange(4.0)
    assert predicted(None, last, (4,)) is None
    assert predicted(Predictor(), None, (4,)) is None
    assert predicted(lambda slopes: None, last, (4,)) is None
    np.testing.assert_array_equal(predicted(Predictor(), last, (2, 2)), [[0, 2], [4, 6]])
    with refused("predict", "(6,)", "(4,)"):
        predicted(Predictor(), last, (6,))
    with refused("predict"):
        predicted(3, last, (4,))


def test_what_a_tools_file_says(tmp_path: Path) -> None:
    path = tmp_path / "faintspot.toml"
    lines = "[estimator]", 'name = "window"', "[settings]", "flux_e = 40.0", "spot_fwhm_px = 2.0"
    path.write_text("\n".join([*lines, "[calibration]", "dark = 3.0"]))
    tables = {
        "estimator": {"name": "window"},
        "settings": {"flux_e": 40.0, "spot_fwhm_px": 2.0},
        "calibration": {"dark": 3.0},
    }
    for source in (path, str(path), tables):
        parts = parts_of(source)
        assert parts.settings == Settings("window", flux_e=40.0, spot_fwhm_px=2.0)
        assert parts.calibration.dark == 3.0
        assert parts.spot == {"psf": None, "weights": None}
    with refused("layuot"):
        parts_of({**tables, "layuot": {}})
    with refused("faintspot: calibration"):
        parts_of({**tables, "calibration": 3})
    with refused("faintspot", "int"):
        parts_of(3)  # type: ignore[arg-type]
    assert parts_of({**tables, "psf": {"profile": "gaussian", "size": 1.0}}).psf is not None


@pytest.mark.parametrize("side", [7, 8])
def test_windows_are_those_nearest_to_their_lenslets(side: int) -> None:
    """Their middles lie within half a pixel of the centres, x before y."""
    centres = np.random.default_rng(1).uniform(20.0, 90.0, (200, 2))
    middles = window_corners(centres, side)[:, ::-1] + 0.5 * (side - 1)
    assert np.abs(middles - centres).max() <= 0.5


@pytest.mark.filterwarnings("ignore")
def test_missing_tool_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for package, extra, module, name in (
        ("hcipy", "loop", "hcipy", "SlopeEstimator"),
        ("specula", "specula", "specula.faintspot_slopec", "FaintspotSlopec"),
        ("pyrtc", "pyrtc", "pyrtc", "FaintspotSlopes"),
        ("pyrtc", "pyrtc", "pyrtc", "FaintspotCamera"),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"faintspot.adapters.{module}", raising=False)
        with pytest.raises(MissingExtraError, match=rf"faintspot\[{extra}\]"):
            getattr(importlib.import_module(f"faintspot.adapters.{module}"), name)
