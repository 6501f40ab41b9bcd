import contextlib
import gc
import json
import os
import signal
import socket
import stat
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.engine.commands import start
from tests.patience import wait_for
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.engine.processes import requests as control
from faintspot.engine.processes.requests import LARGEST_REQUEST, ControlServer, request, socket_path

pytestmark = pytest.mark.slow


def add(fields: dict[str, Any]) -> dict[str, Any]:
    return {"sum": fields["a"] + fields["b"]}


def refuse(fields: dict[str, Any]) -> dict[str, Any]:
    raise InputError("noise_std = -1: expected\nmore")


def fail(fields: dict[str, Any]) -> dict[str, Any]:
    raise ZeroDivisionError("no\nway")


HANDLERS: dict[str, control.Handler] = {
    "add": add,
    "refuse": refuse,
    "fail": fail,
    "echo": dict,
    "arrays": lambda fields: {"one": np.float32(0.5), "many": np.arange(3), "path": Path("a")},
    "nan": lambda fields: {"value": float("nan")},
    "large": lambda fields: {"text": "x" * fields["length"]},
}


@pytest.fixture
def path() -> Iterator[Path]:
    # A socket's path is short, a test's folder may not be.
    with tempfile.TemporaryDirectory(prefix="faintspot") as folder:
        yield Path(folder) / "faintspot-lab.sock"


@pytest.fixture
def server(path: Path) -> Iterator[ControlServer]:
    with ControlServer(path, HANDLERS) as server:
        yield server


