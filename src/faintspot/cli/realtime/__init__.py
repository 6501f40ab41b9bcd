"""faintspot realtime: the engine, where its frames come from, and talking to a running one."""

from functools import cache
from importlib import import_module

import click

from faintspot.cli.commands import needs_linux

_MODULES = {
    **dict.fromkeys(("calibrate", "learn"), "learn"),
    **dict.fromkeys(("demo", "telescope"), "telescope"),
    "run": "run",
    **dict.fromkeys(("load", "record", "send", "status", "stop", "unload"), "control"),
    **dict.fromkeys(("bridge", "replay"), "sources"),
}
"""Modules of the commands."""


class _Commands(click.Group):
    """Commands of the engine, imported when they are used or listed."""

    def list_commands(self, context: click.Context) -> list[str]:
        """Return all names."""
        return sorted(_MODULES)

    def get_command(self, context: click.Context, name: str) -> click.Command | None:
        """Import one command."""
        return _command(name) if name in _MODULES else None


@cache
def _command(name: str) -> click.Command:
    module = import_module(f"faintspot.cli.realtime.{_MODULES[name]}")
    found = next(
        item for item in vars(module).values() if isinstance(item, click.Command) and item.name == name
    )
    return found if name == "learn" else needs_linux(found)  # that one reads a recording, elsewhere, too


@click.group("realtime", cls=_Commands)
def command() -> None:
    """Measure frames as they arrive and publish slopes and commands (Linux).

    \b
    In three terminals:
      faintspot realtime telescope diffraction_limit --frame-rate-hz 500
      faintspot realtime run --config faintspot.toml
      faintspot realtime status --watch
    """
