"""Modules: stages of the pipeline that somebody else has written, found by name or in a file.

A module is a Python file, or an installed module, with

- STAGE: "calibrate", "denoise", "background" or "centroid";
- make(layout, settings): returns the function that is called for every frame.

The function takes the images of all sub-apertures, (n, ny, nx) float32, and may write into them. It returns
images of the same shape, "centroid" positions (n, 2): x, y in px from the middle of the window, where pixel i
of n has its centre at i - (n-1)/2. float32 or float64, finite also for images that are all zero. "calibrate"
gets ADU, with NaN where the frame has it; the others electrons.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.metadata
import sys
import types
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.realtime.time_limit import call_within, one_line
from faintspot.sensor.layout import Layout
from faintspot.settings import Settings

STAGES = ("calibrate", "denoise", "background", "centroid")
"""What a module can replace, in the order of the pipeline."""
GROUP = "faintspot.modules"
"""Entry points of this group are modules."""
LOAD_LIMIT_S = 30.0
_IMPORTED = "faintspot_module_"

StageFunction = Callable[[NDArray[np.float32]], NDArray[Any]]


@dataclass(frozen=True)
class Module:
    """A stage that somebody else has written."""

    name: str
    """Of the entry point, or of the file without its ".py"."""
    stage: str
    make: Callable[[Layout, Settings], StageFunction]
    source: str
    """Path of the file, or what the entry point names."""
    digest: str
    """SHA-256 of the source text, which tells one version from another."""
    isolated: bool = False
    """Whether its functions run in processes of their own; see `faintspot.realtime.isolation`."""

    def describe(self) -> dict[str, str]:
        """Return what there is to say about it, as plain values."""
        return {"name": self.name, "stage": self.stage, "source": self.source, "digest": self.digest}


def is_path(name_or_path: str | Path) -> bool:
    """Return whether it is a path of a file, and not the name of an installed module."""
    text = str(name_or_path)
    return text.endswith(".py") or "/" in text


def load_module(name_or_path: str | Path, text: bytes | None = None) -> Module:
    """Load a module: an installed one by its name, or a Python file, which is read anew every time.

    The code runs with all rights of this process.

    Parameters
    ----------
    name_or_path : str or path
        What ends in ".py" or holds a "/" is a path.
    text : bytes, optional
        Of a file, in place of what it holds now.

    Raises
    ------
    InputError
        When it is not found, is not Python, fails when it is imported, or does not say what a module must.
    """
    if is_path(name_or_path):
        return _from_file(Path(name_or_path), text)
    return _from_entry_point(str(name_or_path))


def installed_modules() -> dict[str, str]:
    """Return the modules that can be loaded by name, and what each names; nothing is imported."""
    points = importlib.metadata.entry_points(group=GROUP)
    return {point.name: point.value for point in sorted(points, key=lambda each: each.name)}


def read_module(path: Path) -> bytes:
    """Return the text of a module's file.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"module {path}: {error.strerror or error}") from None


def _from_file(path: Path, text: bytes | None) -> Module:
    text = read_module(path) if text is None else text
    digest = hashlib.sha256(text).hexdigest()
    try:
        code = compile(text, str(path), "exec")
    except SyntaxError as error:
        raise InputError(f"module {path}, line {error.lineno}: {error.msg}") from None
    except ValueError as error:  # null bytes
        raise InputError(f"module {path}: {error}") from None
    # Two versions of a file are two modules: functions of the first still look up their names in it.
    module = types.ModuleType(f"{_IMPORTED}{path.stem}_{digest[:12]}")
    module.__file__ = str(path)
    before = sys.modules.get(module.__name__)
    sys.modules[module.__name__] = module  # dataclasses and pickle look there
    try:
        call_within(LOAD_LIMIT_S, f"module {path}", _execute, code, module, path)
        loaded = _checked(path.stem, module, str(path), digest)
    except BaseException:
        sys.modules.pop(module.__name__)
        if before is not None:
            sys.modules[module.__name__] = before
        raise
    # What nobody uses any more is forgotten: an engine may load thousands of versions.
    weakref.finalize(loaded, _forget, module).atexit = False
    return loaded


def _execute(code: types.CodeType, module: types.ModuleType, path: Path) -> None:
    """Run a module's file; whatever it raises, also to end the process, is an error of the module."""
    try:
        exec(code, module.__dict__)
    except BaseException as error:
        raise InputError(f"module {path}{_line_of(error, str(path))}: {one_line(error)}") from None


def _forget(module: types.ModuleType) -> None:
    if sys.modules.get(module.__name__) is module:
        del sys.modules[module.__name__]


def _from_entry_point(name: str) -> Module:
    points = list(importlib.metadata.entry_points(group=GROUP, name=name))
    if not points:
        known = ", ".join(installed_modules()) or "none"
        raise InputError(
            f"module {name!r}: expected a file that ends in .py, or an installed module ({known})"
        )
    if len({point.value for point in points}) > 1:
        values = ", ".join(sorted(point.value for point in points))
        raise InputError(f"module {name!r}: expected one installed module of this name, got {values}")
    point = points[0]
    found = call_within(LOAD_LIMIT_S, f"module {name!r}", _imported, point)
    return _checked(name, found, point.value, _digest_of(point.module))


def _imported(point: importlib.metadata.EntryPoint) -> Any:
    """Import an installed module; whatever it raises, also to end the process, is an error of the module."""
    try:
        return point.load()
    except BaseException as error:
        raise InputError(f"module {point.name!r} ({point.value}): {one_line(error)}") from None


def _digest_of(module: str) -> str:
    """Of the source of an imported module, where it has one that can be read."""
    file = getattr(sys.modules.get(module), "__file__", None)
    try:
        return hashlib.sha256(Path(file).read_bytes() if file else module.encode()).hexdigest()
    except OSError:
        return hashlib.sha256(module.encode()).hexdigest()


def _checked(name: str, module: Any, source: str, digest: str) -> Module:
    """What a module says of itself."""
    stage, make = getattr(module, "STAGE", None), getattr(module, "make", None)
    choices = ", ".join(repr(choice) for choice in STAGES)
    if stage is None:
        raise InputError(f"module {source}: expected STAGE = one of {choices}, got none")
    if stage not in STAGES:
        raise InputError(f"module {source}: STAGE = {stage!r:.40}: expected one of {choices}")
    if not callable(make):
        raise InputError(f"module {source}: expected a function make(layout, settings), got none")
    return Module(name, stage, make, source, digest)


def _line_of(error: BaseException, path: str) -> str:
    """Where in the file an error was raised: the last line of it on the way there."""
    line, trace = None, error.__traceback__
    while trace is not None:
        line = trace.tb_lineno if trace.tb_frame.f_code.co_filename == path else line
        trace = trace.tb_next
    return "" if line is None else f", line {line}"
