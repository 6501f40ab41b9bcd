"""A script that hides from faintspot what Windows lacks: modules of POSIX, and functions of the module os.

Other packages keep them. It imports every module outside the engine, and then runs commands, one an argument.
"""

from __future__ import annotations

import builtins
import importlib
import os
import pkgutil
import sys
import types
from typing import Any

MODULES = {"fcntl", "grp", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
FUNCTIONS = ("pread", "pwrite", "mkfifo", "getuid", "geteuid", "sched_getaffinity", "O_CLOEXEC")
LINUX_ONLY = ("faintspot.engine", "faintspot.cli.realtime", "faintspot.adapters.pyrtc")
"""What needs Linux, and says so; and the requests of its commands."""
REQUESTS = "faintspot.cli.shared.engine_requests"


def hide() -> None:
    """Do it, to this process, for good."""
    original, locks = builtins.__import__, _locks_of_windows()

    def visible(name: str, variables: Any = None, *arguments: Any, **options: Any) -> Any:
        importer = str((variables or {}).get("__name__", ""))
        if name.split(".")[0] in MODULES and importer.startswith("faintspot"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        if name == "msvcrt" and importer.startswith("faintspot"):
            return locks
        return original(name, variables, *arguments, **options)

    builtins.__import__ = visible  # type: ignore[assignment]
    for name in FUNCTIONS:
        if hasattr(os, name):
            delattr(os, name)


def _locks_of_windows() -> types.ModuleType:
    """Return a module that locks bytes of a file from its position on, as msvcrt does."""
    fcntl: Any = importlib.import_module("fcntl")
    module: Any = types.ModuleType("msvcrt")
    module.LK_NBLCK = 2

    def locking(descriptor: int, mode: int, count: int) -> None:
        assert mode == module.LK_NBLCK
        fcntl.lockf(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB, count, 0, os.SEEK_CUR)

    module.locking = locking
    return module  # type: ignore[no-any-return]


def main(commands: list[str]) -> None:
    """Import everything that is not Linux's, and run the commands in order."""
    import faintspot

    count = 0
    for module in pkgutil.walk_packages(faintspot.__path__, "faintspot.", onerror=lambda _: None):
        if module.name.startswith((*LINUX_ONLY, REQUESTS)) or module.name.endswith("__main__"):
            continue
        importlib.import_module(module.name)
        count += 1
    print(count, "modules")
    from faintspot.cli import main as command_line
    from faintspot.experiments.planner import tuning

    original = tuning.tune
    tuning.tune = lambda *given, **named: original(*given, **{**named, "realisations": 256, "steps": 1})
    for command in commands:
        command_line(command.split())


if __name__ == "__main__":
    hide()
    main(sys.argv[1:])
