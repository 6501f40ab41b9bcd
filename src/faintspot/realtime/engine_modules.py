"""The modules of a running engine: put in, taken out, and taken out again when they fail."""

from __future__ import annotations

import gc
import threading
from collections import deque
from collections.abc import Mapping

from faintspot.errors import InputError
from faintspot.realtime.isolation import isolated
from faintspot.realtime.live import LiveSettings
from faintspot.realtime.module_loading import Module, load_module
from faintspot.realtime.prepared_settings import MeasuringPath, PreparedSettings, SettingsPreparer
from faintspot.realtime.trial_process import Trial

_EFFECT_TIMEOUT_S = 0.5
_MOST_BEFORE = 8
"""So many former sets of modules are kept, to go back to."""


class EngineModules:
    """Changes modules beside the running system, as settings are changed; a `ModuleHost`.

    Parameters
    ----------
    live : LiveSettings
    preparer : SettingsPreparer
    """

    def __init__(self, live: LiveSettings[PreparedSettings], preparer: SettingsPreparer) -> None:
        self._live, self._preparer = live, preparer
        self._lock = threading.Lock()
        self._before: deque[Mapping[str, Module]] = deque(maxlen=_MOST_BEFORE)
        self._fault: str | None = None
        self._given_up: MeasuringPath | None = None

    def modules(self) -> Mapping[str, Module]:
        """Return the modules that are in use, by stage."""
        return self._preparer.modules

    def module_fault(self) -> str | None:
        """Return why modules were taken out last, None where they never were."""
        return self._fault

    def admit(self, name_or_path: str, *, isolate: bool = False) -> Module:
        """Try a module in a process of its own, and load it into this one when it has passed.

        With `isolate` it is not loaded here: it stays in processes of its own.

        Raises
        ------
        InputError
            When it is refused; then this process has not run any of it.
        """
        settings = self._preparer.of_arms(self._live.settings)
        about = Trial(name_or_path, self._preparer.make_pipeline, settings).elsewhere()
        if isolate:
            return isolated(name_or_path, about)
        module = load_module(name_or_path)
        if module.digest != about["digest"]:
            raise InputError(f"module {name_or_path}: was changed while it was tried; load it again")
        return module

    def load(self, module: Module) -> int | None:
        """Put a module in its stage, in place of what is there; return the first frame, None while it waits.

        Raises
        ------
        InputError
            When it is refused; then nothing changes.
        """
        with self._lock:
            before = self._preparer.modules
            frame = self._changed({**before, module.stage: module})
            self._before.append(before)
            return frame

    def unload(self, stage: str) -> int | None:
        """Put the built-in stage back; return the first frame, None while it waits."""
        with self._lock:
            self._before.clear()
            return self._changed({s: m for s, m in self._preparer.modules.items() if s != stage})

    def take_out(self, path: MeasuringPath) -> None:
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
            except Exception:  # those before fail as well
                self._before.clear()
                self._changed({})

    def _changed(self, modules: Mapping[str, Module]) -> int | None:
        before = self._preparer.modules
        self._preparer.modules = modules
        try:
            names = {stage: module.name for stage, module in modules.items()}
            change = self._live.renew({"modules": names})
        except BaseException:
            self._preparer.modules = before
            raise
        frame = self._live.wait(change, _EFFECT_TIMEOUT_S)
        # The names of a module's file and its functions refer to each other, and in a running engine nobody
        # else collects what such cycles hold.
        gc.collect()
        return frame
