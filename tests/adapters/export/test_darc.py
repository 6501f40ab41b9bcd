"""Exported parameters, used as DARC's manual says they are, give the pipeline's slopes and commands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from tests.adapters.export.export_cases import CALIBRATION, LAYOUT, OFF_CENTRE, frames, other_weights, written
from tests.cli.cli_cases import Commands

import faintspot as fs
from faintspot.adapters.export import export_darc
from faintspot.adapters.export.darc import interleaved
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.compiled import CompiledIntegrator
from faintspot.loop.control.configuration import ControlOptions, load_control, save_control
from faintspot.slopes.pipeline import configuration

N = len(LAYOUT)
REFERENCE = np.random.default_rng(6).uniform(-0.3, 0.3, (N, 2))
SETTINGS = {
    "brightest": fs.Settings("brightest", keep_brightest=[5, 9, 20, 30]),
    "threshold": fs.Settings("brightest", keep_brightest=12, rule="threshold"),
    "kth": fs.Settings("brightest", keep_brightest=12, rule="subtract_kth"),
    "auto": fs.Settings("brightest", keep_brightest="auto", flux_e=400.0, spot_fwhm_px=2.0),
    "thresholded": fs.Settings("thresholded", threshold_e=[1.0, 2.0, 3.0, 4.0]),
    "centroid": fs.Settings("centroid"),
    "window": fs.Settings("window", spot_fwhm_px=2.2, normalisation="frame"),
}


def read(folder: Path) -> dict[str, Any]:
    """Return the parameters of a folder by name."""
    values: dict[str, Any] = {}
    for line in (folder / "parameters.txt").read_text().splitlines():
        name, value, _ = line.split("\t")
        file = folder / value.split(" ")[0]
        if file.suffix == ".fits":
            with fits.open(file) as units:
                values[name] = units[0].data.astype(units[0].data.dtype.newbyteorder("="))
        else:
            values[name] = np.load(file) if file.suffix == ".npy" else value
    return values


def slopes_of(values: dict[str, Any], frame: NDArray[Any]) -> NDArray[Any]:
    """Slopes as the manual has them: calibration, threshold, weights, brightest pixels, centre of gravity."""
    width = int(values["npxlx"][0])
    pixels = (frame.reshape(-1).astype(np.float64) - values["darkNoise"]) * values["flatField"]
    found = []
    for s, (top, bottom, down, left, right, across) in enumerate(values["subapLocation"]):
        assert values["subapFlag"][s] == 1
        chosen = (slice(top, bottom, down), slice(left, right, across))
        image = pixels.reshape(-1, width)[chosen].copy()
        if int(values["thresholdAlgo"]) == 2:
            image = np.maximum(image - values["thresholdValue"][s], 0.0)
        if "pxlWeight" in values:
            image *= values["pxlWeight"].reshape(-1, width)[chosen]
        brightest, ranked = int(values["useBrightest"][s]), np.sort(image, axis=None)[::-1]
        if brightest > 0:
            image[image < ranked[brightest - 1]] = 0.0
        elif brightest < 0:
            image = np.maximum(image - ranked[-brightest], 0.0)
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
        for along in (columns, rows):  # x, y, x, y
            found.append((along * image).sum() / image.sum() - 0.5 * (image.shape[0] - 1))
    return np.asarray(np.array(found) - values["refCentroids"])


@pytest.mark.parametrize("form", ["fits", "npy"])
@pytest.mark.parametrize("name", SETTINGS)
def test_slopes(tmp_path: Path, name: str, form: str) -> None:
    path = written(tmp_path, SETTINGS[name], OFF_CENTRE)
    export_darc(path, tmp_path / "darc", reference=REFERENCE, form=form)
    values = read(tmp_path / "darc")
    pipeline = fs.SlopePipeline(OFF_CENTRE, SETTINGS[name], CALIBRATION, REFERENCE)
    for frame in frames(3):
        slopes = pipeline(frame)
        ours, theirs = interleaved(np.concatenate([slopes.x, slopes.y])), slopes_of(values, frame)
        if name == "window":  # a weighted centre of gravity moves less than the spot
            assert values["slope_gain"].min() > 1.1
            theirs = values["slope_gain"] * theirs
        np.testing.assert_allclose(theirs, ours, atol=1e-4)  # float32 sums


def test_types_and_places(tmp_path: Path) -> None:
    export_darc(written(tmp_path, SETTINGS["brightest"]), tmp_path / "darc")
    values = read(tmp_path / "darc")
    assert values["subapLocation"].tolist()[1] == [2, 10, 1, 21, 29, 1]
    assert values["pxlCnt"].tolist() == [10 * 41, 10 * 41, 20 * 41, 30 * 41]
    assert values["useBrightest"].tolist() == [-5, -9, -20, -30]
    assert values["npxlx"] == 41
    assert values["npxly"] == 30
    for name in ("subapLocation", "pxlCnt", "subapFlag", "useBrightest", "nsub", "npxlx", "npxly"):
        assert values[name].dtype == np.int32, name
    for name in ("darkNoise", "flatField", "thresholdValue", "refCentroids"):
        assert values[name].dtype == np.float32, name


def test_bad_pixels_count_nothing(tmp_path: Path) -> None:
    camera = fs.Calibration(dark=100.0, bad_pixels=[[3, 4]], read_noise_e=1.0)
    export_darc(written(tmp_path, SETTINGS["centroid"], calibration=camera), tmp_path / "darc")
    gain = read(tmp_path / "darc")["flatField"].reshape(LAYOUT.frame_shape)
    assert gain[3, 4] == 0.0
    assert np.count_nonzero(gain != 1.0) == 1


@pytest.mark.parametrize("name", ["brightest", "window"])
def test_commands(tmp_path: Path, name: str) -> None:
    rng = np.random.default_rng(8)
    path = written(tmp_path, SETTINGS[name])
    interaction = rng.normal(size=(2 * N, 3))
    np.savez(tmp_path / "matrix.npz", interaction=interaction, reference=REFERENCE)
    save_control(
        path,
        interaction_matrix="matrix.npz:interaction",
        reference_slopes="matrix.npz:reference",
        gain=0.3,
        leak=0.02,
        centroid_gain=0.9,
    )
    export_darc(path, tmp_path / "darc")
    values = read(tmp_path / "darc")
    assert values["rmx"].shape == (3, 2 * N)
    control = load_control(path)
    assert control is not None
    line = CommandDelayLine(3, 1, 1e9)
    integrator = CompiledIntegrator(line, interaction, control.reconstructor.matrix, 0.3, 0.02)
    pipeline = fs.SlopePipeline(LAYOUT, SETTINGS[name], CALIBRATION, REFERENCE)
    theirs = np.zeros(3)
    for frame in frames(3):
        slopes = pipeline(frame)
        integrator.update(np.concatenate([slopes.x, slopes.y]).astype(float) / 0.9, np.ones(2 * N))
        moved = values["gain"] * (values["rmx"] @ slopes_of(values, frame))
        theirs = values["decayFactor"] * theirs + moved
        np.testing.assert_allclose(theirs, line.latest, atol=1e-3 * np.abs(line.latest).max())
    # What a command moves, rmx undoes, as well as our regularised reconstructor does.
    undone = values["rmx"] @ values["interaction"].T
    np.testing.assert_allclose(undone, -control.reconstructor.matrix @ interaction, atol=1e-4)


def test_no_control(tmp_path: Path) -> None:
    path = written(tmp_path, SETTINGS["brightest"])
    np.save(tmp_path / "matrix.npy", np.ones((2 * N + 2, 3)))
    save_control(path, interaction_matrix="matrix.npy")
    with pytest.raises(fs.InputError, match="expected 8 rows"):
        export_darc(path, tmp_path / "darc")
    parameters = export_darc(path, tmp_path / "darc", control=False)
    assert "rmx" not in {parameter.name for parameter in parameters}


def test_another_controller_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Modal:
        model, options = object(), ControlOptions(controller="modal")

    monkeypatch.setattr("faintspot.adapters.export.sensor.load_control", lambda path: Modal())
    with pytest.raises(fs.InputError, match="'modal': expected 'integrator'"):
        export_darc(written(tmp_path, SETTINGS["brightest"]), tmp_path / "darc")


@pytest.mark.parametrize(
    ("settings", "naming"),
    [
        (fs.Settings("tv", noise_std=1.0), "'tv': expected 'brightest'"),
        (fs.Settings("brightest", keep_brightest="auto", spot_fwhm_px=2.0), "flux_e"),
        (fs.Settings("brightest", keep_brightest=1, rule="subtract_kth"), "at least 2"),
    ],
)
def test_refused(tmp_path: Path, settings: fs.Settings, naming: str) -> None:
    with pytest.raises(fs.InputError, match=naming):
        export_darc(written(tmp_path, settings), tmp_path / "darc")


def test_two_maps_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, SETTINGS["window"])
    configuration.save(path, other_weights(9))
    with pytest.raises(fs.InputError, match="one map of weights"):
        export_darc(path, tmp_path / "darc")


def test_command(run: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, SETTINGS["window"])
    result = run.ok("export", "darc", "--format", "npy")
    assert "pxlWeight" in result.out
    assert (tmp_path / "darc" / "pxlWeight.npy").exists()
    run.refused("export", "darc", naming=("darc: already exists",))
    assert "WEIGHTS" in run.ok("export", "weights", "-o", "w.fits").out
