"""faintspot realtime: the engine, where its frames come from, and talking to a running one."""

from __future__ import annotations

import click

from faintspot.cli import (
    realtime_advise,
    realtime_calibrate,
    realtime_camera,
    realtime_control,
    realtime_estimators,
    realtime_learn,
    realtime_loop,
    realtime_record,
    realtime_run,
    realtime_sources,
    realtime_telescope,
)
from faintspot.cli.needs import needs_linux


@click.group("realtime")
def command() -> None:
    """Run the slope computation in real time: pixels stream in, slopes stream out (Linux).

    \b
    In three terminals:
      faintspot realtime camera --config faintspot.toml --rate 500
      faintspot realtime run --config faintspot.toml
      faintspot realtime top
    """


for each in (
    realtime_run.run,
    realtime_camera.camera,
    realtime_sources.replay,
    realtime_sources.bridge,
    realtime_telescope.telescope,
    realtime_telescope.telescope_set,
    realtime_telescope.telescope_status,
    realtime_control.status,
    realtime_control.top,
    realtime_control.get,
    realtime_control.set_settings,
    realtime_control.interleave,
    realtime_control.stop_engine,
    realtime_loop.loop,
    realtime_calibrate.calibrate,
    realtime_estimators.load,
    realtime_estimators.swap,
    realtime_estimators.unload,
    realtime_record.record,
):
    command.add_command(needs_linux(each))
for each in (realtime_learn.learn, realtime_advise.advise, realtime_record.export):  # of recordings
    command.add_command(each)
