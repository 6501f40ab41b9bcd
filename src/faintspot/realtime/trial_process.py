"""A module's first trial, in a process of its own: a crash, exit or endless loop there is one line here.

The process is given all that makes the pipelines, loads the module, tries it on `trial_frames`, and answers
in one line of JSON. It ends by itself when the time is over, also when nobody waits for it any more.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from faintspot.errors import InputError
from faintspot.files import parse_json
from faintspot.pipeline import SlopePipeline
from faintspot.realtime.modular import ModularPipeline
from faintspot.realtime.module_loading import load_module
from faintspot.settings import Settings

LIMIT_S = 90.0
_GRACE_S = 5.0  # for the process to end by itself


@dataclass(frozen=True)
class Trial:
    """What is tried, and with which pipelines.

    Parameters
    ----------
    source : str
        A module's name or path.
    make_pipeline : function
        Makes a pipeline from settings.
    settings : sequence of Settings
        The module is tried with each of them.
    limit_s : float
        For all of it.
    """

    source: str
    make_pipeline: Callable[[Settings], SlopePipeline]
    settings: Sequence[Settings]
    limit_s: float = LIMIT_S

    def here(self) -> dict[str, str]:
        """Try the module in this process; return what it is, as `Module.describe`.

        Raises
        ------
        InputError
            When it is refused.
        """
        module = load_module(self.source)
        for settings in self.settings:
            ModularPipeline(self.make_pipeline(settings), {module.stage: module})
        return module.describe()

    def elsewhere(self) -> dict[str, str]:
        """Try the module in a process of its own; return what it is, as `Module.describe`.

        Where `make_pipeline` cannot be given to another process, as a lambda cannot, it is tried here.

        Raises
        ------
        InputError
            When it is refused, ends or crashes that process, or does not return.
        """
        try:
            pickle.dumps(self.make_pipeline)
        except (pickle.PicklingError, AttributeError, TypeError):
            return self.here()
        job = pickled(sys.path) + pickled(self)
        late = f"module {self.source}: did not return within {self.limit_s:g} s in its trial"
        try:
            done = subprocess.run(
                [sys.executable, "-P", "-c", program(__name__)],
                input=job,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                timeout=self.limit_s + _GRACE_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise InputError(late) from None
        except OSError as error:
            raise InputError(
                f"module {self.source}: no process for its trial ({error.strerror or error})"
            ) from None
        if done.returncode == -signal.SIGALRM:
            raise InputError(late)
        if done.returncode < 0:
            name = signal.Signals(-done.returncode).name
            raise InputError(f"module {self.source}: crashed in its trial ({name})")
        return self._about(done.stdout, done.returncode)

    def _about(self, output: bytes, status: int) -> dict[str, str]:
        """What the process has answered."""
        try:
            reply = parse_json(output)
        except ValueError:
            message = f"module {self.source}: ended the process of its trial (exit status {status})"
            raise InputError(message) from None
        if reply["error"] is not None:
            raise InputError(reply["error"])
        about: dict[str, str] = reply["about"]
        return about


def main() -> None:
    """Try the module that standard input describes; the process's whole life."""
    answer = os.dup(1)
    os.dup2(2, 1)  # what the module prints is not the answer
    trial: Trial = pickle.load(sys.stdin.buffer)
    signal.alarm(max(1, round(trial.limit_s)))  # ends compiled code as well
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a crash leaves no file behind
    reply: dict[str, Any] = {"about": None, "error": None}
    try:
        reply["about"] = trial.here()
    except BaseException as error:
        refused = isinstance(error, InputError)
        reply["error"] = str(error) if refused else f"module {trial.source}: {type(error).__name__}: {error}"
    os.write(answer, json.dumps(reply).encode())
    os._exit(0)  # threads that do not return are left behind


class _Pickler(pickle.Pickler):
    """Takes settings that differ between sub-apertures, which hold read-only mappings."""

    def reducer_override(self, value: Any) -> Any:
        """Say how a read-only mapping is made again."""
        return (_read_only, (dict(value),)) if isinstance(value, MappingProxyType) else NotImplemented


def _read_only(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


def program(module: str) -> str:
    """Return the program of a Python process that calls a module's `main`.

    On its standard input come, pickled, sys.path and then what `main` reads.
    """
    path = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer)"
    return f"{path}; from {module} import main; main()"


def pickled(value: Any) -> bytes:
    """Return a value as another process of this program reads it."""
    buffer = io.BytesIO()
    _Pickler(buffer).dump(value)
    return buffer.getvalue()
