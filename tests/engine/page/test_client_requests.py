from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest

pytest.importorskip("zarr")

from tests.engine.telemetry_cases import LAYOUT, Engine
from tests.patience import wait_for

from faintspot.base.errors import InputError
from faintspot.engine.page.client_requests import EngineRequests, answered
from faintspot.engine.processes.requests import ControlServer, socket_path
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.io.telemetry import read_telemetry

pytestmark = pytest.mark.slow

NAME = f"fs_test_{uuid4().hex[:12]}"


@pytest.fixture
def asked() -> Iterator[list[tuple[str, dict[str, Any]]]]:
    """What reaches the engine's control channel."""
    heard: list[tuple[str, dict[str, Any]]] = []

    def hear(command: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
        def handler(fields: dict[str, Any]) -> dict[str, Any]:
            heard.append((command, fields))
            if fields.get("changes") == {"noise_std": -1}:
                raise InputError("noise_std = -1: expected a number of at least 0")
            return {"frame": 12, "loop": {"state": "open"}}

        return handler

    names = ("set", "interleave", "loop")
    with ControlServer(socket_path(NAME), {name: hear(name) for name in names}):
        yield heard


def ask(client_requests: EngineRequests, **asked: Any) -> dict[str, Any]:
    return answered(client_requests.functions(), asked)


def test_client_requests_reach_the_control_channel_as_the_command_line_sends_them(
    asked: list[tuple[str, dict[str, Any]]], tmp_path: Path
) -> None:
    client_requests = EngineRequests(NAME, tmp_path)
    answer = ask(client_requests, do="set", changes=["noise_std=2.5", "rule=threshold"], subapertures="1,3-5")
    assert answer == {"ok": True, "text": "in effect from frame 12"}
    assert ask(client_requests, do="interleave", methods="none,tv", every=20)["ok"]
    assert ask(client_requests, do="loop", action="gain", gain=0.3)["ok"]
    assert asked == [
        ("set", {"changes": {"noise_std": 2.5, "rule": "threshold"}, "where": [1, 3, 4, 5]}),
        ("interleave", {"methods": "none,tv", "every": 20}),
        ("loop", {"action": "gain", "gain": 0.3}),
    ]


@pytest.mark.parametrize(
    ("wish", "error"),
    [
        ({"do": "set", "changes": ["noise_std=-1"]}, "noise_std = -1: expected a number of at least 0"),
        ({"do": "set", "changes": ["noise_std"]}, "'noise_std': expected NAME=VALUE"),
        ({"do": "set", "changes": [1]}, "changes: expected a list"),
        ({"do": "set", "changes": ["a=1"] * 101}, "changes: expected at most 100"),
        ({"do": "set", "changes": ["a=1"], "subapertures": "x"}, "sub-apertures 'x': expected numbers"),
        ({"do": "load", "source": "x.py"}, "do = 'load': expected one of"),
        ({"do": "record", "file": "../night.zarr"}, "file = '../night.zarr': expected a name such as"),
        ({"do": "record", "file": "night"}, "expected a name such as night.zarr"),
        ({"do": "record", "file": "night.zarr"}, "no such ring of telemetry"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(
    asked: list[tuple[str, dict[str, Any]]], tmp_path: Path, wish: dict[str, Any], error: str
) -> None:
    answer = answered(EngineRequests(NAME, tmp_path).functions(), wish)
    assert not answer["ok"]
    assert error in answer["error"]
    assert "\n" not in answer["error"]


def test_recording_from_the_page(tmp_path: Path) -> None:
    client_requests = EngineRequests(NAME, tmp_path)
    answer = ask(client_requests, do="set", changes=["noise_std=1"])
    assert answer["error"].startswith(f"no engine runs under the name {NAME}")
    with Engine(TelemetryRing.create(NAME, LAYOUT)), closing(client_requests):
        assert ask(client_requests, do="stop_recording")["text"] == "nothing is being recorded"
        answer = ask(client_requests, do="record", file="night.zarr")
        assert answer == {"ok": True, "text": "recording to night.zarr"}
        refused = ask(client_requests, do="record", file="other.zarr")
        assert "a recording is already running" in refused["error"]
        wait_for(lambda: client_requests.recording.status()["frames"] >= 50)
        answer = ask(client_requests, do="stop_recording")
        assert answer["text"].startswith("night.zarr: ")
        assert not client_requests.recording.status()["running"]
        assert len(read_telemetry(tmp_path / "night.zarr").frame) >= 50
        assert "already exists" in ask(client_requests, do="record", file="night.zarr")["error"]
