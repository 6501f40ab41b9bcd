"""Status and settings of the engine, requested regularly from its control channel in a separate thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

from faintspot.base.errors import InputError
from faintspot.engine.requests.requests import request, socket_path
from faintspot.slopes.estimators.registry import allowed_in_words, estimators
from faintspot.slopes.pipeline.settings import SharedOptions

_EVERY_S = 0.5
_PATIENCE_S = 3.0
_FEW = 4  # sub-apertures whose values are shown individually


class StatusPoller:
    """Thread that requests the status regularly, and the settings when they have changed.

    Parameters
    ----------
    name : str
        Name of the engine.
    tell : function
        Called with kind ("status" or "settings") and values, in the poller's thread.
    """

    def __init__(self, name: str, tell: Callable[[str, dict[str, object]], None]) -> None:
        self._path, self._tell = socket_path(name), tell
        self._stopping = threading.Event()
        self._version: tuple[object, ...] | None = None
        self._thread = threading.Thread(target=self._run, name="faintspot-status", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop requesting."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                self._ask()
            except InputError as error:
                self._version = None
                self._tell("status", {"there": False, "error": str(error)})
            self._stopping.wait(_EVERY_S)

    def _ask(self) -> None:
        status = request(self._path, "status", timeout_s=_PATIENCE_S)
        # Noted before the settings are requested: a change in between leads to another request.
        counters, source = status["counters"], status["source"]
        version = (counters["settings_changes"], status["estimator"], source and source["pid"])
        self._tell("status", {"there": True, **status})
        if version != self._version:
            values = request(self._path, "get", timeout_s=_PATIENCE_S)["settings"]
            self._tell("settings", {"settings": settings_rows(values)})
            self._version = version


def settings_rows(values: Mapping[str, object]) -> list[dict[str, Any]]:
    """Return settings as rows of a form: name, value as text, meaning, permitted range, choices.

    Parameters
    ----------
    values : dict
        Reply of the engine to "get".
    """
    kinds = estimators()
    kind = kinds.get(str(values.get("estimator")))
    declared = {**(kind.declared() if kind is not None else {}), **SharedOptions.declared()}
    rows = []
    for name, value in values.items():
        row = {"name": name, "value": _as_text(value), "meaning": "", "allowed": "", "choices": []}
        if name == "estimator":
            row |= {"meaning": "Method that finds the position.", "choices": list(kinds)}
        elif name in declared:
            option = declared[name]
            row |= {"meaning": option.meaning, "allowed": allowed_in_words(option), "unit": option.unit}
            row["choices"] = list(option.choices) if isinstance(value, str) else []
        rows.append(row)
    return rows


def _as_text(value: object) -> str:
    """Format a value as for `faintspot realtime send`; long lists are abbreviated to both ends."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, list):
        return f"{value:.6g}" if isinstance(value, float) else str(value)
    distinct = set(map(str, value))
    if len(distinct) == 1:
        return _as_text(value[0])
    if len(value) <= _FEW:
        return ",".join(_as_text(item) for item in value)
    numbers = [item for item in value if isinstance(item, int | float)]
    ends = (
        f"{_as_text(min(numbers))} to {_as_text(max(numbers))}" if numbers else f"{len(distinct)} different"
    )
    return f"({len(value)} values, {ends})"
