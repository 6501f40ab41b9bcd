"""faintspot layout where the frame shows more than spots: settings, slopes, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree
from tests.cli.cli_cases import Commands
from tests.cli.layout.extended_light import eye_frame, flat_frame, mosaic_frames

from faintspot import Layout, SlopePipeline
from faintspot.slopes.pipeline import configuration

pytestmark = [
    pytest.mark.usefixtures("no_picture"),
    pytest.mark.filterwarnings("ignore::faintspot.base.errors.DoubtWarning"),
]


def window_middles(layout: Layout) -> np.ndarray:
    return layout.corners[:, ::-1] + 0.5 * (np.array(layout.window[::-1]) - 1)


@pytest.mark.slow
@pytest.mark.parametrize("reflection_e", [0.0, 500.0])
def test_reflection_spoils_no_settings_and_slopes(folder: Path, run: Commands, reflection_e: float) -> None:
    """Flux and FWHM as without it, and slopes 4 pitches away: 0.07 px rms, of 20 % more at the most."""
    pixels, spots = flat_frame(reflection_e)
    np.save("a.npy", pixels)
    out = run.ok("layout", "a.npy", "-o", "new.toml").out
    assert ("a map" in out) == (reflection_e > 0)
    known = configuration.Configuration("new.toml")
    assert float(out.split("flux of a spot ")[1].split()[0]) == pytest.approx(1000.0, rel=0.05)
    assert known.settings.spot_fwhm_px == pytest.approx(4.7, rel=0.05)
    slopes = SlopePipeline(known.layout, known.settings, known.calibration)(pixels.astype(np.float32))
    positions = known.layout.centres + np.stack([slopes.x, slopes.y], axis=1)
    errors = positions - spots[cKDTree(spots).query(window_middles(known.layout))[1]]
    far = np.hypot(*(known.layout.centres - (np.array(pixels.shape) - 1) / 2).T) > 96
    assert slopes.valid[far].all()
    assert np.sqrt(np.square(errors[far]).mean()) < 0.084
    assert np.hypot(*errors[slopes.valid].T).max() < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_defaults_in_eyes(folder: Path, run: Commands, seed: int) -> None:
    """Scaled median deviations, of narrow centroids 0.57 px: a few lenslets have reflections for spots."""
    pixels, spots = eye_frame(seed)
    np.save("a.npy", pixels)
    run.ok("layout", "a.npy", "-o", "new.toml")
    known = configuration.Configuration("new.toml")
    layout = known.layout
    assert known.settings.spot_fwhm_px == pytest.approx(5.0, rel=0.25)
    slopes = SlopePipeline(layout, known.settings, known.calibration)(pixels)
    distance, nearest = cKDTree(spots).query(window_middles(layout))
    judged = slopes.valid & (distance < 8)
    assert np.count_nonzero(judged) > 0.8 * len(spots)
    errors = layout.centres + np.stack([slopes.x, slopes.y], axis=1) - spots[nearest]
    assert 1.4826 * np.median(np.abs(errors[judged])) < 0.57


@pytest.mark.slow
@pytest.mark.usefixtures("no_trials")
def test_background_beyond_a_stated_dark_is_reported(folder: Path, run: Commands) -> None:
    """The dark stays as stated, and the width does not follow the reflection."""
    np.save("a.npy", flat_frame(500.0).pixels)
    out = run.ok("layout", "a.npy", "-o", "new.toml", "--dark", "20").out
    assert "the background varies" in out
    known = configuration.Configuration("new.toml")
    assert known.calibration.dark == 20.0
    assert known.settings.spot_fwhm_px == pytest.approx(4.7, rel=0.15)


@pytest.mark.slow
@pytest.mark.usefixtures("no_trials")
def test_spots_too_wide_for_the_largest_window_are_binned(folder: Path, run: Commands) -> None:
    """FWHM of 54 px at a pitch of 90 px: windows of 64 px would cut them."""
    along = sum(np.exp(-4 * np.log(2) * ((np.arange(380) - 55 - 90 * n) / 54) ** 2) for n in range(4))
    np.save("a.npy", np.random.default_rng(1).normal(10 + 160 * np.outer(along, along), 1.5))
    run.ok("layout", "a.npy", "-o", "new.toml")
    layout = Layout.load("new.toml")
    assert (len(layout), layout.bin, layout.window) == (16, 2, (90, 90))


@pytest.mark.usefixtures("no_trials")
@pytest.mark.parametrize("gains", [(1.0, 0.25, 0.25, 0.05), (0.6, 1.0, 1.0, 0.4)])
def test_mosaic_is_refused(folder: Path, run: Commands, gains: tuple[float, float, float, float]) -> None:
    np.save("a.npy", mosaic_frames(gains))
    error = run.refused("layout", "a.npy", "-o", "new.toml").error
    assert "Bayer mosaic" in error
    assert "--bin 2 (bin = 2 in [layout])" in error
    assert not Path("new.toml").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("no_trials")
def test_flat_field_corrects_a_colour_mosaic(folder: Path, run: Commands) -> None:
    gains = (0.6, 1.0, 1.0, 0.4)
    np.save("a.npy", mosaic_frames(gains))
    np.save("flat.npy", np.tile(np.reshape(gains, (2, 2)), (110, 110)))
    run.ok("layout", "a.npy", "-o", "new.toml", "--dark", "100", "--flat", "flat.npy")


@pytest.mark.slow
@pytest.mark.usefixtures("no_trials")
def test_a_dark_never_makes_a_layout_worse(folder: Path, run: Commands) -> None:
    """The same windows as without a dark, except for single ones at the pupil's edge."""
    pixels, spots = eye_frame(1)
    np.save("a.npy", pixels)
    column = np.arange(pixels.shape[1])
    darks: dict[str, Any] = {
        "": None,
        "offset": np.full(pixels.shape, 46.0),
        "pattern": 6 + np.tile(6 * np.sin(2 * np.pi * column / 7.3), (len(pixels), 1)),
        "with light": 0.7 * eye_frame(2).pixels,
    }
    layouts = []
    for kind, dark in darks.items():
        np.save("dark.npy", dark)
        given = ("--dark", "dark.npy") if kind else ()
        out = run.ok("layout", "a.npy", "-o", f"{kind}.toml", *given).out
        layouts.append(Layout.load(f"{kind}.toml"))
        distance = cKDTree(spots).query(window_middles(layouts[-1]))[0]
        assert np.count_nonzero(distance > 8) <= 1
        assert ("found without the dark" in out) == (kind in ("pattern", "with light")), kind
        assert len(layouts[-1]) == pytest.approx(len(layouts[0]), abs=3)


@pytest.mark.slow
@pytest.mark.usefixtures("no_trials")
def test_a_dark_that_takes_off_a_pattern_is_used(folder: Path, run: Commands) -> None:
    pixels, spots = flat_frame(0.0)
    pattern = np.random.default_rng(4).normal(0, 20, pixels.shape)
    np.save("a.npy", pixels + pattern)
    np.save("dark.npy", pattern + 20)
    out = run.ok("layout", "a.npy", "-o", "new.toml", "--dark", "dark.npy").out
    assert "without the dark" not in out
    assert len(Layout.load("new.toml")) == len(spots)
