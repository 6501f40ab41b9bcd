"""Commands of a running engine's control channel."""

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from numba.core import event

from faintspot.base.checks import number_between, one_of
from faintspot.base.errors import InputError
from faintspot.engine.engine import Engine
from faintspot.engine.frames.workers import PipelineMaker
from faintspot.engine.processes.requests import EFFECT_TIMEOUT_S, Handler, changes_of
from faintspot.loop.control.base import KALMAN
from faintspot.slopes.pipeline.configuration import Configuration

LENGTHY = ("set", "interleave", "load", "unload", "learnt", "spots")
"""Commands that prepare something new and may compile; other commands are answered meanwhile."""
_USUAL_TURN = 50  # frames
_FUNCTIONS = 70  # compiled when a pipeline with an integrator starts for the first time
LOOP_ACTIONS = ("status", "open", "close", "gain", "flat")


def while_starting(part: str = "") -> dict[str, Handler]:
    """Return the commands of an engine that is not there yet: "status" is refused with how far it is."""
    compiled = event.RecordingListener()
    event.register("numba:compile", compiled)

    def refuse(fields: object) -> Mapping[str, Any]:
        count = sum(each.is_end for _, each in compiled.buffer)
        compiles = f", {count} of about {max(count, _FUNCTIONS)} functions compiled{part}" if count else ""
        raise InputError(f"it starts{compiles}{'; later starts are fast' if count else ''}")

    return {"status": refuse}


def commands_of(engine: Engine) -> dict[str, Handler]:
    """Return the commands of the control channel by name."""
    estimators = engine.estimators
    return {
        "status": lambda fields: engine.status(),
        "get": lambda fields: {"settings": engine.live.get(fields.get("names"))},
        "set": partial(_alone, _set, engine),
        "interleave": partial(_alone, _interleave, engine),
        "loop": partial(loop_command, engine),
        "learnt": partial(_alone, _take_learnt, engine),
        "spots": partial(_alone, _take_spots, engine),
        "stop": partial(_stop, engine),
        "load": lambda fields: estimators.load(
            _text(fields, "source"), replace=bool(fields.get("replace", False))
        ),
        "unload": lambda fields: estimators.unload(_text(fields, "estimator")),
    }


def _alone(
    command: Callable[[Engine, dict[str, Any]], Mapping[str, object]], engine: Engine, fields: dict[str, Any]
) -> Mapping[str, object]:
    """Carry out a command while no other one changes settings or estimators."""
    with engine.estimators.changing:
        return command(engine, fields)


def _set(engine: Engine, fields: dict[str, Any]) -> Mapping[str, object]:
    try:
        change = engine.live.propose(changes_of(fields), fields.get("where"))
    except InputError:
        engine.counters.settings_refused += 1
        raise
    return {"frame": engine.live.wait(change, EFFECT_TIMEOUT_S)}


def _interleave(engine: Engine, fields: Mapping[str, object]) -> Mapping[str, object]:
    every = int(number_between("every", fields.get("every", _USUAL_TURN), 1, integer=True))
    change = engine.interleave(_text(fields, "methods"), every)
    return {"frame": engine.live.wait(change, EFFECT_TIMEOUT_S)}


def _stop(engine: Engine, fields: Mapping[str, object]) -> Mapping[str, object]:
    engine.stop()
    return {}


def _take_learnt(engine: Engine, fields: Mapping[str, object]) -> Mapping[str, object]:
    """Note what is learnt beside the engine, and take the new model, if one is handed over."""
    learning = {"found": _text(fields, "found"), "unix_time_s": time.time(), "taken": False}
    engine.learning = learning
    if fields.get("model") is None:
        return {}
    if engine.loop is None or engine.loop.control.options.controller != KALMAN:
        raise InputError('learnt: expected an engine with controller = "kalman" in [control]')
    from faintspot.loop.control.identification.model import Kalman

    try:
        engine.loop.renew(Kalman.load(_text(fields, "model"), engine.loop.control.plant))
    except InputError as error:
        engine.learning = learning | {"fault": f"{error}"}
        raise
    engine.learning = learning | {"taken": True}
    return {}


def _take_spots(engine: Engine, fields: Mapping[str, object]) -> Mapping[str, object]:
    """Measure with the PSF and the fixed weights of a configuration file from the next frame on."""
    if not isinstance(maker := engine.preparer.make_pipeline, PipelineMaker):
        raise InputError("spots: this engine does not know how its pipelines are made")
    file = _text(fields, "spots")
    with engine.preparer.kept_if_right():
        engine.preparer.make_pipeline = replace(maker, **Configuration(file).spot)
        change = engine.live.renew({"spots": file})
    return {"frame": engine.live.wait(change, EFFECT_TIMEOUT_S)}


def _text(fields: Mapping[str, object], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str) or not value:
        raise InputError(f"{name} = {value!r:.80}: expected a text")
    return value


def loop_command(engine: Engine, fields: Mapping[str, object]) -> Mapping[str, object]:
    """Open or close the loop, change its gain or flatten the mirror; return the loop's part of the status.

    Raises
    ------
    InputError
        When the action is unknown, there is no loop, the gain is out of range, or the loop is closed for
        "flat".
    """
    action, loop = one_of("action", fields.get("action"), LOOP_ACTIONS), engine.loop
    if action == "status":
        return {"loop": engine.loop_status()}
    if loop is None:
        raise InputError("loop: this engine makes no commands; add [control] to its configuration")
    if action == "gain":
        loop.gain = number_between("gain", fields.get("gain"), 0, 2)
    else:
        {"open": loop.open, "close": loop.close, "flat": loop.flatten}[action]()
    return {"loop": engine.loop_status()}
