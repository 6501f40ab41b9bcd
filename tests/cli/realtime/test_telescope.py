"""faintspot realtime telescope: its file of Strehl ratios."""

import signal
import threading
import time
import urllib.request
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from rich.console import Console
from tests.cli.cli_cases import Commands
from tests.engine.commands import start
from tests.experiments.experiment_cases import small
from tests.shared_data import skip_without

from faintspot.base.errors import InputError
from faintspot.cli.realtime.telescope import in_words, methods_table, write_strehl
from faintspot.engine.page.demonstration import Shown
from faintspot.engine.processes.requests import ControlServer, request, socket_path
from faintspot.engine.processes.segment import FOLDER


def test_times_are_those_of_the_middle_of_an_exposure(tmp_path: Path) -> None:
    with (tmp_path / "strehl.csv").open("w") as file:
        expected = time.time() + 5.0
        write_strehl(file, 10.0, (7.0, 0.5, 200.0, 0.1, 3.0, time.monotonic(), 6.0, 50.0))
    written = np.loadtxt(tmp_path / "strehl.csv", delimiter=",")
    assert written == pytest.approx([expected, 0.5, 10.0], abs=1.0)
    assert written[1:].tolist() == [0.5, 10.0]


skip_without("hcipy")
pytest.importorskip("pyshmem")
pytest.importorskip("tornado")
pytest.importorskip("zarr")


PATIENCE_S = 240.0  # the engine may have to compile its code
OPEN, CLOSED = 1, 2
COUNTERS = {"processed": 600, "dropped": 2, "skipped": 1}


@pytest.fixture
def name() -> str:
    return f"fs_test_{uuid4().hex[:12]}"


def frames_measured(name: str) -> int:
    return int(request(socket_path(name), "status")["counters"]["processed"])


@pytest.mark.slow
def test_from_an_empty_folder_to_a_table(tmp_path: Path, name: str) -> None:
    """Interrupted, it gives a table of what it has seen, and leaves nothing behind.

    The telescope is small, its filter learns from 300 frames, and turns are short: how good methods are is
    not asked.
    """
    (tmp_path / "star.toml").write_text(small().to_text(), encoding="utf-8")
    code = (
        "from faintspot.engine.page import demonstration; from faintspot.cli import main; "
        "vars(demonstration).update(_LEARN_FRAMES=300, _TURN_S=0.5, _STAR='star.toml'); main()"
    )
    arguments = f"realtime demo --frame-rate-hz 50 --seconds 240 --port 0 --name {name}".split()
    process = start(code, *arguments, cwd=tmp_path)
    too_late = threading.Timer(2 * PATIENCE_S, process.kill)
    too_late.start()
    try:
        assert process.stdout is not None
        with urllib.request.urlopen(process.stdout.readline(), timeout=60) as page:
            assert b"<title>faintspot</title>" in page.read()
        lines = [process.stdout.readline() for _ in range(5)]
        assert "none, tv, window, map+kalman" in lines[4], (lines, process.communicate(timeout=60))
        end, begun = time.monotonic() + PATIENCE_S, frames_measured(name)
        while frames_measured(name) < begun + 200:  # each of four methods has turns of 40
            assert time.monotonic() < end
            time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=60)
    finally:
        too_late.cancel()
        process.kill()
    assert process.returncode == 0, errors
    for text in ("tv ", "window ", "map+kalman ", "over none", "frames measured", "of the open loop"):
        assert text in out
    assert not list(FOLDER.glob(f"{name}*"))
    with pytest.raises(InputError):
        request(socket_path(name), "status")
    for log in ("telescope", "engine", "page", "recorder", "learner"):
        assert "Traceback" not in (tmp_path / "faintspot-demo" / f"{log}.log").read_text()


def shown(turns: int) -> Shown:
    """Methods of 60 frames with Strehl ratios of 0.3, 0.5 and 0.4, and 0.9 while they settle; before, 0.1."""
    seen = Shown(delay_frames=2)
    seen.begin(["brightest", "window", "map"])
    seen.status = {
        "counters": COUNTERS,
        "telescope": {"frame_rate_hz": 100.0, "frames": 600, "overruns": 200},
        "loop": {"latency": {"p50_us": 40.0, "p99_us": 90.0}, "opened_because": None},
    }
    for frame in range(60 * turns):
        place, since = frame // 60 % 3, frame % 60  # the single method of the start had number 0
        open_loop = frame < 60
        strehl = 0.1 if open_loop else 0.9 if since < 20 else (0.3, 0.5, 0.4)[place]
        seen.rows.append((frame, 1 + place, OPEN if open_loop else CLOSED, 30.0 + place))
        if frame % 4 or open_loop:
            seen.truth[frame] = strehl, frame - (2 if frame % 2 else 3)
    return seen


@pytest.mark.slow
def test_table_has_the_gain_over_the_first_method() -> None:
    seen = shown(13)
    methods = {method.strehl.method: method for method in seen.by_method()}
    assert [method.strehl.mean.value for method in methods.values()] == pytest.approx([0.3, 0.5, 0.4])
    assert methods["brightest"].strehl.difference is None
    difference = methods["window"].strehl.difference
    assert difference is not None
    assert difference.value == pytest.approx(0.2)
    assert methods["map"].frames == 240
    assert (methods["map"].p50_us, seen.open_strehl) == pytest.approx((32.0, 0.1))
    assert seen.on_time == pytest.approx(2 / 3)  # of every four frames, three are known, two of them odd
    console = Console(width=80, record=True)
    console.print(methods_table(seen.by_method()))
    assert "0.500 ± 0.000  +0.200 ± 0.000" in console.export_text()
    words = in_words(seen)
    assert words[0].startswith("600 frames measured, 3 lost; ")
    assert "75 of 100 frames/s" in words[1]
    assert len(words) == 4


@pytest.mark.slow
def test_used_names_and_missing_packages_are_refused(
    folder: Path, run: Commands, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ControlServer(socket_path(name), {"status": lambda fields: {"counters": {}}}):
        run.refused("realtime", "demo", "--name", name, naming=(name,))
    monkeypatch.setattr("faintspot.base.errors.present", lambda package: package == "zarr")
    wanted = ("pyshmem", "tornado", "hcipy", "pip install 'faintspot[realtime,loop]'")
    run.refused("realtime", "demo", naming=wanted)
    assert [path.name for path in folder.iterdir()] == ["faintspot.toml"]
