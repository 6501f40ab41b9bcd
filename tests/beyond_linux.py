"""A script that is run on a machine as macOS is, as far as Linux can be taken away from a process.

Gone is what Linux adds to the modules os, signal, socket, time and resource, and all of /proc and /dev/shm;
processes are spawned, not forked, and run this script up to its last lines, too. It imports every module of
faintspot, real time included, and then runs commands, one an argument.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import multiprocessing
import os
import pkgutil
import resource
import signal
import socket
import sys
import tempfile  # noqa: F401 - remembers what this system has
import time
from typing import Any

LINUX_ONLY: dict[Any, str] = {
    os: "sched_ SCHED_ posix_f POSIX_F memfd_ MFD_ eventfd EFD_ pidfd_ P_PIDFD getxattr setxattr listxattr "
    "removexattr XATTR_ copy_file_range splice SPLICE_ getrandom GRND_ fdatasync setres getres unshare setns "
    "CLONE_ O_DIRECT O_PATH O_NOATIME O_RSYNC O_LARGEFILE",
    signal: "sigtimedwait sigwaitinfo SIGRT SIGSTKFLT SIGPWR SIGPOLL SIGCLD pidfd_",
    socket: "SO_PEERCRED SO_PASSCRED SO_BINDTODEVICE SOCK_CLOEXEC SOCK_NONBLOCK",
    time: "CLOCK_BOOTTIME CLOCK_TAI pthread_getcpuclockid",
    resource: "RLIMIT_RT RLIMIT_NICE RLIMIT_SIGPENDING prlimit",
}
"""What names begin with that macOS lacks."""
PLACES = ("/proc", "/dev/shm")


def take_linux_away() -> None:
    """Do it, to this process, for good."""
    for module, beginnings in LINUX_ONLY.items():
        for name in [name for name in dir(module) if name.startswith(tuple(beginnings.split()))]:
            delattr(module, name)
    if sys.version_info >= (3, 13):
        os.process_cpu_count = os.cpu_count  # as the module os has it elsewhere
    for name in ("stat", "lstat", "access"):
        setattr(os, name, functools.partial(_asked, getattr(os, name)))
    sys.addaudithook(_opened)
    multiprocessing.set_start_method("spawn", force=True)


def _gone(path: object) -> bool:
    return isinstance(path, (str, bytes, os.PathLike)) and os.fsdecode(path).startswith(PLACES)


def _asked(function: Any, path: Any, *arguments: Any, **options: Any) -> Any:
    if not _gone(path):
        return function(path, *arguments, **options)
    if function.__name__ == "access":
        return False
    raise FileNotFoundError(2, "No such file or directory", path)


def _opened(event: str, arguments: tuple[Any, ...]) -> None:
    if event in ("open", "os.listdir", "os.scandir", "os.mkdir", "os.link", "os.rename", "os.remove"):
        for path in filter(_gone, arguments[:1]):
            raise FileNotFoundError(2, "No such file or directory", path)


def main(commands: list[str]) -> None:
    """Import everything, and run the commands in order; an error of either is the script's."""
    import faintspot

    names = [module.name for module in pkgutil.walk_packages(faintspot.__path__, "faintspot.")]
    for name in names:
        if not name.endswith("__main__"):
            importlib.import_module(name)
    print(len(names), "modules")
    from faintspot.cli import main as command_line
    from faintspot.experiments.planner import tuning

    tuning.tune = functools.partial(tuning.tune, realisations=256, steps=1)  # quick
    for command in commands:
        command_line(command.split())


if __name__ == "__main__":
    with contextlib.suppress(ImportError):
        importlib.import_module("hcipy")  # has psutil read /proc, which is another one on macOS
take_linux_away()
if __name__ == "__main__":
    main(sys.argv[1:])
