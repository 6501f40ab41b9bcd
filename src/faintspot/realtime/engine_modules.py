"""The modules of a running engine: put in, taken out, and taken out again when they fail."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from faintspot.errors import InputError
from faintspot.realtime.live import LiveSettings
from faintspot.realtime.module_loading import Module
from faintspot.realtime.programme import Path, Programmes

_EFFECT_TIMEOUT_S = 0.5


class EngineModules:
    """Changes modules beside the running system, as settings are changed; a `ModuleHost`.

    Parameters
    ----------
    live : LiveSettings
    programmes : Programmes
    """

    def __init__(self, live: LiveSettings, programmes: Programmes) -> None:
        self._live, self._programmes = live, programmes
        self._lock = threading.Lock()
        self._before: list[Mapping[str, Module]] = []
        self._fault: str | None = None
        self._given_up: Path | None = None

    def modules(self) -> Mapping[str, Module]:
        """Return the modules that are in use, by stage."""
        return self._programmes.modules

    def module_fault(self) -> str | None:
        """Return why modules were taken out last, None where they never were."""
        return self._fault

    def load(self, module: Module) -> int | None:
        """Put a module in its stage, in place of what is there; return the first frame, None while it waits.

        Raises
        ------
        InputError
            When it is refused; then nothing changes.
        """
        with self._lock:
            before = self._programmes.modules
            frame = self._changed({**before, module.stage: module})
            self._before.append(before)
            return frame

    def unload(self, stage: str) -> int | None:
        """Put the built-in stage back; return the first frame, None while it waits."""
        with self._lock:
            self._before.clear()
            return self._changed({s: m for s, m in self._programmes.modules.items() if s != stage})

    def take_out(self, path: Path) -> None:
        """Go back to the modules before, or to none, where those of the path that runs have failed.

        In a thread of its own, once: those before are made and tried anew.
        """
        if path.fault is None or path is self._given_up:
            return
        self._fault, self._given_up = path.fault, path
        threading.Thread(target=self._go_back, name="faintspot-take-out", daemon=True).start()

    def _go_back(self) -> None:
        with self._lock:
            try:
                self._changed(self._before.pop() if self._before else {})
            except InputError:  # those before fail as well
                self._before.clear()
                self._changed({})

    def _changed(self, modules: Mapping[str, Module]) -> int | None:
        before = self._programmes.modules
        self._programmes.modules = modules
        try:
            names = {stage: module.name for stage, module in modules.items()}
            change = self._live.renew({"modules": names})
        except InputError:
            self._programmes.modules = before
            raise
        return self._live.wait(change, _EFFECT_TIMEOUT_S)
