"""Estimators of files in a running engine: in, out, and given up when they fail; no frame is missing."""

import contextlib
import hashlib
import os
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from tests.engine.bench import SETTINGS, Bench, make, simulated
from tests.engine.estimator_files import PEAK, write
from tests.patience import LIMIT_S
from tests.refusals import refused

import faintspot as fs
from faintspot.cli.realtime import command
from faintspot.engine.processes.requests import ControlServer, request, socket_path
from faintspot.engine.request_handlers import LENGTHY, commands_of
from faintspot.engine.settings.estimators import EstimatorTrial, load_estimators
from faintspot.slopes.estimators import estimators
from faintspot.slopes.estimators.registry import restore

pytest.importorskip("pyshmem")

pytestmark = pytest.mark.slow
BRIGHT = 60000
FAILING = f"if {BRIGHT / 2} < images.max() < {BRIGHT}:\n    time.sleep(60)\nreturn sensor.zero + 0.25"


class Camera(Bench):
    """Sends frames one after the other, and asks the engine."""

    def __init__(self) -> None:
        super().__init__(deadline_s=0.2)  # a shared machine may take long
        self.ask, self.camera = commands_of(self.engine), self.ring()
        self.data, self.sent = simulated(2), 0
        self.bright = self.data[0].copy()
        self.bright[3, 3] = BRIGHT
        self.attached()

    def shoot(self, frame: Any = None, n: int = 1) -> int:
        """Send frames; return the number of the last one."""
        for _ in range(n):
            self.send(self.camera, self.sent, self.data[self.sent % 2] if frame is None else frame)
            self.sent += 1
        return self.sent - 1

    def change(self, **values: Any) -> None:
        self.engine.live.propose(values)
        self.shoot(n=2)  # the first one may have been waited for already

    def assert_measured_with(self, settings: fs.Settings, frame: int) -> None:
        np.testing.assert_array_equal(self.slopes[frame], make(settings)(self.data[frame % 2]).vector)


@pytest.fixture
def camera() -> Iterator[Camera]:
    before = estimators()
    camera = Camera()
    try:
        yield camera
    finally:
        camera.close()
        restore(before)


@pytest.fixture
def tried_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process for the trial takes seconds to begin."""
    monkeypatch.setattr(EstimatorTrial, "elsewhere", EstimatorTrial.here)


def mine(path: Path, **options: Any) -> fs.Settings:
    """The settings with the estimator of a file."""
    kind = load_estimators(path).kinds["mine"]
    return SETTINGS.replace(estimator=kind(**options))


@pytest.mark.usefixtures("tried_here")
def test_one_that_does_not_return_is_given_up(camera: Camera, tmp_path: Path) -> None:
    """The built-in estimator before takes over with the next frame, with the settings as they are now."""
    camera.ask["load"]({"source": str(write(tmp_path, FAILING))})
    camera.change(estimator="mine")
    camera.change(search_range_px=2.0)
    camera.shoot(camera.bright, n=3)
    camera.assert_measured_with(SETTINGS.replace(search_range_px=2.0), camera.shoot())
    status = camera.engine.status()
    assert status["estimator"] == SETTINGS.estimator.name
    assert "mine" in status["estimator_fault"]
    assert camera.engine.counters.processed == camera.sent
    taken = camera.engine.live.taken()[-1][2]
    assert (taken["estimator"], taken["estimator_fault"]) == ("tv", status["estimator_fault"])


@pytest.mark.usefixtures("tried_here")
def test_commands_load_replace_and_unload_estimators(
    camera: Camera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(*arguments: str) -> str:
        result = CliRunner().invoke(command, [*arguments, "--name", camera.name], catch_exceptions=False)
        assert result.exit_code == 0
        return result.output

    monkeypatch.chdir(tmp_path)
    path = write(tmp_path)
    with ControlServer(socket_path(camera.name), commands_of(camera.engine)):
        assert str(path) in run("load", path.name, "--use")  # relative to the client's folder
        camera.shoot(n=2)
        camera.assert_measured_with(mine(path), camera.shoot())
        run("load", path.name, "--replace")
        run("unload", "mine")
        with refused("none.py"):
            run("load", "none.py")


def test_settings_change_during_a_trial(
    camera: Camera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file that does not return has the time of its trial; settings and estimators change meanwhile."""
    begun, end, ask = threading.Event(), threading.Event(), partial(request, socket_path(camera.name))

    def endless(trial: EstimatorTrial) -> dict[str, Any]:
        begun.set()
        assert end.wait(LIMIT_S)
        raise fs.InputError("did not return")

    def load() -> None:
        with contextlib.suppress(fs.InputError):
            ask("load", timeout_s=LIMIT_S, source=str(write(tmp_path)))

    monkeypatch.setattr(EstimatorTrial, "elsewhere", endless)
    with ControlServer(socket_path(camera.name), commands_of(camera.engine), lengthy=LENGTHY):
        loading = threading.Thread(target=load)
        loading.start()
        try:
            assert begun.wait(LIMIT_S)
            ask("set", timeout_s=LIMIT_S, changes={"search_range_px": 2.5})
            assert camera.engine.live.newest.settings.search_range_px == 2.5
        finally:
            end.set()
            loading.join(LIMIT_S)


