"""The page's updates, sent as binary messages ten times a second, and the engine's status."""

import asyncio
import struct
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.base.text_files import to_json
from faintspot.engine.page.page_state import BatchSource, PageState, Picture, flag_names
from faintspot.engine.processes.requests import request, socket_path
from faintspot.slopes.estimators.registry import allowed_in_words, estimators
from faintspot.slopes.pipeline.settings import SharedOptions
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import lenslet_outlines

_ALIGN = 8


def packed(kind: str, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] | None = None) -> bytes:
    """Return a message; numbers that are not finite become null in values, and stay in arrays."""
    described: dict[str, object] = {}
    blocks: list[bytes] = []
    offset = 0
    for name, array in (arrays or {}).items():
        data = array.tobytes()
        described[name] = [array.dtype.name, list(array.shape), offset]
        blocks += [data, bytes(-len(data) % _ALIGN)]
        offset += len(data) + len(blocks[-1])
    head = {"kind": kind, "values": values, "arrays": described}
    text = to_json(head).encode()
    text += b" " * (-(len(text) + 4) % _ALIGN)
    return b"".join([struct.pack("<I", len(text)), text, *blocks])


class LatestMessages:
    """One message of each kind; a newer one replaces it whether or not it has been read.

    A slow client misses messages, and nothing is queued for it. For use in one event loop.
    """

    def __init__(self) -> None:
        self._messages: dict[str, tuple[int, bytes]] = {}
        self._posted = 0
        self._changed = asyncio.Event()

    def post(self, kind: str, message: bytes) -> None:
        """Set the message of a kind."""
        self._posted += 1
        self._messages[kind] = self._posted, message
        self._changed.set()
        self._changed = asyncio.Event()

    def forget(self, kind: str) -> None:
        """Remove the message of a kind: later clients do not get it."""
        self._messages.pop(kind, None)

    async def newer(self, last: int) -> list[tuple[int, bytes]]:
        """Wait for messages posted after number `last`; return them with their numbers, in order."""
        while not (messages := sorted(item for item in self._messages.values() if item[0] > last)):
            await self._changed.wait()
        return messages


_PERCENTILES = (1.0, 99.9)  # shown as black and white, so that one hot pixel does not darken the rest
_MOST_SAMPLES = 1 << 16  # for the percentiles


class FrameDrawing:
    """Pictures of a sensor, and its geometry for the page.

    Parameters
    ----------
    layout : Layout
    """

    def __init__(self, layout: Layout) -> None:
        self.layout = layout
        height, width = layout.window
        rows = layout.corners[:, 0, None, None] + np.arange(height)[:, None]
        columns = layout.corners[:, 1, None, None] + np.arange(width)
        self._pixels = np.broadcast_arrays(rows, columns)

    def sensor(self) -> bytes:
        """Return the message with the sensor's geometry: positions in pixels of the frame."""
        layout = self.layout
        values = {"frame_shape": layout.frame_shape, "window": layout.window, "subapertures": len(layout)}
        arrays = {
            "corners": np.asarray(layout.corners, np.float32),
            "centres": np.asarray(layout.centres, np.float32),
            "outlines": lenslet_outlines(layout, 0.96).astype(np.float32),
        }
        return packed("sensor", values, arrays)

    def message(self, picture: Picture, record: NDArray[np.void] | None) -> bytes:
        """Return the message of a frame; without spots if its record is no longer available."""
        raw, raw_range = _in_bytes(picture.raw)
        stack, denoised_range = _in_bytes(picture.denoised)
        denoised = np.zeros(self.layout.frame_shape, np.uint8)
        denoised[tuple(self._pixels)] = np.maximum(stack, 1)  # 0: no sub-aperture
        arrays = {"raw": raw, "denoised": denoised}
        if record is not None:
            arrays |= {name: record[name] for name in ("x", "y", "flags")}
        values = {"frame": picture.frame, "raw_adu": raw_range, "denoised_e": denoised_range}
        return packed("pictures", values, arrays)


def _in_bytes(values: NDArray[np.float32]) -> tuple[NDArray[np.uint8], tuple[float, float]]:
    """Return values as bytes, and the values of 0 and 255; values that are not finite become 0."""
    finite = np.nan_to_num(values, nan=0.0, posinf=0.0, neginf=0.0)
    samples = finite.ravel()[:: max(1, finite.size // _MOST_SAMPLES)]
    low, high = (float(value) for value in np.percentile(samples, _PERCENTILES))
    if not high > low:
        high = low + 1.0
    scaled = (finite - low) * (255.0 / (high - low))
    return np.clip(scaled, 0, 255).astype(np.uint8), (low, high)


UPDATE_S = 0.08
"""Interval between two updates of the page [s]."""
_FIGURES_S, _METHODS_S = 0.5, 2.0


class Page:
    """Reader of a source that sends updates to the page; for one thread.

    Parameters
    ----------
    source : BatchSource
    tell : function
        Called with kind and message; None withdraws the last message of that kind.
    """

    def __init__(self, source: BatchSource, tell: Callable[[str, bytes | None], None]) -> None:
        self.source, self._tell = source, tell
        self.page_state = PageState([])
        self._drawing: FrameDrawing | None = None
        self._figures_s = self._methods_s = 0.0
        self._methods: list[dict[str, object]] = []
        self._state: dict[str, object] | None = None

    def step(self) -> None:
        """Read the source once and send updates."""
        batch = self.source.read()
        state = self.source.state()
        if batch is not None:
            if batch.anew or self._drawing is None:
                self._begin()
            self.page_state.add(batch)
            if batch.picture is not None and self._drawing is not None:
                record = self.page_state.record_of(batch.picture.frame)
                self._tell("pictures", self._drawing.message(batch.picture, record))
            if len(batch.records) or batch.anew:
                self._tell("now", packed("now", *self.page_state.now()))
            self._tell_figures(now=batch.anew)
        if state != self._state:
            self._state = state
            self._tell("place", packed("place", state))

    def _begin(self) -> None:
        """Clear data of another engine."""
        layout = not_none(self.source.layout)
        self.page_state = PageState(self.source.methods)
        if self._drawing is None or self._drawing.layout is not layout:
            self._drawing = FrameDrawing(layout)
            self._tell("pictures", None)
            self._tell("sensor", self._drawing.sensor())

    def _tell_figures(self, now: bool) -> None:
        moment = time.monotonic()
        if now or moment - self._figures_s >= _FIGURES_S:
            self._figures_s = moment
            if now or moment - self._methods_s >= _METHODS_S:
                self._methods_s, self._methods = moment, self.page_state.methods_compared()
            values = {**self.page_state.figures(), "methods": self._methods, "flags": flag_names()}
            self._tell("figures", packed("figures", values))


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
