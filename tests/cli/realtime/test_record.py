"""faintspot realtime record, export and run: files, options, what is said, and errors in one line."""

import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.cli.cli_cases import Commands
from tests.engine.commands import needs_shared_memory
from tests.engine.telemetry_cases import LAYOUT, SETTINGS, Engine, as_written
from tests.loop.control.control_cases import INTERACTION

from faintspot import Layout, Settings
from faintspot.base.errors import InputError
from faintspot.engine import engine as engine_module
from faintspot.engine.settings.plan import EngineOptions
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io import read_telemetry
from faintspot.loop.control.configuration import save_control

pytest.importorskip("zarr")
pytest.importorskip("pyshmem")


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


def test_options_are_passed_on(run: Commands, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout, settings = Layout.grid((3, 3), pixels=8), Settings("brightest")
    taken: list[tuple[EngineOptions, dict[str, Any]]] = []

    def no_engine(_: str, maker: Any, changing: Settings, options: EngineOptions, **parts: Any) -> None:
        assert (maker.layout, changing) == (layout, settings)
        taken.append((options, parts))
        raise InputError("no engine")

    monkeypatch.setattr(engine_module, "Engine", no_engine)
    monkeypatch.chdir(tmp_path)
    for part in (layout, settings):
        part.save("faintspot.toml")
    np.save("matrix.npy", INTERACTION)
    save_control("faintspot.toml", interaction_matrix="matrix.npy", gain=0.2)
    machine = ("--deadline-us", 2500, "--threads", 2, "--cpus", "0,1", "--images-every", 7, "--poll")
    methods = ("--interleave", "none,tv:0.6", "--every", 20)
    run.refused("realtime", "run", *machine, "--flux-frames", 30, *methods, naming=("no engine",))
    run.refused("realtime", "run", "--no-control", naming=("no engine",))
    (options, parts), (usual, without) = taken
    assert options == EngineOptions(2, [0, 1], 2500.0 * 1e-6, 7, 30.0, True)
    assert parts["control"].options.gain == 0.2
    assert (parts["interleaving"].labels, parts["interleaving"].every) == (["none", "tv:0.6"], 20)
    assert usual == EngineOptions(deadline_s=1000.0 * 1e-6)
    assert without == {"source": None, "interleaving": None, "control": None}
