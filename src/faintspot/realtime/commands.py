"""Commands of a running engine's control channel."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from faintspot.base.checks import number_between, one_of
from faintspot.base.errors import InputError
from faintspot.realtime.control import Handler
from faintspot.realtime.engine import Engine

LENGTHY = ("set", "interleave", "load", "swap", "unload")
"""Commands that prepare something new and may compile; other commands are answered meanwhile."""
_USUAL_TURN = 50  # frames
_EFFECT_TIMEOUT_S = 0.5  # to wait for a change to take effect; then the reply says that no frame came


_MOST_LINES, _LONGEST_LINE = 40, 400  # of advice
LOOP_ACTIONS = ("status", "open", "close", "gain", "flat")


def commands_of(engine: Engine) -> dict[str, Handler]:
    """Return the commands: status, get, set, interleave, loop, advice, stop, load, swap and unload."""

    def status(fields: dict[str, Any]) -> Mapping[str, Any]:
        return engine.status()

    def get(fields: dict[str, Any]) -> Mapping[str, Any]:
        return {"settings": engine.live.get(fields.get("names"))}

    def change(fields: dict[str, Any]) -> Mapping[str, Any]:
        changes = fields.get("changes")
        if not isinstance(changes, dict) or not changes:
            raise InputError("changes: expected values by name, got none")
        try:
            proposed = engine.live.propose(changes, fields.get("where"))
        except InputError:
            engine.counters.settings_refused += 1
            raise
        return {"frame": engine.live.wait(proposed, _EFFECT_TIMEOUT_S)}

    def interleave(fields: dict[str, Any]) -> Mapping[str, Any]:
        arms, every = fields.get("arms"), fields.get("every", _USUAL_TURN)
        if not isinstance(arms, str) or not arms:
            raise InputError(f"arms = {arms!r:.80}: expected a text such as none,tv")
        change = engine.interleave(arms, int(number_between("every", every, 1, integer=True)))
        return {"frame": engine.live.wait(change, _EFFECT_TIMEOUT_S)}

    def stop(fields: dict[str, Any]) -> Mapping[str, Any]:
        engine.stop()
        return {}

    def loop(fields: dict[str, Any]) -> Mapping[str, Any]:
        return loop_command(engine, fields)

    def advice(fields: dict[str, Any]) -> Mapping[str, Any]:
        lines = fields.get("lines")
        if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
            raise InputError(f"lines = {lines!r:.80}: expected a list of texts")
        engine.advice = [line[:_LONGEST_LINE] for line in lines[:_MOST_LINES]]
        return {}

    def load(fields: dict[str, Any]) -> Mapping[str, Any]:
        return engine.estimators.load(_text(fields, "source"))

    def swap(fields: dict[str, Any]) -> Mapping[str, Any]:
        return engine.estimators.load(_text(fields, "source"), swap=True)

    def unload(fields: dict[str, Any]) -> Mapping[str, Any]:
        return engine.estimators.unload(_text(fields, "estimator"))

    own: dict[str, Handler] = {"status": status, "get": get, "set": change, "stop": stop}
    own |= {"load": load, "swap": swap, "unload": unload}
    return own | {"interleave": interleave, "loop": loop, "advice": advice}


def _text(fields: dict[str, Any], name: str) -> str:
    value = fields.get(name)
    if not isinstance(value, str) or not value:
        raise InputError(f"{name} = {value!r:.40}: expected a text")
    return value


def loop_command(engine: Engine, fields: dict[str, Any]) -> Mapping[str, Any]:
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
    if action == "open":
        loop.open()
    elif action == "close":
        loop.close()
    elif action == "gain":
        loop.gain = number_between("gain", fields.get("gain"), 0, 2)
    elif action == "flat":
        loop.flatten()
    return {"loop": engine.loop_status()}
