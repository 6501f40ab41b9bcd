"""The page's updates: read the source about ten times a second and send the changes."""

from __future__ import annotations

import time
from collections.abc import Callable

from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.engine.page.batch import BatchSource
from faintspot.engine.page.messages import packed
from faintspot.engine.page.page_state import PageState, flag_names
from faintspot.engine.page.pictures import FrameDrawing

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
        try:
            batch = self.source.read()
            state = self.source.state()
        except InputError as error:  # a damaged recording
            batch, state = None, {**self.source.state(), "error": str(error)}
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
        """Clear data of another engine, or of another part of the recording."""
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
