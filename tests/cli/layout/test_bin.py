"""faintspot layout --bin: large windows and colour mosaics, from frames to slopes in the camera's pixels."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.cli.cli_cases import Commands

from faintspot import Layout
from faintspot.io import read_slopes

pytest.importorskip("matplotlib")


def frames_of(side: int, n: int, pitch: float, sigma: float, flux: float, tilt: float) -> NDArray[np.float64]:
    """Two frames of n x n spots, without noise; in the second they are displaced by tilt along x."""
    v, u = np.mgrid[:side, :side] - (side - 1) / 2
    places = (np.arange(n) - (n - 1) / 2) * pitch
    frames = np.zeros((2, side, side))
    for frame, shift in zip(frames, (0.0, tilt), strict=True):
        for y in places:
            for x in places:
                frame += np.exp(-((u - x - shift) ** 2 + (v - y) ** 2) / (2 * sigma**2))
    return frames * flux / (2 * np.pi * sigma**2)


def measured(run: Commands, frames: NDArray[np.float64], *options: str | float) -> tuple[float, float, float]:
    """Return how much x rises from the first frame to the second, the mean flux and the valid part."""
    rng = np.random.default_rng(1)
    noisy = (rng.poisson(frames + 5) + rng.normal(100, 2, frames.shape)).round().astype(np.uint16)
    np.save("frames.npy", noisy)
    np.save("first.npy", noisy[:1])
    run.ok("layout", "first.npy", "-o", "new.toml", *options)
    run.ok("slopes", "frames.npy", "-c", "new.toml", "-o", "new.npz")
    slopes = read_slopes("new.npz").variables
    rise = float((slopes["x"][1] - slopes["x"][0]).mean())
    return rise, float(slopes["flux"].mean()), float(slopes["valid"].mean())


@pytest.mark.slow
@pytest.mark.usefixtures("only_found")
def test_binned_colour_mosaic_is_measured(folder: Path, run: Commands) -> None:
    frames = frames_of(220, 9, 20.3, 1.5, 5000.0, 2.0)
    rows, columns = np.indices(frames.shape[1:]) % 2
    frames *= np.where(rows != columns, 0.25, np.where(rows == 0, 1.0, 0.05))
    rise, flux, valid = measured(run, frames, "--bin", 2)
    assert rise == pytest.approx(2.0, abs=0.03)
    # 3.8 % high: most of the flux is in one pixel of four, and the flux under the weight is scaled for
    # Gaussian spots, which these are not. The sum over a window is right to 0.3 %.
    assert flux == pytest.approx(5000 * 1.55 / 4, rel=0.05)
    assert valid == 1
    layout = Layout.load("new.toml")
    assert (layout.bin, layout.frame_shape) == (2, (220, 220))
    assert layout.pitch_px == pytest.approx(20.3, abs=0.02)


@pytest.mark.slow
@pytest.mark.usefixtures("no_trials", "undrawn_pictures")
def test_windows_over_64_px(folder: Path, run: Commands) -> None:
    frames = frames_of(480, 3, 150.0, 6.0, 20_000.0, 5.0)
    rise, flux, valid = measured(run, frames, "--bin", 3, "--pitch-px", 150)
    assert rise == pytest.approx(5.0, abs=0.05)
    assert flux == pytest.approx(20_000, rel=0.02)
    assert valid == 1
    layout = Layout.load("new.toml")
    assert (layout.window, layout.pitch_px) == ((150, 150), 150.0)
    np.testing.assert_allclose(layout.centres[[0, -1]], [[89.5, 89.5], [389.5, 389.5]], atol=0.1)
    run.ok("report", "new.npz")


@pytest.mark.usefixtures("only_found")
def test_stated_grid_is_binned(folder: Path, run: Commands) -> None:
    frames = frames_of(240, 3, 80.0, 4.0, 20_000.0, 3.0)
    rise, _, valid = measured(run, frames, "--bin", 2, "--grid", "3x3", "--pupil", "119.5,119.5,200")
    assert rise == pytest.approx(3.0, abs=0.05)
    assert valid == 1
    assert Layout.load("new.toml").window == (80, 80)
