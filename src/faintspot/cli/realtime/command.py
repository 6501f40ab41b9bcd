"""faintspot realtime: the engine, where its frames come from, and talking to a running one."""

from __future__ import annotations

import click

from faintspot.cli.realtime.calibrate import calibrate
from faintspot.cli.realtime.control import load, send, status, stop_engine, unload
from faintspot.cli.realtime.demo import demo
from faintspot.cli.realtime.learn import learn
from faintspot.cli.realtime.record import record
from faintspot.cli.realtime.run import run
from faintspot.cli.realtime.sources import bridge, replay
from faintspot.cli.realtime.telescope import telescope
from faintspot.cli.shared.needs import needs_linux

_ENGINE = run, status, send, stop_engine, load, unload, calibrate, record
_SOURCES = replay, bridge, telescope, demo


@click.group("realtime")
def command() -> None:
    """Measure frames as they arrive and publish slopes and commands (Linux).

    \b
    In three terminals:
      faintspot realtime telescope diffraction_limit --frame-rate-hz 500
      faintspot realtime run --config faintspot.toml
      faintspot realtime status --watch
    """


command.add_command(learn)  # from a recording, elsewhere, too
for _each in (*_ENGINE, *_SOURCES):
    command.add_command(needs_linux(_each))
