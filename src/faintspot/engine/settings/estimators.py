"""User-defined estimators in a running engine: loading, unloading, and falling back when one fails."""

from __future__ import annotations

import gc
import sys
import threading
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.engine.requests.requests import EFFECT_TIMEOUT_S
from faintspot.engine.settings.estimator_file import EstimatorFile, load_estimators
from faintspot.engine.settings.estimator_trial import EstimatorTrial
from faintspot.engine.settings.interleaving import EVERY, FIRST_METHOD, METHODS
from faintspot.engine.settings.plan import EnginePlan, SettingsPreparer
from faintspot.engine.settings.running_settings import Change, RunningSettings
from faintspot.slopes.estimators import registry


class EngineEstimators:
    """User-defined estimators of a running engine, loaded from files; settings select them by name.

    Parameters
    ----------
    live : LiveSettings
    preparer : SettingsPreparer
    """

    def __init__(self, live: RunningSettings[EnginePlan], preparer: SettingsPreparer) -> None:
        self._live, self._preparer = live, preparer
        self._lock = threading.Lock()
        self.loaded: dict[str, EstimatorFile] = {}
        """Files of loaded estimators, by the estimators' names."""
        self.fault: str | None = None
        """Reason why the last estimator was disabled."""

    def load(self, source: str, *, replace: bool = False) -> dict[str, Any]:
        """Try a file's estimators in a separate process, and load them if they pass.

        With `replace` they replace those of the same names, even if these are in use.

        Returns
        -------
        dict
            "estimators": their names; "frame": the first one measured with a swapped estimator, or None.

        Raises
        ------
        InputError
            When the file is refused; nothing changes then.
        """
        path = Path(source)
        settings = self._preparer.built_in(self._live.settings)
        tried = EstimatorTrial(path, self._preparer.make_pipeline, settings).elsewhere()
        with self._lock:
            for name in tried["estimators"]:
                if name in self.loaded and not replace:
                    raise InputError(
                        f"estimator {name!r}: already loaded; use load --replace to load its file again"
                    )
            before = registry.estimators()
            file = load_estimators(path)
            try:
                if file.digest != tried["digest"]:
                    raise InputError(f"{path}: changed during its trial, expected no change; load it again")
                frame = self._renewed(set(file.kinds))
            except BaseException:
                registry.restore(before)
                raise
            self.loaded |= dict.fromkeys(file.kinds, file)
        gc.collect()  # old versions are reference cycles, and the engine runs without collection
        return {"estimators": list(file.kinds), "frame": frame}

    def unload(self, name: str) -> dict[str, object]:
        """Unload an estimator; if it is in use, the last built-in one takes over.

        Returns
        -------
        dict
            "frame": the first one measured without it; None if it was not in use.

        Raises
        ------
        InputError
            When no such estimator is loaded.
        """
        with self._lock:
            if name not in self.loaded:
                names = ", ".join(self.loaded) or "none"
                raise InputError(f"estimator {name!r}: not loaded, expected one of: {names}")
            newest, frame = self._live.newest, None
            if name in newest.estimator_names and newest.fallback is not None:
                frame = self._live.wait(self._fallen_back(newest.fallback), EFFECT_TIMEOUT_S)
            kind = self.loaded.pop(name).kinds[name]
            registry.restore({key: other for key, other in registry.estimators().items() if key != name})
            if all(kind.__module__ != other.__module__ for other in registry.estimators().values()):
                sys.modules.pop(kind.__module__, None)
        gc.collect()
        return {"frame": frame}

    def fall_back(self, fallback: EnginePlan, fault: str) -> None:
        """Use the prepared fallback from the next frame on; for the engine's thread."""
        self.fault = fault
        self._fallen_back(fallback, estimator_fault=fault)

    def _fallen_back(self, fallback: EnginePlan, **more: str) -> Change:
        self._preparer.interleaving = turns = fallback.interleaving
        changes = {"estimator": fallback.settings.estimator.name, **more}
        return self._live.offer(
            fallback, {**changes, METHODS: turns.labels, FIRST_METHOD: turns.first, EVERY: turns.every}
        )

    def _renewed(self, names: set[str]) -> int | None:
        """Prepare settings with these estimators again; return the first frame measured with them."""
        newest = self._live.newest
        if not names & newest.estimator_names:
            return None
        change = self._live.propose({"estimator": newest.settings.estimator.name})
        return self._live.wait(change, EFFECT_TIMEOUT_S)
