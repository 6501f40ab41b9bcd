"""faintspot export: weights and matrices as FITS."""

from pathlib import Path

import pytest
from tests.adapters.export_cases import written
from tests.cli.cli_cases import Commands

import faintspot as fs

pytest.importorskip("astropy")


def test_export(tmp_path: Path, run: Commands) -> None:
    path, output = written(tmp_path, fs.Settings("window", spot_fwhm_px=2.2)), tmp_path / "window.fits"
    told = run.ok("export", "-c", path, "-o", output).out
    assert told.startswith(f"{output}: CORNERS, WEIGHTS, GAIN, REFERENCE, ")
    assert output.exists()
    written(tmp_path, fs.Settings("centroid"))
    run.refused("export", "-c", path, "-o", output, naming=("expected 'window'", "[control]"))
