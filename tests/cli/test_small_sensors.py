"""Sensors of one spot and of 2 x 2, from frames to commands."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.frames.simulated_arrays import gaussians
from numpy.typing import NDArray
from tests.cli.cli_cases import Commands

import faintspot as fs
from faintspot.io import read_slopes
from faintspot.loop.control import Recording, learn

FRAMES = 40


def tilted(n: int) -> tuple[NDArray[np.float32], NDArray[np.complex128]]:
    """Return frames of n x n spots, turned by 20 degrees, and their common displacement x + iy."""
    rng = np.random.default_rng(1)
    rows, columns = np.indices((n, n)).reshape(2, -1) - 0.5 * (n - 1)
    at = 12 * np.exp(0.35j) * (columns + 1j * rows) + 15.7 + 15.4j
    tilt = 0.3 * (rng.standard_normal(FRAMES) + 1j * rng.standard_normal(FRAMES))
    tilt -= tilt.mean()
    images = [gaussians((32, 32), at + step, 2000.0, 1.4) for step in tilt]
    noisy = rng.poisson(images) + rng.normal(0, 3, (FRAMES, 32, 32))
    return noisy.astype(np.float32), np.asarray(tilt, np.complex128)


@pytest.mark.parametrize("n", [1, 2])
def test_slopes_are_the_tilt(n: int) -> None:
    frames, tilt = tilted(n)
    layout = fs.Layout.from_frame(frames)
    assert len(layout) == n * n
    slopes = fs.SlopePipeline(layout, fs.Settings(estimator="brightest", keep_brightest=25))(frames)
    measured = slopes.x + 1j * slopes.y
    np.testing.assert_allclose(measured - measured.mean(axis=0), np.tile(tilt[:, None], n * n), atol=0.1)


def test_modes_that_four_spots_tell(folder: Path, run: Commands, no_picture: None) -> None:
    """Tip, tilt, focus and astigmatism, as eight slopes tell."""
    np.save("a.npy", tilted(2)[0])
    optics = ("--pitch-px", "12", "--diameter-m", "1", "--pixel-scale-arcsec", "0.5")
    assert "array of 2 x 2" in run.ok("layout", "a.npy", "-o", "new.toml", *optics).out
    run.ok("slopes", "a.npy", "--config", "new.toml", "-o", "s.npz")
    assert read_slopes("s.npz").variables["x"].shape == (FRAMES, 4)
    assert "Z2 to Z6" in run.ok("wavefront", "s.npz", "--modes", "5").out


@pytest.mark.slow
def test_telemetry_of_four_spots(folder: Path, run: Commands, no_picture: None) -> None:
    np.save("a.npy", np.tile(tilted(2)[0], (6, 1, 1)))
    run.ok("layout", "a.npy", "-o", "new.toml", "--diameter-m", "1", "--pixel-scale-arcsec", "0.5")
    run.ok("slopes", "a.npy", "--config", "new.toml", "-o", "s.npz")
    run.ok("telemetry", "s.npz", "--frame-rate-hz", "200", "-o", "t.html")


def recorded(n: int, cells: Any, modes: int) -> Recording:
    """Return a loop of n x n sub-apertures and the first modes, under waves that the wind carries."""
    rng = np.random.default_rng(1)
    all_cells = np.argwhere(np.ones((n, n)))
    y, x = (all_cells - (n - 1) / 2).T
    one, none = np.ones(n * n), np.zeros(n * n)
    of_modes = ((one, none, 2 * x, y, x), (none, one, 2 * y, x, -y))
    matrix = np.vstack([np.column_stack(slopes)[:, :modes] for slopes in of_modes])
    waves, phases = 0.7 * rng.standard_normal((40, 2)), 6 * rng.random(40)
    moved = all_cells - 0.05 * np.arange(800)[:, None, None]
    heights = -np.sin(moved @ waves.T + phases) / np.hypot(*waves.T)
    turbulence = np.concatenate([heights @ waves[:, 1], heights @ waves[:, 0]], axis=1)
    turbulence += 0.1 * rng.standard_normal(turbulence.shape)
    slopes, commands = np.zeros_like(turbulence), np.zeros((800, modes))
    for k in range(2, 800):
        slopes[k] = turbulence[k] + matrix @ commands[k - 2]
        commands[k] = 0.99 * commands[k - 1] - 0.3 * np.linalg.pinv(matrix) @ slopes[k]
    return Recording(slopes, commands, matrix, all_cells if cells else None, frame_rate_hz=250)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "cells", "modes"), [(1, False, 2), (2, True, 5)])
def test_control_is_learnt(n: int, cells: bool, modes: int) -> None:
    control = learn(recorded(n, cells, modes))
    assert control(np.zeros(2 * n * n)).shape == (modes,)


@pytest.mark.slow
def test_the_engine_measures_four_spots(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pyshmem")
    from tests.engine import bench

    frames = tilted(2)[0][:3]
    monkeypatch.setattr(bench, "LAYOUT", fs.Layout.from_frame(frames))
    with bench.Bench() as engine:
        engine.measure(frames)
        for number, expected in enumerate(bench.make(bench.SETTINGS)(frames).vector):
            np.testing.assert_array_equal(engine.slopes[number], expected)
