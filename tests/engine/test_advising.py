"""Measurements of a running loop: telescope, engine and its control channel in this process."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest
from tests.cli.cli_cases import Commands

pytest.importorskip("hcipy")
pytest.importorskip("pyshmem")
pytest.importorskip("zarr")

from tests.engine.closed_loop import CONFIGURATION, PATIENCE_S, Sky, configured, make_engine

from faintspot.base.errors import InputError
from faintspot.engine.advising import Advice, Loop, write_journal
from faintspot.engine.request_handlers import LENGTHY, commands_of
from faintspot.engine.requests.private_socket import socket_path
from faintspot.engine.requests.requests import ControlServer
from faintspot.loop.telemetry.measured import Measured

pytestmark = pytest.mark.machine_time("runs a loop in real time")

RATE_HZ = 150.0


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Loop, Sky, Path]]:
    """A loop at 150 frames/s, of which every fifth leaves images."""
    path, control = configured(tmp_path_factory.mktemp("bench"))
    name = f"fs_test_{uuid4().hex[:12]}"
    sky = Sky(name, CONFIGURATION.slowed_to(RATE_HZ))
    engine = make_engine(name, path, control)
    engine._images_every = 5
    stop = threading.Event()
    seeing = threading.Thread(target=lambda: sky.telescope.run(None, stop), daemon=True)
    try:
        sky.start(engine)
        with ControlServer(socket_path(name), commands_of(engine), lengthy=LENGTHY):
            sky.loop.close()
            seeing.start()
            yield Loop.load(path, name), sky, path
    finally:
        stop.set()
        seeing.join(PATIENCE_S)
        sky.close()


def test_advice_from_the_command_line(running: tuple[Loop, Sky, Path], run: Commands) -> None:
    loop, _, path = running
    for seconds in (4, 8, 16, 32):  # again until there are enough frames
        told = run("realtime", "advise", "--name", loop.name, "-c", path, "--seconds", seconds)
        if told.code == 0:
            break
    assert told.code == 0, told.err
    lines = told.out.splitlines()
    assert lines[0].endswith("frames with brightest")
    for name in ("flux", "read noise", "width of the spots", "centroid gain", "r0", "wind", "vibrations"):
        assert any(line.startswith(f"  {name}") for line in lines), told.out
    assert loop.ask("status")["advice"] == lines[:-1]
    with pytest.raises(InputError, match="lines = 3: expected a list of texts"):
        loop.ask("advice", lines=3)
    journal = json.loads(path.with_suffix(".advice.json").read_text())
    assert journal[-1]["name"] == loop.name
    known = {each["name"]: each for each in journal[-1]["known"]}
    # 200 photons for sub-apertures that are half lit or more, and what 16 pixels hold of speckled spots.
    assert 120 < known["flux"]["value"] < 200
    assert known["read noise"]["value"] == pytest.approx(1.0, abs=0.2)
    recorded = path.parent / "night.zarr"
    run.ok("realtime", "record", recorded, "--name", loop.name, "--frames", 400)
    again = run.ok("realtime", "advise", "--from", recorded, "-c", path)
    assert "frames with brightest" in again.out


def test_an_open_loop_tells_nothing(running: tuple[Loop, Sky, Path]) -> None:
    loop, sky, _ = running
    sky.loop.open()
    with pytest.raises(InputError, match="expected a closed loop, it is open: asked to"):
        loop.running(1.0, threading.Event())
    sky.loop.close()


def test_the_journal(tmp_path: Path) -> None:
    config = tmp_path / "faintspot.toml"
    advice = Advice(500, [Measured("flux", "e-", 3.0, 0.1)])
    for _ in range(2):
        place = write_journal(config, advice.entry("one"))
    written = json.loads(place.read_text())
    assert [each["known"][0]["value"] for each in written] == [3.0, 3.0]
    place.write_text("{}")
    with pytest.raises(InputError, match="expected a journal of advice"):
        write_journal(config, {})