def connected(path: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    connection.settimeout(30)
    while True:
        try:
            connection.connect(str(path))
            return connection
        except BlockingIOError:  # too many wait to be accepted
            time.sleep(0.001)


def replies(connection: socket.socket) -> list[dict[str, Any]]:
    """Everything until the server closes."""
    data = b""
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(1 << 16):
            data += part
    return [json.loads(line) for line in data.splitlines()]


def is_well(path: Path) -> bool:
    return request(path, "add", a=2, b=3, timeout_s=30) == {"sum": 5}


# Requests and replies


def test_a_request_is_answered(server: ControlServer) -> None:
    assert is_well(server.path)
    fields: dict[str, Any] = {"changes": {"noise_std": 2.5}, "where": [1, 2], "text": "µ\n", "none": None}
    assert request(server.path, "echo", **fields) == fields
    assert request(server.path, "arrays") == {"one": 0.5, "many": [0, 1, 2], "path": "a"}
    assert request(server.path, "nan") == {"value": None}


@pytest.mark.parametrize(
    ("command", "named"),
    [
        ("refuse", "noise_std = -1"),
        ("fail", "ZeroDivisionError: no way"),
        ("add", "KeyError"),
        ("none such", "command = 'none such': expected one of add, arrays"),
    ],
)
def test_errors_come_back_in_one_line(server: ControlServer, command: str, named: str) -> None:
    with refused(named):
        request(server.path, command)
    assert is_well(server.path)


def test_a_large_reply_arrives_whole_and_a_huge_one_is_refused(server: ControlServer) -> None:
    assert len(request(server.path, "large", length=3_000_000, timeout_s=30)["text"]) == 3_000_000
    with refused("reply"):
        request(server.path, "large", length=17_000_000, timeout_s=30)
    for value in (object(), float("nan")):
        with refused("JSON"):  # before it is sent
            request(server.path, "add", value=value)


def test_others_are_answered_while_a_lengthy_command_lasts(path: Path) -> None:
    """And lengthy ones are carried out one after the other."""
    under_way: list[int] = []
    most, go_on = [0], threading.Event()

    def work(fields: dict[str, Any]) -> dict[str, Any]:
        under_way.append(1)
        most[0] = max(most[0], len(under_way))
        go_on.wait(30)
        under_way.pop()
        return {"done": True}

    done: list[dict[str, Any]] = []
    with ControlServer(path, {**HANDLERS, "work": work}, lengthy=["work"]):
        askers = [
            threading.Thread(target=lambda: done.append(request(path, "work", timeout_s=60)))
            for _ in range(3)
        ]
        for thread in askers:
            thread.start()
        wait_for(lambda: under_way)
        assert is_well(path)
        go_on.set()
        for thread in askers:
            thread.join()
    assert done == [{"done": True}] * 3
    assert most == [1]


@pytest.mark.parametrize("lengthy", [[], ["leave"]])
def test_an_exit_in_a_command_is_an_error_of_that_command(path: Path, lengthy: list[str]) -> None:
    def leave(fields: dict[str, Any]) -> dict[str, Any]:
        raise SystemExit("for good")

    def stop(fields: dict[str, Any]) -> dict[str, Any]:
        living.close()
        return {"stopped": True}

    with ControlServer(path, {**HANDLERS, "leave": leave, "stop": stop}, lengthy=lengthy) as living:
        with refused("SystemExit: for good"):
            request(path, "leave", timeout_s=30)
        assert is_well(path)
        assert request(path, "stop") == {"stopped": True}
    assert not path.exists()


def test_connections_leave_nothing_for_the_garbage_collector(server: ControlServer) -> None:
    """Nobody collects while frames come: cycles of references would stay for good."""
    is_well(server.path)
    gc.collect()
    gc.disable()
    try:
        for _ in range(50):
            is_well(server.path)
            with connected(server.path) as connection:
                connection.sendall(b"x" * (LARGEST_REQUEST + 10))
                replies(connection)
        assert gc.collect() < 50
    finally:
        gc.enable()


# Bad clients


GARBAGE = st.one_of(
    st.binary(max_size=300),
    st.text(max_size=100).map(str.encode),
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
        max_leaves=5,
    ).map(lambda value: json.dumps(value).encode()),
    st.sampled_from(
        [b"[" * 60_000, b'{"command": ["add"]}', b'{"command": "add", "a": 1, "b": "x"}', b"9" * 9999]
    ),
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(lines=st.lists(GARBAGE, max_size=4), ends=st.booleans(), reads=st.booleans())
def test_garbage_never_stops_the_server(
    server: ControlServer, lines: list[bytes], ends: bool, reads: bool
) -> None:
    with connected(server.path) as connection:
        connection.sendall(b"\n".join(lines) + b"\n" * ends)
        if reads:
            connection.shutdown(socket.SHUT_WR)
            for reply in replies(connection):
                assert reply["ok"] is True or len(reply["error"].splitlines()) == 1
    assert is_well(server.path)


@pytest.mark.parametrize(("size", "end"), [(LARGEST_REQUEST, b""), (5_000_000, b"\n")])
def test_a_huge_message_is_refused_and_its_sender_disconnected(
    server: ControlServer, size: int, end: bytes
) -> None:
    with connected(server.path) as connection:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(b"x" * size + end)
        assert [reply["error"] for reply in replies(connection)] == [
            f"request: expected at most {LARGEST_REQUEST} bytes in one line"
        ]
    assert is_well(server.path)


def test_the_largest_request_is_answered(server: ControlServer) -> None:
    frame = len(json.dumps({"command": "echo", "text": ""})) + 1
    text = "x" * (LARGEST_REQUEST - frame)
    assert request(server.path, "echo", text=text) == {"text": text}
    with refused("request"):
        request(server.path, "echo", text=text + "x")


def test_a_client_that_hangs_is_disconnected(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "_IDLE_S", 0.1)
    with ControlServer(path, HANDLERS), connected(path) as connection:
        connection.sendall(b'{"command": "ad')
        assert is_well(path)
        assert replies(connection) == []
        assert is_well(path)


# Who may ask


def test_only_the_user_can_open_the_socket(server: ControlServer) -> None:
    status = server.path.stat()
    assert stat.S_ISSOCK(status.st_mode)
    assert stat.S_IMODE(status.st_mode) == 0o600
    assert stat.S_IMODE(Path(f"{server.path}.lock").stat().st_mode) == 0o600
    with refused("lab"):  # a living one is not replaced
        ControlServer(server.path, {})


STRANGER = """
import os, sys
from faintspot.base.errors import InputError
from faintspot.engine.processes.requests import request
os.seteuid(65534)
try:
    request(sys.argv[1], "add", a=1, b=1)
except InputError as error:
    print(error)
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can act as another user")
def test_another_user_is_told_no(server: ControlServer) -> None:
    server.path.parent.chmod(0o755)
    server.path.chmod(0o666)
    said, _ = start(STRANGER, str(server.path)).communicate(timeout=60)
    assert said.splitlines() == ["the engine lab belongs to another user"]
    assert is_well(server.path)


def test_places_for_a_socket(path: Path) -> None:
    for place in ("none/deeper/faintspot-a.sock", "x" * 120):
        with refused():
            ControlServer(path.parent / place, HANDLERS)
    path.write_text("mine")  # something else stays
    with refused(str(path)):
        ControlServer(path, HANDLERS)
    assert path.read_text() == "mine"
    path.unlink()
    path.parent.chmod(0o777)
    with refused(str(path.parent)):
        ControlServer(path, HANDLERS)


# Life and death


VICTIM = """
import sys, time
from faintspot.engine.processes.requests import ControlServer
server = ControlServer(sys.argv[1], {})
print("up", flush=True)
time.sleep(600)
"""


def test_what_a_killed_server_left_is_replaced(path: Path) -> None:
    with start(VICTIM, str(path)) as victim:
        assert victim.stdout is not None
        assert victim.stdout.readline() == "up\n"
        with refused("lab"):
            ControlServer(path, HANDLERS)
        victim.send_signal(signal.SIGKILL)
    assert path.exists()
    with refused("lab"):
        request(path, "add")
    with ControlServer(path, HANDLERS):
        assert is_well(path)


def test_closing_removes_the_socket_and_twice_is_once(path: Path) -> None:
    server = ControlServer(path, HANDLERS)
    with connected(path) as connection:
        server.close()
        server.close()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            connection.sendall(b'{"command": "add", "a": 1, "b": 1}\n')
        assert not any(reply["ok"] for reply in replies(connection))
    assert list(path.parent.iterdir()) == []
    with ControlServer(path, HANDLERS):
        assert is_well(path)


def test_of_many_that_start_at_once_one_lives(path: Path) -> None:
    alive: list[ControlServer] = []
    refused: list[str] = []

    def serve() -> None:
        try:
            alive.append(ControlServer(path, HANDLERS))
        except InputError as error:
            refused.append(str(error))

    for _ in range(10):
        starters = [threading.Thread(target=serve) for _ in range(8)]
        for thread in starters:
            thread.start()
        for thread in starters:
            thread.join()
        assert (len(alive), len(refused)) == (1, 7)
        assert is_well(path)
        alive.pop().close()
        refused.clear()


# The client


@pytest.mark.parametrize(
    ("reply", "named"),
    [
        (b"", ""),
        (b'{"ok": tr', ""),
        (b"\xff\n", ""),
        (None, "0.2 s"),
    ],
)
def test_an_engine_that_misbehaves(path: Path, reply: bytes | None, named: str) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        released = threading.Event()

        def misbehave() -> None:
            with listener.accept()[0] as connection:
                connection.recv(1000)
                if reply is None:
                    released.wait(30)
                else:
                    connection.sendall(reply)

        thread = threading.Thread(target=misbehave)
        thread.start()
        with refused("lab", named):
            request(path, "status", timeout_s=0.2 if reply is None else 30)
        released.set()
        thread.join()


def test_the_usual_place_is_private(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert socket_path("lab") == tmp_path / "faintspot-lab.sock"
    for elsewhere in ("", str(tmp_path / "absent")):
        monkeypatch.setenv("XDG_RUNTIME_DIR", elsewhere)
        monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
        place = socket_path("lab")
        assert place == tmp_path / f"faintspot-{os.geteuid()}" / "faintspot-lab.sock"
    if len(str(place)) < 100:
        with ControlServer(place, HANDLERS):
            assert stat.S_IMODE(place.parent.stat().st_mode) == 0o700
            assert is_well(place)
