"""faintspot realtime: the engine, where its frames come from, and talking to a running one."""

from __future__ import annotations

from typing import ClassVar

import click

from faintspot.cli import (
    realtime_advise,
    realtime_calibrate,
    realtime_camera,
    realtime_control,
    realtime_control_loop,
    realtime_demo,
    realtime_estimators,
    realtime_learn,
    realtime_record,
    realtime_run,
    realtime_sources,
    realtime_telescope,
)
from faintspot.cli.commands import Group
from faintspot.cli.needs import needs_linux


class _RealTime(Group):
    """Lists its commands by what they are for."""

    sections: ClassVar = {
        "Engine": ("run", "status", "top", "get", "set", "interleave", "control", "stop"),
        "Estimators": ("load", "swap", "unload"),
        "Sources of frames": ("camera", "replay", "bridge", "telescope", "demo"),
        "Calibration and control": ("calibrate", "learn"),
        "Telemetry": ("record", "export", "advise"),
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


for each in (
    realtime_run.run,
    realtime_camera.camera,
    realtime_sources.replay,
    realtime_sources.bridge,
    realtime_telescope.telescope,
    realtime_demo.demo,
    realtime_control.status,
    realtime_control.top,
    realtime_control.get,
    realtime_control.set_settings,
    realtime_control.interleave,
    realtime_control.stop_engine,
    realtime_control_loop.control,
    realtime_calibrate.calibrate,
    realtime_estimators.load,
    realtime_estimators.swap,
    realtime_estimators.unload,
    realtime_record.record,
):
    command.add_command(needs_linux(each))
for each in (realtime_learn.learn, realtime_advise.advise, realtime_record.export):  # of recordings
    command.add_command(each)
