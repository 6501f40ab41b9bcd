"""What a running engine answers about modules on its control channel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from faintspot.checks import one_of
from faintspot.errors import InputError
from faintspot.realtime.control import Handler
from faintspot.realtime.module_loading import STAGES, Module, installed_modules


class ModuleHost(Protocol):
    """An engine, as far as modules are concerned."""

    def modules(self) -> Mapping[str, Module]:
        """Return the modules that are in use, by stage."""

    def module_fault(self) -> str | None:
        """Return why modules were taken out last, None where they never were."""

    def admit(self, name_or_path: str, *, isolate: bool = False) -> Module:
        """Try a module where it can do no harm, and load it when it has passed; `isolate`: elsewhere.

        Raises
        ------
        InputError
            When it is refused.
        """

    def load(self, module: Module) -> int | None:
        """Put a module in its stage, in place of what is there; return the first frame, None while it waits.

        Raises
        ------
        InputError
            When it is refused; then nothing changes.
        """

    def unload(self, stage: str) -> int | None:
        """Put the built-in stage back; return the first frame, None while it waits."""


def module_commands(host: ModuleHost) -> dict[str, Handler]:
    """Return the commands.

    load, swap (both {"source", "isolate"}), unload ({"stage"}: a stage or a name), modules.
    """

    def load(fields: dict[str, Any]) -> Mapping[str, Any]:
        return loaded(fields, replace=False)

    def swap(fields: dict[str, Any]) -> Mapping[str, Any]:
        return loaded(fields, replace=True)

    def loaded(fields: dict[str, Any], replace: bool) -> Mapping[str, Any]:
        isolate = fields.get("isolate", False)
        if not isinstance(isolate, bool):
            raise InputError(f"isolate: expected true or false, got {isolate!r:.40}")
        module = host.admit(_text(fields, "source"), isolate=isolate)
        there = host.modules().get(module.stage)
        if there is not None and not replace:
            raise InputError(f"{module.stage}: module {there.name} is loaded there; swap takes its place")
        return {"module": _described(module), "frame": host.load(module)}

    def unload(fields: dict[str, Any]) -> Mapping[str, Any]:
        stage = _stage_of(_text(fields, "stage"), host.modules())
        return {"stage": stage, "frame": host.unload(stage)}

    def modules(fields: dict[str, Any]) -> Mapping[str, Any]:
        return {
            "installed": installed_modules(),
            "loaded": [_described(module) for module in host.modules().values()],
            "fault": host.module_fault(),
        }

    return {"load": load, "unload": unload, "swap": swap, "modules": modules}


def _described(module: Module) -> dict[str, Any]:
    return {**module.describe(), "isolated": module.isolated}


def _text(fields: dict[str, Any], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str) or not value:
        raise InputError(f"{name}: expected a text, got {value!r:.40}")
    return value


def _stage_of(stage_or_name: str, loaded: Mapping[str, Module]) -> str:
    """The stage that is named, or that a loaded module of that name is in."""
    for stage, module in loaded.items():
        if stage_or_name in (stage, module.name):
            return stage
    names = ", ".join(module.name for module in loaded.values()) or "none"
    if stage_or_name not in STAGES:
        one_of("module or stage", stage_or_name, [*(module.name for module in loaded.values()), *STAGES])
    raise InputError(f"{stage_or_name}: no module is loaded there (loaded: {names})")
