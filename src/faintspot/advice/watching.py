"""The telemetry of a running engine, gathered for a while."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.toml_files import parse_text
from faintspot.io.telemetry import Telemetry, stored_names
from faintspot.pipeline.settings import Settings, option_names
from faintspot.realtime.interleaving import arms_after
from faintspot.realtime.telemetry import TelemetryReader

_LOOK_S = 0.05
_MOST_IMAGES = 400
_QUESTIONS = 10


def watch(
    name: str,
    seconds: float,
    stop: threading.Event,
    meanwhile: Callable[[], None] = lambda: None,
    enough: Callable[[Telemetry], bool] = lambda _: False,
) -> Telemetry:
    """Return what an engine has measured from now on, for so long or until `stop` is set or it is enough.

    Parameters
    ----------
    name : str
        The engine's.
    seconds : float
    stop : event
    meanwhile : function
        Called twenty times a second.
    enough : function
        Asked ten times in all whether what there is so far is enough.

    Raises
    ------
    InputError
        When there is no engine, it ends, or makes no commands.
    """
    reader = TelemetryReader.attach(name)
    try:
        if not reader.description.get("commands"):
            raise InputError(f"{name}: this engine makes no commands; its configuration has no [control]")
        return _watched(reader, seconds, stop, meanwhile, enough)
    finally:
        reader.close()


def _watched(
    reader: TelemetryReader,
    seconds: float,
    stop: threading.Event,
    meanwhile: Callable[[], None],
    enough: Callable[[Telemetry], bool],
) -> Telemetry:
    cursors = [reader.newest, reader.newest_image, 0]
    records: list[NDArray[Any]] = [np.empty(0, reader.record_type)]
    images: list[NDArray[Any]] = [np.empty(0, reader.image_type)]
    changes: list[dict[str, Any]] = []
    start = time.monotonic()
    asked, going_on = 1, True
    while going_on:
        going_on = not stop.wait(_LOOK_S) and time.monotonic() < start + seconds
        meanwhile()
        some, cursors[0], _ = reader.records_since(cursors[0])
        records.append(some)
        if sum(map(len, images)) < _MOST_IMAGES:
            some, cursors[1], _ = reader.images_since(cursors[1])
            images.append(some)
        new, cursors[2], _ = reader.changes_since(cursors[2])
        changes += new
        if reader.stale and not stop.is_set():
            raise InputError(f"{reader.name}: the engine has ended")
        if going_on and time.monotonic() > start + asked * seconds / _QUESTIONS:
            asked += 1
            going_on = not enough(_gathered(reader, records, images, changes))
    return _gathered(reader, records, images, changes)


def _gathered(
    reader: TelemetryReader,
    records: list[NDArray[Any]],
    images: list[NDArray[Any]],
    changes: list[dict[str, Any]],
) -> Telemetry:
    """Return what was read as telemetry."""
    arrays = {
        name: np.concatenate([each[name] for each in parts])
        for parts in (records, images)
        for name in stored_names(parts[0].dtype)
    }
    arms, first = arms_after(reader.description["arms"], changes)
    attributes = {**reader.description, "settings": reader.settings, "arms": arms, "first_arm": first}
    return Telemetry(**arrays, changes=list(changes), attributes=attributes)


def recorded_settings(telemetry: Telemetry, gain: float) -> tuple[Telemetry, Settings, float]:
    """Return what of a recording was measured with its last settings, these, and the loop gain.

    Parameters
    ----------
    telemetry : faintspot.io.Telemetry
    gain : float
        Where the recording says no other.
    """
    document = parse_text(telemetry.attributes["settings"], "settings of the recording")
    settings, first = Settings.from_tables("settings of the recording", document), -1
    for change in telemetry.changes:
        values = change["changes"]
        if "gain" in values and values["gain"] is not None and values["gain"] != gain:
            gain, first = float(values["gain"]), max(first, change["frame"])
        if values and set(values) <= set(option_names()):
            settings = settings.replace(where=change["where"], **values)
            first = max(first, change["frame"])
    return replace(telemetry, loop=np.where(telemetry.frame > first, telemetry.loop, 0)), settings, gain
