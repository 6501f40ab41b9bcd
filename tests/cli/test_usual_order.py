"""Layout on a flat frame, then slopes and wavefront of others: right values, and lost spots are left out."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.cli.cli_cases import Commands

from faintspot.io import read_slopes

SIDE, PITCH = 7, 22
N = SIDE * PITCH + 40
CELLS = np.argwhere(np.ones((SIDE, SIDE))) - (SIDE - 1) / 2


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Commands:
    return Commands(capsys)


def frame(tilt_px: float, lost: tuple[int, ...] = ()) -> NDArray[np.float32]:
    """Frame of spots of 5000 ADU, displaced along x."""
    rng, axis = np.random.default_rng(1), np.arange(N) - (N - 1) / 2
    light = np.full((N, N), 5.0)
    for number, (row, column) in enumerate(CELLS * PITCH):
        along, across = (np.exp(-((axis - at) ** 2) / 4.5) for at in (column + tilt_px, row))
        light += (0.0 if number in lost else 5000 / (4.5 * np.pi)) * np.outer(across, along)
    return np.asarray(rng.poisson(light) + rng.normal(100, 3, light.shape), np.float32)


def test_large_tilts_and_lost_spots(
    tmp_path: Path, run: Commands, monkeypatch: pytest.MonkeyPatch, coarse_pictures: None
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("flat.npy", frame(0.0))
    np.save("large.npy", frame(7.0))
    np.save("lost.npy", frame(2.0, lost=(0, 3, 17, 30, 48)))
    run.ok("layout", "flat.npy", "-o", "f.toml")
    for name, tilt_px, lost in (("large", 7.0, 0), ("lost", 2.0, 5)):
        run.ok("slopes", f"{name}.npy", "-c", "f.toml", "-o", f"{name}.npz")
        variables = read_slopes(tmp_path / f"{name}.npz").variables
        valid = variables["valid"][0]
        assert np.count_nonzero(~valid) == lost
        np.testing.assert_allclose(variables["x"][0, valid], tilt_px, atol=0.2)
        np.testing.assert_allclose(variables["y"][0, valid], 0.0, atol=0.2)
    lines = run.ok("wavefront", "lost.npz", "--modes", "4").out.splitlines()
    assert [line for line in lines if line.startswith("Left out") and "dark" in line]
