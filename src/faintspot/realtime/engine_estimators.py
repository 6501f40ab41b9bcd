"""Estimators of others in a running engine: loaded from files, unloaded, and given up when they fail."""

from __future__ import annotations

import gc
import sys
import threading
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.estimators import registry
from faintspot.realtime.engine_plan import EnginePlan, SettingsPreparer
from faintspot.realtime.estimator_file import EstimatorFile, load_estimators
from faintspot.realtime.interleaving import ARMS, EVERY, FIRST_ARM
from faintspot.realtime.live import Change, LiveSettings
from faintspot.realtime.trial import Trial

_EFFECT_TIMEOUT_S = 0.5


class EngineEstimators:
    """Makes estimators of files known to a running engine; settings that name them take them into use.

    Parameters
    ----------
    live : LiveSettings
    preparer : SettingsPreparer
    """

    def __init__(self, live: LiveSettings[EnginePlan], preparer: SettingsPreparer) -> None:
        self._live, self._preparer = live, preparer
        self._lock = threading.Lock()
        self.loaded: dict[str, EstimatorFile] = {}
        """Files of estimators by the estimators' names."""
        self.fault: str | None = None
        """Why an estimator was given up last."""

    def load(self, source: str, *, swap: bool = False) -> dict[str, Any]:
        """Try a file's estimators in a process of their own, and make them known when they have passed.

        With `swap` they replace those of the same names, also where these are in use.

        Returns
        -------
        dict
            "estimators", their names; "frame", the first one measured with a swapped estimator, else None.

        Raises
        ------
        InputError
            When the file is refused; then nothing changes.
        """
        path = Path(source)
        settings = self._preparer.built_in(self._live.settings)
        tried = Trial(path, self._preparer.make_pipeline, settings).elsewhere()
        with self._lock:
            for name in tried["estimators"]:
                if name in self.loaded and not swap:
                    raise InputError(f"estimator {name!r}: loaded already; swap reads its file again")
            before = registry.estimators()
            file = load_estimators(path)
            try:
                if file.digest != tried["digest"]:
                    raise InputError(f"{path}: was changed while it was tried; load it again")
                frame = self._renewed(set(file.kinds))
            except BaseException:
                registry.restore(before)
                raise
            self.loaded |= dict.fromkeys(file.kinds, file)
        gc.collect()  # former versions are cycles, and a running engine does not collect any
        return {"estimators": list(file.kinds), "frame": frame}

    def unload(self, name: str) -> dict[str, Any]:
        """Forget an estimator; where it is in use, the built-in one before takes over.

        Returns
        -------
        dict
            "frame", the first one measured without it; None where it was not in use.

        Raises
        ------
        InputError
            When no such estimator is loaded.
        """
        with self._lock:
            if name not in self.loaded:
                known = ", ".join(self.loaded) or "none"
                raise InputError(f"estimator {name!r}: expected one that is loaded ({known})")
            newest, frame = self._live.newest, None
            if name in newest.estimator_names and newest.fallback is not None:
                frame = self._live.wait(self._fallen_back(newest.fallback), _EFFECT_TIMEOUT_S)
            kind = self.loaded.pop(name).kinds[name]
            registry.restore({key: each for key, each in registry.estimators().items() if key != name})
            if all(kind.__module__ != each.__module__ for each in registry.estimators().values()):
                sys.modules.pop(kind.__module__, None)
        gc.collect()
        return {"frame": frame}

    def fall_back(self, fallback: EnginePlan, fault: str) -> None:
        """Let what was prepared for that take over, from the next frame on; for the engine's thread."""
        self.fault = fault
        self._fallen_back(fallback, estimator_fault=fault)

    def _fallen_back(self, fallback: EnginePlan, **more: str) -> Change:
        self._preparer.interleaving = arms = fallback.interleaving
        changes = {"estimator": fallback.settings.estimator.name, **more}
        return self._live.offer(
            fallback, {**changes, ARMS: arms.labels, FIRST_ARM: arms.first, EVERY: arms.every}
        )

    def _renewed(self, names: set[str]) -> int | None:
        """Prepare settings anew that use one of these estimators; return the first frame measured so."""
        newest = self._live.newest
        if not names & newest.estimator_names:
            return None
        change = self._live.propose({"estimator": newest.settings.estimator.name})
        return self._live.wait(change, _EFFECT_TIMEOUT_S)