def test_a_file_that_changes_the_folder_leaves_the_engine_where_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    with refused("late"):
        load_estimators(write(tmp_path, top="os.chdir('other')\nraise ValueError('late')"))
    assert Path.cwd() == tmp_path


def trial(path: Path, limit_s: float = 60.0) -> EstimatorTrial:
    # With a value that differs between sub-apertures, too.
    return EstimatorTrial(path, make, SETTINGS.replace(where=[0, 3], search_range_px=2.0), limit_s)


def test_trial_runs_in_another_process(tmp_path: Path) -> None:
    """It runs in another process, which may print what it likes."""
    path = write(tmp_path, f"print('{{')\nos.environ['FS_TRIAL'] = 'x'\n{PEAK}")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    assert trial(path).elsewhere() == {"estimators": ["mine"], "digest": digest}
    assert "FS_TRIAL" not in os.environ
    assert "mine" not in estimators()


@pytest.mark.parametrize(
    ("body", "top", "message"),
    [
        ("ctypes.string_at(0)", "", "SIGSEGV"),
        (PEAK, "os._exit(0)", "exit status 0"),
        ("raise SystemExit(0)", "", "SystemExit: 0"),
        ("return images", "", r"expected shape \(16, 2\), got \(16, 8, 8\)"),
        (PEAK, "raise SystemExit", "SystemExit"),
    ],
)
def test_what_a_trial_refuses(tmp_path: Path, body: str, top: str, message: str) -> None:
    tried = trial(write(tmp_path, body, top))
    ends = message == "SIGSEGV" or "exit status" in message
    before = estimators()
    with refused("my_estimator.py", match=message):
        (tried.elsewhere if ends else tried.here)()
    restore(before)


def test_one_that_does_not_let_go_of_the_interpreter(tmp_path: Path) -> None:
    """Compiled code that keeps Python's lock: no thread could end it."""
    with refused("my_estimator.py", "3 s"):
        trial(write(tmp_path, top="ctypes.PyDLL(None).sleep(600)"), 3.0).elsewhere()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1\n", "found none"),
        ("def (\n", r"line 1"),
        ("a\0b", "null"),
        ("import faintspot\nx = 1 / 0\n", r"\(line 2\): ZeroDivisionError"),
    ],
)
def test_files_that_register_nothing(tmp_path: Path, text: str, message: str) -> None:
    before, path = estimators(), tmp_path / "bad.py"
    path.write_text(text)
    with pytest.raises(fs.InputError, match=message):
        load_estimators(path)
    with refused("none.py"):
        load_estimators(tmp_path / "none.py")
    assert estimators() == before


def test_names_that_are_taken(tmp_path: Path) -> None:
    path = write(tmp_path)
    path.write_text(path.read_text().replace('"mine"', '"tv"'))
    with refused("'tv'"):
        load_estimators(path)
    assert estimators()["tv"].__module__ == "faintspot.slopes.estimators.built_in.total_variation"
