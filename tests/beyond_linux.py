"""A script that is run on a machine as macOS or Windows is, as far as Linux can be taken away from a process.

For "macos", what Linux adds to the modules os, signal, socket, time and resource is gone, and all of /proc
and /dev/shm; processes are spawned, not forked, and run this script up to its last lines, too. For "windows",
faintspot does not find the modules of POSIX, and functions of the module os are gone; other packages keep
the modules. The script imports every module of faintspot that should work there, and then runs commands, one
an argument.
"""

import builtins
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

POSIX_MODULES = {"fcntl", "grp", "pty", "pwd", "readline", "resource", "syslog", "termios", "tty"}
POSIX_FUNCTIONS = ("pread", "pwrite", "mkfifo", "getuid", "sched_getaffinity", "O_CLOEXEC")
NEED_POSIX = (
    "faintspot.engine",
    "faintspot.cli.realtime",
    "faintspot.cli.realtime.engine_requests",
    "faintspot.adapters.pyrtc",
)


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


def take_posix_away() -> None:
    """Do it, to this process, for good."""
    original = builtins.__import__

    def visible(name: str, variables: Any = None, *arguments: Any, **options: Any) -> Any:
        importer = str((variables or {}).get("__name__", ""))
        if name.split(".")[0] in POSIX_MODULES and importer.startswith("faintspot"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return original(name, variables, *arguments, **options)

    builtins.__import__ = visible  # type: ignore[assignment]
    for name in POSIX_FUNCTIONS:
        if hasattr(os, name):
            delattr(os, name)
    effective_user = os.geteuid

    def geteuid() -> int:
        """Return the user to other packages, which see POSIX and lock files as there."""
        if sys._getframe(1).f_globals["__name__"].startswith("faintspot"):
            raise AttributeError("module 'os' has no attribute 'geteuid'")
        return effective_user()

    os.geteuid = geteuid


def main(left_out: tuple[str, ...], commands: list[str]) -> None:
    """Import everything but what is left out, and run the commands in order; any error is the script's."""
    import faintspot

    names = [
        module.name for module in pkgutil.walk_packages(faintspot.__path__, "faintspot.", lambda _: None)
    ]
    names = [name for name in names if not name.startswith(left_out) and not name.endswith("__main__")]
    for name in names:
        importlib.import_module(name)
    print(len(names), "modules")

    from faintspot.cli import main as command_line
    from faintspot.experiments.planner import tuning

    tune = tuning.tune
    tuning.tune = lambda *given, **named: tune(*given, **{**named, "realisations": 256, "steps": 1})  # quick
    for command in commands:
        command_line(command.split())


if "windows" in sys.argv[1:2]:
    take_posix_away()
elif "macos" in sys.argv[1:2]:
    if __name__ == "__main__":
        with contextlib.suppress(ImportError):
            importlib.import_module("hcipy")  # has psutil read /proc, which is another one on macOS
    take_linux_away()
if __name__ == "__main__":
    main(NEED_POSIX if sys.argv[1] == "windows" else (), sys.argv[2:])
