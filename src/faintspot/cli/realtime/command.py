"""faintspot realtime: the engine, where its frames come from, and talking to a running one."""

from __future__ import annotations

from typing import ClassVar

import click

from faintspot.cli.realtime.calibrate import calibrate
from faintspot.cli.realtime.camera import camera
from faintspot.cli.realtime.control import control, get, interleave, set_settings, status, stop_engine, top
from faintspot.cli.realtime.demo import demo
from faintspot.cli.realtime.estimators import load, swap, unload
from faintspot.cli.realtime.follow import follow
from faintspot.cli.realtime.learn import learn
from faintspot.cli.realtime.record import export, record
from faintspot.cli.realtime.run import run
from faintspot.cli.realtime.sources import bridge, replay
from faintspot.cli.realtime.telescope import telescope
from faintspot.cli.shared.commands import Group
from faintspot.cli.shared.needs import needs_linux

_SECTIONS = {
    "Engine": (run, status, top, get, set_settings, interleave, control, stop_engine),
    "Estimators": (load, swap, unload),
    "Sources of frames": (camera, replay, bridge, telescope, demo),
    "Calibration and control": (calibrate, learn, follow),
    "Telemetry": (record, export),
}
_OF_RECORDINGS = (learn, export)


class _RealTime(Group):
    """Lists its commands by what they are for."""

    sections: ClassVar = {
        heading: [str(each.name) for each in listed] for heading, listed in _SECTIONS.items()
    }


@click.group("realtime", cls=_RealTime)
def command() -> None:
    """Measure frames as they arrive and publish slopes and commands (Linux).

    \b
    In three terminals:
      faintspot realtime camera --config faintspot.toml --frame-rate-hz 500
      faintspot realtime run --config faintspot.toml
      faintspot realtime top
    """


for _listed in _SECTIONS.values():
    for _each in _listed:
        command.add_command(_each if _each in _OF_RECORDINGS else needs_linux(_each))
