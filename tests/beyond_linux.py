"""A script that is run on a machine as macOS or Windows is, as far as Linux can be taken away from a process.

For "macos", what Linux adds to the modules os, signal, socket, time and resource is gone, and all of /proc
and /dev/shm; processes are spawned, not forked, and run this script up to its last lines, too. For "windows",
faintspot finds neither the modules of POSIX nor what Windows lacks in the modules os, signal, socket and
time; other packages keep them. Processes are spawned. Files in the working folder are as on Windows: one
that is open or mapped in this process is not replaced, renamed or removed, a rename replaces nothing, names
have no colons, folders cannot be opened, locked files are not written by others, and a file must be open
for writing to be synchronised. The script imports every module of faintspot that should work there, and then
runs commands, one an argument.
"""

import builtins
import contextlib
import fcntl
import functools
import importlib
import multiprocessing
import os
import pkgutil
import resource
import shutil
import signal
import socket
import sys
import time
import types
from pathlib import Path
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
NOT_ON_WINDOWS: dict[Any, str] = {
    os: "fork sched_ SCHED_ posix_ getuid geteuid getgid getegid getgroups getresuid setuid seteuid setsid "
    "getsid getpg setpg killpg chown fchown lchown chroot mkfifo mknod pread pwrite readv writev "
    "sendfile statvfs fstatvfs sysconf pathconf uname ttyname nice getloadavg getpriority O_CLOEXEC "
    "O_NOFOLLOW O_DIRECTORY O_NONBLOCK O_SYNC O_DSYNC fchdir fdatasync memfd_ eventfd pidfd_ getxattr "
    "copy_file_range splice register_at_fork lockf F_ WNOHANG wait3 wait4 openpty",
    signal: "SIGHUP SIGQUIT SIGKILL SIGUSR SIGALRM SIGPIPE SIGCHLD SIGCONT SIGSTOP SIGTSTP alarm setitimer "
    "pthread_ sigwait sigtimedwait pause siginterrupt",
    socket: "AF_UNIX SO_PEERCRED SOCK_CLOEXEC SOCK_NONBLOCK socketpair send_fds",
    time: "clock_ CLOCK_ tzset pthread_getcpuclockid",
}
"""What names begin with that Windows lacks."""
NOT_IN_NAMES = '<>:"|?*'
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
    for module, beginnings in NOT_ON_WINDOWS.items():
        lacking = tuple(beginnings.split())
        module.__class__ = type("Windows", (types.ModuleType,), {"__getattribute__": _without(lacking)})
    multiprocessing.set_start_method("spawn", force=True)
    shutil._use_fd_functions = False  # type: ignore[attr-defined]
    os.rename, os.fsync = functools.partial(_renamed, os.rename), functools.partial(_synchronised, os.fsync)
    sys.addaudithook(functools.partial(_as_on_windows, f"{Path.cwd()}{os.sep}"))


def _without(lacking: tuple[str, ...]) -> Any:
    def attribute(module: Any, name: str) -> Any:
        importer = str(sys._getframe(1).f_globals.get("__name__", ""))
        if name.startswith(lacking) and importer.startswith("faintspot"):
            raise AttributeError(f"module {module.__name__!r} has no attribute {name!r}")
        return types.ModuleType.__getattribute__(module, name)

    return attribute


def _renamed(rename: Any, old: Any, new: Any, **options: Any) -> None:
    if os.path.lexists(new):
        raise FileExistsError(17, "Cannot create a file when that file already exists", os.fsdecode(new))
    rename(old, new, **options)


def _synchronised(fsync: Any, descriptor: Any) -> None:
    number = descriptor if isinstance(descriptor, int) else descriptor.fileno()
    if fcntl.fcntl(number, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
        raise OSError(9, "Bad file descriptor")
    fsync(descriptor)


def _as_on_windows(folder: str, event: str, arguments: tuple[Any, ...]) -> None:
    """Refuse what Windows refuses for files in the folder."""
    if event not in ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir"):
        return
    changes = event != "open"
    for path in arguments[: 1 + (event == "os.rename")]:
        if not isinstance(path, (str, bytes, os.PathLike)):
            continue
        name = os.path.abspath(os.fsdecode(path))
        if not f"{name}{os.sep}".startswith(folder):
            continue
        if set(name[len(folder) :]) & set(NOT_IN_NAMES):
            raise OSError(22, "Invalid argument", name)
        if event == "open" and arguments[1] is None and os.path.isdir(name):
            raise PermissionError(13, "Permission denied", name)
        mapped_only = event == "open" and not name.endswith(".lock")
        if not (changes or "w" in str(arguments[1])) or not os.path.lexists(name):
            continue
        if _is_open(name, mapped_only=mapped_only):
            raise PermissionError(13, "The file is used by another process", name)


def _is_open(name: str, *, mapped_only: bool) -> bool:
    """Return whether this process has a file, or one in a folder, open or mapped."""
    with open("/proc/self/maps", encoding="utf-8", errors="replace") as lines:
        used = {line.split(maxsplit=5)[-1].strip() for line in lines}
    if not mapped_only:
        for number in os.listdir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                target = os.readlink(f"/proc/self/fd/{number}")
                used |= {target} if os.path.isfile(target) else set()
    return any(path == name or path.startswith(f"{name}{os.sep}") for path in used)


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
