"""A module in a process of its own: the same slopes, and whatever it does is one line here."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.realtime.bench import Bench, simulated
from tests.realtime.module_cases import LAYOUT, SETTINGS, assert_same, frames, module, pipeline, write

import faintspot as fs
from faintspot.realtime.isolation import isolated
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.module_loading import Module, load_module
from faintspot.realtime.time_limit import call_within

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory without a name is Linux's")
PATIENCE_S = 60.0
IMAGES = np.ones((len(LAYOUT), *LAYOUT.window), np.float32)


def elsewhere(path: Path) -> Module:
    return isolated(str(path), load_module(path).describe())


def function(path: Path) -> Any:
    return elsewhere(path).make(LAYOUT, SETTINGS)


def number_of(function: Any) -> int:
    """Of its process."""
    return int(function._process.pid)


def lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def until_over(pid: int) -> None:
    end = time.monotonic() + PATIENCE_S
    while lives(pid):
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("stage", "body"),
    [
        ("denoise", "images *= 0.5\nreturn images + images.mean()"),  # into what it was given
        ("centroid", "return fs.centre_of_gravity(images).astype(np.float64)"),
        ("calibrate", "return (images - np.float32(100)) * np.float32(0.5)"),
    ],
)
def test_slopes_are_those_of_the_module_here(tmp_path: Path, stage: str, body: str) -> None:
    here = module(tmp_path, stage, body)
    there = ModularPipeline(pipeline(), {stage: elsewhere(tmp_path / "module.py")})
    for frame in frames(2):
        assert_same(there(frame), ModularPipeline(pipeline(), here)(frame))


def test_nothing_of_it_runs_here_and_its_text_stays(tmp_path: Path) -> None:
    path = write(tmp_path, "denoise", "import os\nimages[:] = os.getpid() % 65521\nreturn images")
    about = load_module(path).describe()
    tried = isolated(str(path), about)
    path.write_text(f"{path.read_text()}\nimages = 3\n")
    denoise: Any = tried.make(LAYOUT, SETTINGS)  # as when settings change
    assert denoise(IMAGES)[0, 0, 0] == number_of(denoise) % 65521 != os.getpid() % 65521
    with pytest.raises(fs.InputError, match="it was changed since it was tried; load"):
        isolated(str(path), about).make(LAYOUT, SETTINGS)


def test_what_fails_is_one_line(tmp_path: Path) -> None:
    body = """
        if images[0, 0, 0] == 1: raise ValueError("no\\nlight")
        if images[0, 0, 0] == 2: raise SystemExit(3)
        return images[1:] if images[0, 0, 0] == 3 else None
    """
    denoise = function(write(tmp_path, "denoise", body))
    for number, message in (
        (1, "ValueError: no light"),
        (2, "SystemExit: 3"),
        (3, "expected shape (20, 8, 8), got (19, 8, 8)"),
        (4, "expected an array of float32 or float64, got NoneType"),
        (1, "ValueError: no light"),
    ):
        with pytest.raises(fs.InputError) as caught:
            denoise(number * IMAGES)
        assert str(caught.value) == message


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("import os\nos._exit(3)", "its process has ended (exit status 3)"),
        ("import ctypes\nctypes.string_at(0)", "its process has crashed (SIGSEGV)"),
    ],
)
def test_what_ends_its_process(tmp_path: Path, body: str, message: str) -> None:
    denoise = function(write(tmp_path, "denoise", body))
    for _ in range(2):  # and stays so
        with pytest.raises(fs.InputError) as caught:
            denoise(IMAGES)
        assert str(caught.value) == message


def test_make_that_fails(tmp_path: Path) -> None:
    path = tmp_path / "bad.py"
    path.write_text("STAGE = 'denoise'\ndef make(layout, settings):\n    return 3\n")
    with pytest.raises(
        fs.InputError, match=r"^module bad \(denoise\): make: expected that it returns a funct"
    ):
        ModularPipeline(pipeline(), {"denoise": elsewhere(path)})


# Compiled code that keeps the interpreter's lock: no thread could end it.
ENDLESS = "import ctypes\nif images[0, 0, 0]:\n    ctypes.PyDLL(None).sleep(600)\nreturn images"


def test_one_that_does_not_return_is_given_up(tmp_path: Path) -> None:
    denoise = function(write(tmp_path, "denoise", ENDLESS))
    number = number_of(denoise)
    with pytest.raises(fs.InputError, match=r"it: did not return within 0\.5 s"):
        call_within(0.5, "it", denoise, IMAGES)
    until_over(number)


def test_its_process_ends_with_what_needs_it(tmp_path: Path) -> None:
    """And leaves nothing open here."""
    module = elsewhere(write(tmp_path, "denoise", "return images"))
    held = []
    for _ in range(3):
        denoise: Any = module.make(LAYOUT, SETTINGS)
        number = number_of(denoise)
        assert lives(number)
        del denoise
        until_over(number)
        gc.collect()
        held.append(len(os.listdir("/proc/self/fd")))
    assert held[0] == held[2]


def test_its_process_ends_with_this_one(tmp_path: Path) -> None:
    """However that ends, and in the middle of what does not return."""
    path = write(tmp_path, "denoise", ENDLESS)
    code = (
        "import sys\nfrom pathlib import Path\n"
        "from tests.realtime.test_isolation import *\n"
        f"denoise = function(Path({str(path)!r}))\n"
        "print(number_of(denoise), flush=True)\ndenoise(IMAGES)"
    )
    root = Path(__file__).parents[2]
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=root)
    assert parent.stdout is not None
    number = int(parent.stdout.readline())
    time.sleep(0.5)  # it sleeps
    assert lives(number)
    parent.send_signal(signal.SIGKILL)
    parent.communicate(timeout=PATIENCE_S)
    until_over(number)


def test_an_engine_outlives_its_crash(tmp_path: Path) -> None:
    """Frames go on with the built-in stage; in the engine's own process this would be its end."""
    crash = "import ctypes\ncalls = globals().setdefault('calls', [])\ncalls.append(1)\n"
    crash += "if len(calls) > 40:\n    ctypes.string_at(0)\nreturn images"
    path, bench, data = write(tmp_path, "denoise", crash, "later"), Bench(deadline_s=0.5), simulated(1)[0]
    try:
        with bench.ring() as ring:
            bench.attached()
            modules, sent = bench.engine.modules, 0
            modules.load(isolated(str(path), load_module(path).describe()))
            while sent < 2000 and bench.engine.live.change_number < 2:  # loaded, and taken out
                bench.send(ring, sent, data)
                sent += 1
        assert bench.engine.counters.processed == sent
        assert modules.module_fault() == "module later (denoise): its process has crashed (SIGSEGV)"
    finally:
        bench.close()
