"""Recorded frames to slopes: blocks, resuming, what the output says about its origin."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, LAYOUT, assert_equal, expected, simulated
from tests.patience import mostly_slow
from tests.refusals import refused

import faintspot
from faintspot.io import read_slopes
from faintspot.slopes.recorded.measuring import measure_recorded


class Stopped(Exception):
    pass


class Recording(NamedTuple):
    frames: Path
    configuration: Path
    output: Path

    def measure(self, **options: Any) -> Any:
        return measure_recorded([self.frames], self.configuration, self.output, **options)

    def stop_after(self, frames: int, **options: Any) -> None:
        """Stop a run after some of its frames."""

        def progress(finished: int, total: int) -> None:
            assert total == 30
            if finished >= frames:
                raise Stopped

        with pytest.raises(Stopped):
            self.measure(progress=progress, **{"block_frames": 3, **options})


@pytest.fixture
def made(tmp_path: Path) -> Recording:
    np.save(tmp_path / "a.npy", simulated())
    (tmp_path / "c.toml").write_text(CONFIGURATION)
    return Recording(tmp_path / "a.npy", tmp_path / "c.toml", tmp_path / "s.npz")


def test_blocks_and_progress(made: Recording) -> None:
    calls: list[tuple[int, int]] = []
    summary = made.measure(block_frames=8, progress=lambda *counts: calls.append(counts))
    assert calls == [(8, 30), (16, 30), (24, 30), (30, 30)]
    assert (summary.n_frames, summary.n_subapertures, summary.resumed_at) == (30, 16, 0)
    assert (summary.measured, summary.bad_frames) == (480, 0)
    assert_equal(made.output, expected(simulated()))


@pytest.mark.parametrize(
    ("name", "stops"),
    mostly_slow(1, [("s.zarr", (1,)), ("s.fits", (7, 20)), ("s.npz", (30,)), ("s.csv", (30,))]),
)
def test_stopped_anywhere_it_goes_on(made: Recording, name: str, stops: tuple[int, ...]) -> None:
    pytest.importorskip("zarr")
    pytest.importorskip("astropy")
    made = made._replace(output=made.output.with_name(name))
    for stop in stops:
        made.stop_after(stop)
    if name != "s.csv":  # complete, and a .csv does not say of which run
        summary = made.measure(block_frames=4)
        assert summary.resumed_at >= stops[-1]
        assert summary.measured == 16 * (30 - summary.resumed_at)
    assert_equal(made.output, expected(simulated()))


def test_another_run_does_not_go_on_with_this_one(made: Recording) -> None:
    made.stop_after(6)
    others: list[tuple[dict[str, Any], str, Any]] = [
        ({"denoise": False}, CONFIGURATION, simulated()),
        ({"reference": np.full((16, 2), 0.1)}, CONFIGURATION, simulated()),
        ({}, CONFIGURATION.replace("2.0", "2.5"), simulated()),
        ({}, CONFIGURATION, simulated(seed=2)),
        ({}, CONFIGURATION, simulated()[:29]),
    ]
    for options, text, frames in others:
        made.configuration.write_text(text)
        np.save(made.frames, frames)
        with refused("s.npz", "--overwrite"):
            made.measure(**options)
    assert not made.output.exists()


def test_threads_and_block_do_not_make_another_run(made: Recording) -> None:
    made.stop_after(6)
    assert made.measure(block_frames=5, threads=1).resumed_at == 6


def test_the_output_says_where_it_comes_from(made: Recording) -> None:
    made.measure(reference=np.zeros(32))
    stored = read_slopes(made.output)
    assert stored.attributes["sources"] == [str(made.frames.resolve())]
    assert stored.attributes["configuration_file"] == str(made.configuration.resolve())
    assert stored.attributes["faintspot_version"] == faintspot.__version__
    assert stored.attributes["reference"] == [0.0] * 32
    assert "noise_std = 2.0" in stored.attributes["configuration"]
    np.testing.assert_array_equal(stored.coordinates["centre_x"], LAYOUT.centres[:, 0])
    np.testing.assert_array_equal(stored.coordinates["row"], LAYOUT.cells[:, 0])


@pytest.mark.slow
def test_mean_flux_of_the_recording(made: Recording) -> None:
    """Told to the pipeline, and the same again after a stop."""
    changes: dict[str, Any] = {"estimator": "window", "spot_fwhm_px": 2.0}
    told: dict[str, Any] = {"changes": changes, "mean_flux": True}
    made.stop_after(8, **told, block_frames=8)
    assert made.measure(**told).resumed_at == 8
    described = faintspot.slopes.pipeline.configuration.Configuration(made.configuration)
    settings = described.settings.replace(**changes)
    pipeline = faintspot.SlopePipeline(described.layout, settings, described.calibration)
    flux = faintspot.MeanFlux(pipeline(simulated()).flux)
    expected_slopes = pipeline.with_flux(flux)(simulated())
    np.testing.assert_array_equal(read_slopes(made.output).variables["x"], expected_slopes.x)
    assert np.ptp(expected_slopes.flux / flux.flux_e) > 0.01  # the flux of frames differs


def test_mean_flux_of_an_estimator_that_does_not_use_it(made: Recording) -> None:
    with refused("'brightest'"):
        made.measure(changes={"estimator": "brightest"}, mean_flux=True)


def test_frames_written_twice_are_counted(made: Recording) -> None:
    """Across blocks, too."""
    np.save(made.frames, np.repeat(simulated(), 2, axis=0))
    assert made.measure(block_frames=3).repeated_frames == 30


@pytest.mark.parametrize("away", mostly_slow(1, [-19.0, 400.0]))
def test_estimated_dark_of_other_frames_is_moved(made: Recording, away: float) -> None:
    """An estimated dark that does not fit gives the slopes of one that does; a stated one is named."""
    text = CONFIGURATION + "\n[calibration]\ndark = {}\n"
    made.configuration.write_text(text.format(20.0))
    made.measure(overwrite=True)
    right = read_slopes(made.output).variables
    made.configuration.write_text(text.format(20.0 - away) + 'estimated = ["dark"]\n')
    summary = made.measure(overwrite=True)
    assert any("background" in note for note in summary.notes)
    moved = read_slopes(made.output).variables
    assert moved["valid"].mean() > right["valid"].mean() - 0.01
    assert np.abs(moved["x"] - right["x"])[moved["valid"] & right["valid"]].mean() < 0.1
    made.configuration.write_text(text.format(420.0))
    summary = made.measure(overwrite=True)
    assert any("420" in note for note in summary.notes)
