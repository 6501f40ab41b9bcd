"""faintspot realtime send and status, with an engine in the process of the test; faintspot live."""

import json
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from faintspot.cli.realtime.control import send, status
from faintspot.engine.processes.requests import ControlServer, socket_path
from faintspot.engine.request_handlers import commands_of
from faintspot.loop.control.configuration import Control

pytest.importorskip("pyshmem")
pytest.importorskip("tornado")
pytest.importorskip("zarr")

from tests.engine.bench import LAYOUT, Bench, simulated

pytestmark = pytest.mark.slow

MATRIX = np.random.default_rng(1).standard_normal((2 * len(LAYOUT), 10))


def said(command: click.Command, *arguments: str) -> str:
    result = CliRunner().invoke(command, arguments, standalone_mode=False)
    return result.output if result.exception is None else str(result.exception)


@pytest.fixture
def bench() -> Iterator[Bench]:
    with (
        Bench(control=Control(MATRIX)) as made,
        ControlServer(socket_path(made.name), commands_of(made.engine)),
    ):
        yield made


def test_the_loop_by_the_command_line(bench: Bench) -> None:
    name = ["--name", bench.name]
    began = "loop open: integrator, gain 0.4; not closed since the engine began"
    assert began in said(status, *name)
    assert said(send, *name, "loop=close").startswith("loop closed: integrator, gain 0.4, slopes of")
    assert "gain 0.25" in said(send, *name, "gain=0.25")
    assert "gain = 2.5: expected a number from 0 to 2" in said(send, *name, "gain=2.5")
    bench.measure(simulated(3))
    assert "expected it open to flatten the mirror" in said(send, *name, "loop=flat")
    assert said(send, *name, "loop=open") == "loop open: integrator, gain 0.25; asked to\n"
    assert said(send, *name, "loop=flat").strip() in said(status, *name)
    everything = json.loads(said(status, *name, "--json"))["loop"]
    assert (everything["state"], everything["commands"]) == ("open", 10)
    assert everything["latency"]["count"] == 3
    sent = bench.records["commands"]
    assert sent.any()
    bench.detached()
    bench.measure(simulated(2))
    assert not bench.records["commands"][-2:].any()  # the mirror is flat
    assert said(status, *name, "max_bad_fraction") == "max_bad_fraction = 0.25\n"
    assert "keep_brightest = " in said(status, *name, "all")
    for changes, message in (
        (["loop=shut"], "action = 'shut': expected one of"),
        (["loop=open", "noise_std=1"], "noise_std: unknown name beside loop; known: loop"),
        (["methods=none,tv", "evry=3"], "evry: unknown name beside methods; did you mean every?"),
        (["gain=0.3", "--subapertures", "1"], "--subapertures: expected settings"),
    ):
        assert message in said(send, *name, *changes)


def test_an_engine_without_control() -> None:
    with Bench() as bench, ControlServer(socket_path(bench.name), commands_of(bench.engine)):
        assert "loop" not in said(status, "--name", bench.name)
        assert "add [control] to its configuration" in said(send, "--name", bench.name, "loop=close")


COMMAND = [sys.executable, "-m", "faintspot", "live"]


def test_page_is_served_until_it_is_ended(tmp_path: Path) -> None:
    command = [*COMMAND, "--name", "fs_test_live", "--port", "0"]  # whose engine has not started
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            url, _, token = process.stdout.readline().strip().partition("#")
            assert len(token) >= 32
            with urllib.request.urlopen(url) as page:
                assert b"<title>faintspot</title>" in page.read()
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(urllib.request.Request(url, headers={"Host": "example.org"}))
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 0
        finally:
            process.kill()
