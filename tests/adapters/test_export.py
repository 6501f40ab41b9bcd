"""Exported weights and matrices: slopes and commands follow from the file alone."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from tests.adapters.export_cases import CALIBRATION, LAYOUT, OFF_CENTRE, frames, other_weights, written

import faintspot as fs
from faintspot.adapters.export import export_fits
from faintspot.loop.control.commands import CommandDelayLine
from faintspot.loop.control.compiled import CompiledIntegrator
from faintspot.loop.control.configuration import load_control, save_control
from faintspot.slopes.pipeline import configuration

RNG = np.random.default_rng(5)
REFERENCE = RNG.uniform(-0.3, 0.3, (len(LAYOUT), 2))
RANDOM = other_weights(7)
LINES = np.arange(8.0) - 3.5
CELL = fs.FixedWeights(
    0.7 * LINES * np.ones((8, 8)), 0.7 * LINES[:, None] * np.ones((8, 8)), np.full((8, 8), 1 / 64)
)


def electrons(frame: NDArray[Any]) -> NDArray[Any]:
    dark, scale = CALIBRATION.maps(LAYOUT.frame_shape)
    return LAYOUT.images((frame - dark) * scale).astype(np.float64)


def centre_of_gravity(images: NDArray[Any], weights: NDArray[Any]) -> NDArray[Any]:
    """Weighted centre of gravity from the window's middle, (n, 2), as a controller computes it."""
    weighted = images * weights
    rows, columns = (np.arange(side) - 0.5 * (side - 1) for side in images.shape[1:])
    flux = weighted.sum(axis=(1, 2))
    x, y = ((weighted * along).sum(axis=(1, 2)) / flux for along in (columns, rows[:, None]))
    return np.stack([x, y], axis=1)


@pytest.mark.parametrize("reference", [None, REFERENCE])
@pytest.mark.parametrize("layout", [LAYOUT, OFF_CENTRE])
def test_weighted_centre_of_gravity(tmp_path: Path, reference: Any, layout: fs.Layout) -> None:
    settings = fs.Settings("window", spot_fwhm_px=2.2, normalisation="frame")
    path = written(tmp_path, settings, layout)
    export_fits(path, tmp_path / "weights.fits", reference=reference)
    pipeline = fs.SlopePipeline(layout, settings, CALIBRATION, reference)
    with fits.open(tmp_path / "weights.fits", checksum=True) as file:
        assert np.array_equal(file["CORNERS"].data, layout.corners)
        weights, gain, home = (file[name].data for name in ("WEIGHTS", "GAIN", "REFERENCE"))
        assert weights.max(axis=(1, 2)) == pytest.approx(1.0)
        for frame in frames(3):
            found = gain * (centre_of_gravity(electrons(frame), weights) - home)
            # float32 in the file and in the kernel
            np.testing.assert_allclose(found.T, [pipeline(frame).x, pipeline(frame).y], atol=2e-5)


@pytest.mark.parametrize("weights", [None, RANDOM, CELL])
def test_sums(tmp_path: Path, weights: fs.FixedWeights | None) -> None:
    settings = fs.Settings("window", spot_fwhm_px=2.2, flux_e=400.0)
    path = written(tmp_path, settings, LAYOUT)
    if weights is not None:
        configuration.save(path, weights)
    export_fits(path, tmp_path / "weights.fits", reference=REFERENCE)
    pipeline = fs.SlopePipeline(LAYOUT, settings, CALIBRATION, REFERENCE, score=weights)
    with fits.open(tmp_path / "weights.fits") as file:
        maps, offset = [file[name].data for name in ("LINEAR_X", "LINEAR_Y")], file["OFFSET"].data
        frame = frames(1)[0]
        parts = electrons(frame) / 400.0 - file["MEAN_SPOT"].data
        found = np.stack([(each * parts).sum(axis=(1, 2)) for each in maps], axis=1) - offset
        assert ("WEIGHTS" in file) == (weights is not RANDOM)
    slopes = pipeline(frame)
    np.testing.assert_allclose(found.T, [slopes.x, slopes.y], atol=2e-5)


@pytest.mark.parametrize("name", ["brightest", "window"])
def test_matrices(tmp_path: Path, name: str) -> None:
    """An integrator in three lines of NumPy sends the commands of ours."""
    n = len(LAYOUT)
    settings = fs.Settings(name, **({"spot_fwhm_px": 2.2, "flux_e": 400.0} if name == "window" else {}))
    path = written(tmp_path, settings)
    interaction = np.random.default_rng(8).normal(size=(2 * n, 3))
    np.savez(tmp_path / "matrix.npz", interaction=interaction, reference=REFERENCE)
    names = {"interaction_matrix": "matrix.npz:interaction", "reference_slopes": "matrix.npz:reference"}
    save_control(path, **names, gain=0.3, leak=0.02, centroid_gain=0.9)
    images = export_fits(path, tmp_path / "export.fits")
    assert ("WEIGHTS" in images) == (name == "window")
    with fits.open(tmp_path / "export.fits") as file:
        matrix, moved = file["CONTROL_MATRIX"].data, file["INTERACTION_MATRIX"].data
    control = load_control(path)
    assert control is not None
    line = CommandDelayLine(3, 1, 1e9)
    integrator = CompiledIntegrator(line, interaction, control.reconstructor.matrix, 0.3, 0.02)
    pipeline = fs.SlopePipeline(LAYOUT, settings, CALIBRATION, REFERENCE)
    commands = np.zeros(3)
    for frame in frames(3):
        slopes = pipeline(frame).vector.astype(float)
        integrator.update(slopes / 0.9, np.ones(2 * n))
        commands = 0.98 * commands - 0.3 * matrix @ slopes
        np.testing.assert_allclose(commands, line.latest, atol=1e-4 * np.abs(line.latest).max())
    np.testing.assert_allclose(matrix @ moved, control.reconstructor.matrix @ interaction, atol=1e-5)


def test_a_matrix_of_other_slopes_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, fs.Settings("brightest"))
    np.save(tmp_path / "matrix.npy", np.ones((2 * len(LAYOUT) + 2, 3)))
    save_control(path, interaction_matrix="matrix.npy")
    with pytest.raises(fs.InputError, match="expected 8 rows"):
        export_fits(path, tmp_path / "export.fits")


@pytest.mark.parametrize(
    ("settings", "name", "naming"),
    [
        (fs.Settings("brightest"), "w.fits", "'brightest': expected 'window'"),
        (fs.Settings("window", spot_fwhm_px=2.0, normalisation="none"), "w.fits", '"none"'),
        (fs.Settings("window", spot_fwhm_px=2.0), "w.txt", "ending in .fits"),
        (fs.Settings("window", spot_fwhm_px=2.0), "nowhere/w.fits", "does not exist"),
    ],
)
def test_refused(tmp_path: Path, settings: fs.Settings, name: str, naming: str) -> None:
    with pytest.raises(fs.InputError, match=naming):
        export_fits(written(tmp_path, settings, LAYOUT), tmp_path / name)
