"""Commands about modules, from the command line to something that stands for an engine."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from uuid import uuid4

import click
import pytest
from click.testing import CliRunner
from tests.realtime.module_cases import pipeline, write

import faintspot as fs
from faintspot.cli.realtime_modules import COMMANDS
from faintspot.realtime.control import ControlServer
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.module_commands import module_commands
from faintspot.realtime.module_loading import Module, load_module
from faintspot.realtime.private_socket import socket_path


class Host:
    """What an engine does about modules."""

    def __init__(self) -> None:
        self.loaded: dict[str, Module] = {}
        self.fault: str | None = None

    def modules(self) -> dict[str, Module]:
        return self.loaded

    def module_fault(self) -> str | None:
        return self.fault

    def admit(self, name_or_path: str, *, isolate: bool = False) -> Module:
        return replace(load_module(name_or_path), isolated=isolate)

    def load(self, module: Module) -> int | None:
        wanted = {**self.loaded, module.stage: module}
        ModularPipeline(pipeline(), wanted)
        self.loaded = wanted
        return 7

    def unload(self, stage: str) -> int | None:
        self.loaded = {key: value for key, value in self.loaded.items() if key != stage}
        return None


@pytest.fixture
def host() -> Host:
    return Host()


@pytest.fixture
def name(host: Host, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    name = f"fs_test_{uuid4().hex[:12]}"
    monkeypatch.chdir(tmp_path)
    with ControlServer(socket_path(name), module_commands(host)):
        yield name


def run(name: str, *arguments: str) -> str:
    group = click.Group(commands=list(COMMANDS))
    result = CliRunner().invoke(group, [*arguments, "--name", name], catch_exceptions=False)
    assert result.exit_code == 0
    return result.output


def test_load_swap_unload(name: str, host: Host, tmp_path: Path) -> None:
    write(tmp_path, "denoise", "return images", "gentle")
    write(tmp_path, "denoise", "return images * 2", "strong")
    assert "no module is loaded" in run(name, "modules")

    said = run(name, "load", "gentle.py")  # relative to the client's folder
    assert said.startswith(f"denoise: gentle ({tmp_path}/gentle.py, ")
    assert said.endswith("): in effect from frame 7\n")
    assert "loaded     denoise: gentle" in run(name, "modules")

    with pytest.raises(fs.InputError, match="denoise: module gentle is loaded there; swap takes its place"):
        run(name, "load", "strong.py")
    assert "denoise: strong" in run(name, "swap", "strong.py")
    assert run(name, "unload", "strong") == "denoise: the built-in stage, taken at the next frame\n"
    assert host.loaded == {}


def test_in_a_process_of_its_own(name: str, host: Host, tmp_path: Path) -> None:
    write(tmp_path, "denoise", "return images", "gentle")
    assert "), in a process of its own: in effect" in run(name, "load", "--isolate", "gentle.py")
    assert host.loaded["denoise"].isolated
    assert "in a process of its own\n" in run(name, "modules")
    assert "process of its own" not in run(name, "swap", "gentle.py")
    with pytest.raises(fs.InputError, match="isolate: expected true or false, got 'yes'"):
        module_commands(host)["load"]({"source": "./gentle.py", "isolate": "yes"})


def test_an_edited_file_is_taken_by_swap(name: str, host: Host, tmp_path: Path) -> None:
    write(tmp_path, "denoise", "return images", "gentle")
    run(name, "load", "./gentle.py")
    before = host.loaded["denoise"].digest
    write(tmp_path, "denoise", "return images * 2", "gentle")
    run(name, "swap", "./gentle.py")
    assert host.loaded["denoise"].digest != before


def test_refusals_change_nothing(name: str, host: Host, tmp_path: Path) -> None:
    write(tmp_path, "denoise", "return images[1:]", "wrong")
    for arguments, message in (
        (("load", "wrong.py"), "expected shape"),
        (("load", "none.py"), "No such file"),
        (("load", "none"), "an installed module"),
        (("unload", "denoise"), r"denoise: no module is loaded there \(loaded: none\)"),
        (("unload", "sharpen"), r"module or stage = 'sharpen': expected one of 'calibrate'"),
    ):
        with pytest.raises(fs.InputError, match=message):
            run(name, *arguments)
    assert host.loaded == {}


def test_the_last_fault_is_shown(name: str, host: Host) -> None:
    host.fault = "module gentle (denoise): ValueError: no light"
    assert "fault      module gentle (denoise): ValueError: no light" in run(name, "modules")
    assert '"installed": {' in run(name, "modules", "--json")


@pytest.mark.parametrize("fields", [{}, {"source": 3}, {"source": ""}])
def test_garbage(host: Host, fields: dict[str, object]) -> None:
    with pytest.raises(fs.InputError, match="source: expected a text"):
        module_commands(host)["load"](dict(fields))
