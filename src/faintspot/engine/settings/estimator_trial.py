"""First trial of a file with estimators, in a separate process that may crash or hang without harm.

The process receives all that makes the pipelines, runs the file, tries its estimators on `trial_frames`, and
answers with one line of JSON. It ends at the time limit, even if the parent has gone.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from faintspot.base.errors import InputError
from faintspot.base.json_text import parse_json, to_json
from faintspot.engine.path.python_path import tried
from faintspot.engine.settings.estimator_file import load_estimators
from faintspot.slopes.estimators.faults import one_line
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

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
