"""Recorded frames to slopes: blocks, resuming, what the output says about its origin."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import CONFIGURATION, LAYOUT, assert_equal, expected, simulated

import faintspot
from faintspot import InputError
from faintspot.io import read_slopes
from faintspot.slopes.recorded.measuring import measure_recorded


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path, Path]:
    """Return frames, configuration and output."""
    np.save(tmp_path / "a.npy", simulated())
    (tmp_path / "c.toml").write_text(CONFIGURATION)
    return tmp_path / "a.npy", tmp_path / "c.toml", tmp_path / "s.npz"


class Stopped(Exception):
    pass


def stop_after(frames: int) -> Any:
    def progress(finished: int, total: int) -> None:
        assert total == 30
        if finished >= frames:
            raise Stopped

    return progress


def test_blocks_and_progress(files: tuple[Path, Path, Path]) -> None:
    frames, configuration, output = files
    calls: list[tuple[int, int]] = []
    summary = measure_recorded(
        [frames], configuration, output, block_frames=8, progress=lambda *counts: calls.append(counts)
    )
    assert calls == [(8, 30), (16, 30), (24, 30), (30, 30)]
    assert (summary.n_frames, summary.n_subapertures, summary.resumed_at) == (30, 16, 0)
    assert (summary.measured, summary.bad_frames) == (480, 0)
    assert_equal(output, expected(simulated()))


@pytest.mark.parametrize(
    ("name", "stops"), [("s.zarr", (1,)), ("s.fits", (7, 20)), ("s.npz", (30,)), ("s.csv", (30,))]
)
def test_stopped_anywhere_it_goes_on(
    files: tuple[Path, Path, Path], name: str, stops: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zarr")
    pytest.importorskip("astropy")
    frames, configuration, output = files[0], files[1], files[2].with_name(name)
    for stop in stops:
        with pytest.raises(Stopped):
            measure_recorded([frames], configuration, output, block_frames=3, progress=stop_after(stop))
    if name == "s.csv":  # complete, and a .csv does not say of which run
        assert_equal(output, expected(simulated()))
        return
    summary = measure_recorded([frames], configuration, output, block_frames=4)
    assert summary.resumed_at >= stops[-1]
    assert summary.measured == 16 * (30 - summary.resumed_at)
    assert_equal(output, expected(simulated()))


@pytest.mark.parametrize(
    "change",
    [
        {"denoise": False},
        {"reference": np.full((16, 2), 0.1)},
        {"configuration": CONFIGURATION.replace("2.0", "2.5")},
        {"frames": simulated(seed=2)},
        {"frames": simulated()[:29]},
    ],
    ids=["denoise", "reference", "settings", "frames", "fewer frames"],
)
def test_another_run_does_not_go_on_with_this_one(files: tuple[Path, Path, Path], change: Any) -> None:
    frames, configuration, output = files
    with pytest.raises(Stopped):
        measure_recorded([frames], configuration, output, block_frames=3, progress=stop_after(6))
    if "configuration" in change:
        configuration.write_text(change.pop("configuration"))
    if "frames" in change:
        np.save(frames, change.pop("frames"))
    with pytest.raises(InputError, match="another run"):
        measure_recorded([frames], configuration, output, **change)
    assert not output.exists()


def test_threads_and_block_do_not_make_another_run(files: tuple[Path, Path, Path]) -> None:
    frames, configuration, output = files
    with pytest.raises(Stopped):
        measure_recorded([frames], configuration, output, block_frames=3, progress=stop_after(6))
    assert measure_recorded([frames], configuration, output, block_frames=5, threads=1).resumed_at == 6


def test_the_output_says_where_it_comes_from(files: tuple[Path, Path, Path]) -> None:
    frames, configuration, output = files
    measure_recorded([frames], configuration, output, reference=np.zeros(32))
    stored = read_slopes(output)
    assert stored.attributes["sources"] == [str(frames.resolve())]
    assert stored.attributes["configuration_file"] == str(configuration.resolve())
    assert stored.attributes["faintspot_version"] == faintspot.__version__
    assert stored.attributes["reference"] == [0.0] * 32
    assert "noise_std = 2.0" in stored.attributes["configuration"]
    np.testing.assert_array_equal(stored.coordinates["centre_x"], LAYOUT.centres[:, 0])
    np.testing.assert_array_equal(stored.coordinates["row"], LAYOUT.cells[:, 0])


@pytest.mark.slow
def test_mean_flux_of_the_recording(files: tuple[Path, Path, Path]) -> None:
    """Told to the pipeline, and the same again after a stop."""
    frames, configuration, output = files
    changes: dict[str, Any] = {"estimator": "window", "spot_fwhm_px": 2.0}
    told: dict[str, Any] = {"changes": changes, "mean_flux": True}
    with pytest.raises(Stopped):
        measure_recorded([frames], configuration, output, **told, block_frames=8, progress=stop_after(8))
    assert measure_recorded([frames], configuration, output, **told).resumed_at == 8
    described = faintspot.slopes.pipeline.configuration.Configuration(configuration)
    settings = described.settings.replace(**changes)
    pipeline = faintspot.SlopePipeline(described.layout, settings, described.calibration)
    flux = faintspot.MeanFlux(pipeline(simulated()).flux)
    expected_slopes = pipeline.with_flux(flux)(simulated())
    np.testing.assert_array_equal(read_slopes(output).variables["x"], expected_slopes.x)
    assert np.ptp(expected_slopes.flux / flux.flux_e) > 0.01  # the flux of frames differs


def test_mean_flux_of_an_estimator_that_does_not_use_it(files: tuple[Path, Path, Path]) -> None:
    frames, configuration, output = files
    with pytest.raises(InputError, match="'brightest' does not use the flux"):
        measure_recorded([frames], configuration, output, changes={"estimator": "brightest"}, mean_flux=True)


def test_frames_written_twice_are_counted(files: tuple[Path, Path, Path]) -> None:
    """Across blocks, too."""
    frames, configuration, output = files
    np.save(frames, np.repeat(simulated(), 2, axis=0))
    assert measure_recorded([frames], configuration, output, block_frames=3).repeated_frames == 30


@pytest.mark.parametrize("away", [-19.0, 400.0])
def test_estimated_dark_of_other_frames_is_moved(files: tuple[Path, Path, Path], away: float) -> None:
    """An estimated dark that does not fit gives the slopes of one that does; a stated one is named."""
    frames, configuration, output = files
    text = CONFIGURATION + "\n[calibration]\ndark = {}\n"
    configuration.write_text(text.format(20.0))
    measure_recorded([frames], configuration, output, overwrite=True)
    right = read_slopes(output).variables
    configuration.write_text(text.format(20.0 - away) + 'estimated = ["dark"]\n')
    summary = measure_recorded([frames], configuration, output, overwrite=True)
    assert any("background" in note for note in summary.notes)
    moved = read_slopes(output).variables
    assert moved["valid"].mean() > right["valid"].mean() - 0.01
    assert np.abs(moved["x"] - right["x"])[moved["valid"] & right["valid"]].mean() < 0.1
    configuration.write_text(text.format(420.0))
    summary = measure_recorded([frames], configuration, output, overwrite=True)
    assert any("420" in note for note in summary.notes)
