"""Recordings whose spots leave their windows: command, resuming, report, wavefront."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.frames.following import Case, Recording, recording
from tests.cli.cli_cases import Commands
from tests.refusals import refused
from tests.slopes.recorded.recorded_cases import Page

import faintspot as fs
from faintspot.io import read_slopes
from faintspot.slopes.pipeline import configuration
from faintspot.slopes.recorded.measuring import measure_recorded
from faintspot.slopes.recorded.stored import report_of_stored

pytestmark = pytest.mark.usefixtures("undrawn_pictures")


@pytest.fixture(scope="module")
def made() -> Recording:
    return recording(3001, Case(frames=12, order=2))


@pytest.fixture
def record(made: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recording:
    """Write frames and configuration."""
    monkeypatch.chdir(tmp_path)
    pipeline = made.pipeline()
    np.save("frames.npy", made.frames)
    Path("faintspot.toml").write_text(
        configuration.to_text(pipeline.layout, pipeline.settings, pipeline.calibration)
    )
    return made


@pytest.mark.slow
def test_the_command_follows(record: Recording, run: Commands) -> None:
    pytest.importorskip("zarr")
    run.ok("slopes", "frames.npy", "-o", "s.zarr", "--follow")
    stored, expected = read_slopes("s.zarr"), fs.SpotFollower(record.pipeline())(record.frames)
    assert stored.attributes["followed"]
    for variable, values in expected.variables.items():
        np.testing.assert_array_equal(stored.variables[variable], values)
    assert np.abs(expected.x).max() > 20  # a pitch, which is a window
    # The wavefront is that of the true displacements: all of them are low modes.
    wavefront = fs.fit_wavefront(expected, record.layout, modes=6)
    truth = fs.Slopes(**{**vars(expected), "x": record.truth[..., 0], "y": record.truth[..., 1]})
    np.testing.assert_allclose(
        wavefront.coefficients, fs.fit_wavefront(truth, record.layout, modes=6).coefficients, atol=0.05
    )
    run.ok("wavefront", "s.zarr", "-o", "w.json")


def test_resumed_it_is_the_same(record: Recording) -> None:
    pytest.importorskip("zarr")

    def stop(finished: int, total: int) -> None:
        if finished >= 8:
            raise KeyboardInterrupt

    options: dict[str, Any] = {"follow": True, "block_frames": 4}
    with pytest.raises(KeyboardInterrupt):
        measure_recorded(["frames.npy"], "faintspot.toml", "s.zarr", progress=stop, **options)
    summary = measure_recorded(["frames.npy"], "faintspot.toml", "s.zarr", **options)
    assert (summary.resumed_at, summary.measured) == (8, 4 * len(record.layout))
    expected = fs.SpotFollower(record.pipeline())(record.frames)
    np.testing.assert_array_equal(read_slopes("s.zarr").variables["x"], expected.x)
    with refused("s.zarr", "--overwrite"):
        measure_recorded(["frames.npy"], "faintspot.toml", "s.zarr")


@pytest.mark.slow
def test_the_report_has_the_paths(record: Recording) -> None:
    measure_recorded(["frames.npy"], "faintspot.toml", "s.npz", follow=True)
    report = report_of_stored(["s.npz"])
    text = Page(report).text
    assert "Spots followed out of their windows" in text
    assert "largest valid displacement is 1." in text
    Path("frames.npy").unlink()
    assert "Not drawn: " in Page(report_of_stored(["s.npz"])).text
