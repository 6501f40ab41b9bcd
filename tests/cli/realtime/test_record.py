"""faintspot realtime record and export: files, what is said, and errors in one line."""

import secrets
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

pytest.importorskip("zarr")

from tests.engine.telemetry_cases import LAYOUT, SETTINGS, Engine, as_written

from faintspot.base.errors import InputError
from faintspot.cli.realtime.control import record
from faintspot.cli.report import export as export
from faintspot.engine.segment import FOLDER
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io import read_telemetry

pytestmark = [
    pytest.mark.skipif(not FOLDER.is_dir(), reason="needs POSIX shared memory as Linux has it"),
    # A sensor alone has neither, of which the reader of AOT files complains.
    pytest.mark.filterwarnings("ignore:.AOT_(WAVEFRONT_CORRECTORS|LOOPS). .* contains no data"),
]


@pytest.fixture
def engine() -> Iterator[Engine]:
    """Writes frames."""
    name = f"faintspot-test-{secrets.token_hex(6)}"
    ring = TelemetryRing.create(name, LAYOUT, settings=SETTINGS, image_slots=256)  # none is overwritten
    with Engine(ring) as running:
        yield running


def said(export: click.Command, *arguments: str) -> str:
    """What a command prints; its errors come through."""
    return CliRunner().invoke(export, arguments, catch_exceptions=False).output


def refused(export: click.Command, *arguments: str) -> str:
    """The message of an InputError."""
    error = CliRunner().invoke(export, arguments).exception
    assert isinstance(error, InputError)
    return str(error)


def test_record_and_export(engine: Engine, tmp_path: Path) -> None:
    aotpy = pytest.importorskip("aotpy")
    name, store, file = engine.ring.name, tmp_path / "night.zarr", tmp_path / "night.fits"
    text = said(record, str(store), "--name", name, "--frames", "50")
    assert f"{store}: 50 frames in " in text
    assert "(all that were asked for); nothing dropped" in text
    telemetry = read_telemetry(store)
    assert as_written(vars(telemetry))
    images = len(telemetry.image_frame)
    assert f"{file}: 50 frames, {images} images" in said(
        export, str(store), "-o", str(file), "--ao-mode", "GLAO"
    )
    assert aotpy.AOSystem.read_from_file(file).ao_mode == "GLAO"


def test_what_cannot_be_done_is_said(engine: Engine, tmp_path: Path) -> None:
    name = engine.ring.name
    assert "ends in .zarr" in refused(record, str(tmp_path / "night"), "--name", name)
    assert "start the engine first" in refused(
        record, str(tmp_path / "night.zarr"), "--name", f"{name}-other"
    )
    assert "ends in .fits" in refused(export, str(tmp_path / "a.zarr"), "-o", str(tmp_path / "b"))
    assert "no such file" in refused(export, str(tmp_path / "a.zarr"))
