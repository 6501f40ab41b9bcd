"""Estimators in a Python file that a running engine loads."""

from __future__ import annotations

import contextlib
import hashlib
import sys
import types
from dataclasses import dataclass
from pathlib import Path

from faintspot.base.errors import InputError
from faintspot.engine.path.time_limit import call_within
from faintspot.slopes.estimators import registry
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.faults import faults_of

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
