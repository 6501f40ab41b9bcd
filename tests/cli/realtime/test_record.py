"""faintspot realtime record and export: files, what is said, and errors in one line."""

import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.engine.commands import needs_shared_memory

pytest.importorskip("zarr")

from tests.cli.cli_cases import Commands
from tests.engine.telemetry_cases import LAYOUT, SETTINGS, Engine, as_written

from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io import read_telemetry

pytestmark = [
    needs_shared_memory,
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


def test_record_and_export(engine: Engine, tmp_path: Path, run: Commands) -> None:
    aotpy = pytest.importorskip("aotpy")
    store, file = tmp_path / "night.zarr", tmp_path / "night.fits"
    text = run.ok("realtime", "record", store, "--name", engine.ring.name, "--frames", 50).out
    assert f"{store}: 50 frames in " in text
    assert "(all that were asked for); nothing dropped" in text
    telemetry = read_telemetry(store)
    assert as_written(vars(telemetry))
    text = run.ok("export", "telemetry", store, "-o", file, "--ao-mode", "GLAO").out
    assert f"{file}: 50 frames, {len(telemetry.image_frame)} images" in text
    assert aotpy.AOSystem.read_from_file(file).ao_mode == "GLAO"


def test_what_cannot_be_done_is_said(engine: Engine, tmp_path: Path, run: Commands) -> None:
    name, store = engine.ring.name, tmp_path / "a.zarr"
    run.refused("realtime", "record", tmp_path / "night", "--name", name, naming=("ends in .zarr",))
    run.refused("realtime", "record", store, "--name", f"{name}-other", naming=("start the engine first",))
    run.refused("export", "telemetry", store, "-o", tmp_path / "b", naming=("ends in .fits",))
    run.refused("export", "telemetry", store, naming=("no such file",))
