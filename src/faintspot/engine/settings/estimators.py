"""User-defined estimators in a running engine: loading a file, its trial, unloading, falling back."""

import contextlib
import gc
import hashlib
import os
import pickle
import resource
import signal
import subprocess
import sys
import threading
import types
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.base.text_files import parse_json, to_json
from faintspot.engine.frames.python_path import call_within, tried
from faintspot.engine.processes.requests import EFFECT_TIMEOUT_S
from faintspot.engine.settings.plan import EnginePlan, SettingsPreparer
from faintspot.engine.settings.running_settings import Change, RunningSettings
from faintspot.slopes.estimators import registry
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import faults_of, one_line
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

LOAD_LIMIT_S = 30.0
_IMPORTED = "faintspot_file_"


@dataclass(frozen=True)
class EstimatorFile:
    """A loaded file and the estimators that it has registered."""

    path: Path
    digest: str
    """SHA-256 of the text, which identifies the version."""
    kinds: dict[str, type[Estimator]]


def load_estimators(path: Path) -> EstimatorFile:
    """Run a Python file that registers estimators; its code has all rights of this process.

    A file that is loaded again replaces its own estimators.

    Raises
    ------
    InputError
        When the file cannot be read, is not Python, fails, does not return, or registers none; nothing stays
        registered then.
    """
    try:
        text = path.read_bytes()
        code = compile(text, str(path), "exec")
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or error}") from None
    except SyntaxError as error:
        raise InputError(f"{path} (line {error.lineno}): {error.msg}") from None
    except ValueError as error:  # null bytes
        raise InputError(f"{path}: {error}") from None
    module = types.ModuleType(f"{_IMPORTED}{path.stem}")
    module.__file__ = str(path)
    before, kinds_before = sys.modules.get(module.__name__), registry.estimators()
    sys.modules[module.__name__] = module  # dataclasses and pickle look modules up there
    try:
        with contextlib.chdir("."):  # the file may change the folder, the engine stays in its own
            call_within(LOAD_LIMIT_S, str(path), _run, code, module, path)
        now = registry.estimators().items()
        kinds = {name: kind for name, kind in now if kinds_before.get(name) is not kind}
        if not kinds:
            raise InputError(f"{path}: expected a class decorated with @register, found none; add one")
    except BaseException:
        registry.restore(kinds_before)
        sys.modules.pop(module.__name__)
        if before is not None:
            sys.modules[module.__name__] = before
        raise
    return EstimatorFile(path, hashlib.sha256(text).hexdigest(), kinds)


def _run(code: types.CodeType, module: types.ModuleType, path: Path) -> None:
    with faults_of(str(path), str(path)):
        exec(code, module.__dict__)


LIMIT_S = 90.0
_GRACE_S = 5.0  # for the process to end on its own
_PROGRAM = (
    f"import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from {__name__} import main; main()"
)


@dataclass(frozen=True)
class EstimatorTrial:
    """A file to try, and the pipelines to try it with.

    Parameters
    ----------
    path : path
        Python file that registers estimators.
    make_pipeline : function
        Function that makes a pipeline from settings; can be pickled.
    settings : Settings
        Settings whose shared options are used in the trial.
    limit_s : float
        Time limit of the trial.
    """

    path: Path
    make_pipeline: Callable[[Settings], SlopePipeline]
    settings: Settings
    limit_s: float = LIMIT_S

    def here(self) -> dict[str, Any]:
        """Try the file in this process; return its digest and the names of its "estimators".

        Raises
        ------
        InputError
            When the file is refused.
        """
        file = load_estimators(self.path)
        for name in file.kinds:
            tried(self.make_pipeline, self.settings.replace(estimator=name))
        return {"estimators": list(file.kinds), "digest": file.digest}

    def elsewhere(self) -> dict[str, Any]:
        """Try the file in a separate process; return the same as `here`.

        Raises
        ------
        InputError
            When the file is refused, ends or crashes the process, or does not return.
        """
        late = f"{self.path}: did not return within {self.limit_s:g} s in its trial"
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-c", _PROGRAM],
                input=pickle.dumps(sys.path) + pickle.dumps(self),
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=self.limit_s + _GRACE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise InputError(late) from None
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot start a process for its trial ({error.strerror or error})"
            ) from None
        if done.returncode == -signal.SIGALRM:
            raise InputError(late)
        if done.returncode < 0:
            name = signal.Signals(-done.returncode).name
            raise InputError(f"{self.path}: crashed in its trial ({name})")
        try:
            reply: dict[str, Any] = parse_json(done.stdout)
        except ValueError:
            message = f"{self.path}: ended the process of its trial (exit status {done.returncode})"
            raise InputError(message) from None
        if "error" in reply:
            raise InputError(reply["error"])
        return reply


def main() -> None:
    """Try the file that standard input describes; the main function of the process."""
    answer = os.dup(1)
    os.dup2(2, 1)  # the file's output is not the answer
    trial: EstimatorTrial = pickle.load(sys.stdin.buffer)
    signal.alarm(max(1, round(trial.limit_s)))  # interrupts compiled code, too
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # no core file after a crash
    try:
        reply = trial.here()
    except BaseException as error:
        refused = isinstance(error, InputError)
        reply = {"error": str(error) if refused else f"{trial.path}: {one_line(error)}"}
    os.write(answer, to_json(reply).encode())
    os._exit(0)  # do not wait for threads that never return


class EngineEstimators:
    """User-defined estimators of a running engine, loaded from files; settings select them by name.

    Parameters
    ----------
    live : RunningSettings
    preparer : SettingsPreparer
    """

    def __init__(self, live: RunningSettings[EnginePlan], preparer: SettingsPreparer) -> None:
        self._live, self._preparer = live, preparer
        self.changing = threading.Lock()
        """Lock of whatever changes settings or estimators; no trial of a file holds it."""
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
        with self.changing:
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
        with self.changing:
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
        self._preparer.interleaving = fallback.interleaving
        changes = {"estimator": fallback.settings.estimator.name, **more}
        return self._live.offer(fallback, {**changes, **fallback.interleaving.as_change})

    def _renewed(self, names: set[str]) -> int | None:
        """Prepare settings with these estimators again; return the first frame measured with them."""
        newest = self._live.newest
        if not names & newest.estimator_names:
            return None
        change = self._live.propose({"estimator": newest.settings.estimator.name})
        return self._live.wait(change, EFFECT_TIMEOUT_S)
