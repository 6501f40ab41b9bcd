"""Examination of an installation and its machine, with advice, for bug reports."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from faintspot.base.extras import EXTRAS, SHARED_MEMORY, present
from faintspot.base.version import __version__

_REQUIRED = ("numpy", "scipy", "numba", "llvmlite", "tomlkit", "click", "rich")
_NETWORK = ("nfs", "cifs", "smb", "lustre", "gpfs", "beegfs", "ceph", "afs", "fuse.sshfs", "9p")
_LITTLE_MB = 256  # of shared memory: a ring of four frames of 2048 x 2048 pixels, its streams and telemetry
_TRY_S = 60.0
_TRY_REAL_TIME = """
from faintspot.engine.requests.scheduling import real_time
with real_time(priority=1) as refused:
    pass
print("; ".join(refused))
"""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    name: str
    """What."""
    value: str
    """Finding, in one line."""
    advice: str | None = None
    """Advice, in one line; None where nothing is missing."""


def examine() -> list[Finding]:
    """Look at versions, extras, processor, cache, threads, shared memory and real-time permissions.

    Nothing that it finds, or fails to find out, raises.

    Examples
    --------
    >>> from faintspot.cli.examination import examine
    >>> [finding.name for finding in examine()][:2]
    ['faintspot', 'Python']
    """
    findings = [
        Finding("faintspot", f"{__version__} in {Path(__file__).parent}"),
        Finding("Python", f"{platform.python_version()} ({platform.platform()}, {platform.machine()})"),
        Finding("packages", ", ".join(f"{name} {_version(name)}" for name in _REQUIRED)),
        *(_extra(name) for name in EXTRAS),
    ]
    checks: tuple[tuple[str, Callable[[], Finding]], ...] = (
        ("processor", _processor),
        ("cache", _cache),
        ("threads", _threads),
        ("shared memory", _shared_memory),
        ("real time", _real_time),
    )
    return findings + [_tried(name, check) for name, check in checks]


def _tried(name: str, check: Callable[[], Finding]) -> Finding:
    try:
        return check()
    except Exception as error:  # a broken installation is what it is asked about
        words = " ".join(f"{type(error).__name__}: {error}".split())
        return Finding(name, f"cannot be found out ({words})", "report this line")


def _version(package: str) -> str:
    try:
        return version(package.replace("_", "-"))
    except PackageNotFoundError:
        return "of unknown version" if present(package) else "missing"


def _extra(name: str) -> Finding:
    packages = EXTRAS[name]
    missing = [package for package in packages if not present(package)]
    words = ", ".join(f"{package} {_version(package)}" for package in packages)
    return Finding(f"extra {name}", words, f"pip install 'faintspot[{name}]'" if missing else None)


def _processor() -> Finding:
    """Processor that kernels are compiled for."""
    from llvmlite import binding

    from faintspot.slopes.kernels.compilation.host import lanes_for
    from faintspot.slopes.kernels.compilation.target import compile_target

    target, host = compile_target(), binding.get_host_cpu_name()
    words = (
        f"{host}; kernels for {target.cpu} ({target.triple}), {lanes_for('float32').width} lanes of float32"
    )
    forced = {
        name: os.environ[name]
        for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "FAINTSPOT_SIMD_WIDTH", "NUMBA_DISABLE_JIT")
        if name in os.environ
    }
    if not forced:
        return Finding("processor", words)
    said = ", ".join(f"{name}={value}" for name, value in forced.items())
    return Finding("processor", words, f"{said}: unset for the fastest kernels on this machine")


def _cache() -> Finding:
    """Folder of compiled kernels."""
    from faintspot.slopes.kernels.compilation.cached import cache_folder

    folder, advice = cache_folder(), "set NUMBA_CACHE_DIR to a folder that can be written"
    if folder is None:
        return Finding("cache", "no folder for compiled kernels can be written", advice)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return Finding("cache", f"{folder}: cannot be written ({error.strerror or error})", advice)
    size_mb = sum(path.stat().st_size for path in folder.glob("*.nb?")) / 1e6
    kind = file_system(folder)
    words = f"{folder}: can be written, {size_mb:.0f} MB of compiled kernels, file system {kind}"
    if kind.startswith(_NETWORK):
        return Finding("cache", words, "slow to start from: set NUMBA_CACHE_DIR to a folder on a local disk")
    return Finding("cache", words)


def file_system(path: Path, mounts: Path = Path("/proc/self/mounts")) -> str:
    """Return the kind of file system that a path is on, such as "ext4" or "nfs4"; "unknown" beyond Linux."""
    try:
        lines = [line.split() for line in mounts.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return "unknown"
    place = path.resolve()
    points = [(Path(point.replace("\\040", " ")), kind) for _, point, kind, *_ in lines]
    over = [(len(point.parts), kind) for point, kind in points if place.is_relative_to(point)]
    return max(over, key=lambda each: each[0])[1] if over else "unknown"


def _threads() -> Finding:
    from faintspot.slopes.kernels.parallel import available_cpus

    usable, there = available_cpus(), os.cpu_count() or 1
    advice = None
    if usable < there:
        advice = "the rest is kept from this process by its affinity (taskset, a scheduler of jobs)"
    return Finding("threads", f"{usable} of {there} processors", advice)


def _shared_memory() -> Finding:
    """For `faintspot realtime`."""
    if not SHARED_MEMORY.is_dir():
        return Finding("shared memory", f"no {SHARED_MEMORY}", "faintspot realtime needs Linux")
    free_mb = shutil.disk_usage(SHARED_MEMORY).free / 1e6
    words = f"{free_mb:.0f} MB free in {SHARED_MEMORY}"
    if not os.access(SHARED_MEMORY, os.W_OK):
        return Finding("shared memory", f"{words}, cannot be written", f"chmod 1777 {SHARED_MEMORY}, as root")
    if free_mb < _LITTLE_MB:
        advice = f"big cameras need more: mount -o remount,size=2G {SHARED_MEMORY}; in Docker --shm-size=2g"
        return Finding("shared memory", words, advice)
    return Finding("shared memory", words)


def _real_time() -> Finding:
    """Whether `faintspot realtime run --priority` would be permitted: tried, in a process of its own."""
    if not hasattr(os, "sched_setscheduler"):
        return Finding("real time", "no real-time scheduling", "faintspot realtime needs Linux")
    import resource

    limits = ", ".join(
        f"{name} {'unlimited' if soft == resource.RLIM_INFINITY else soft}"
        for name, (soft, _) in (
            ("rtprio", resource.getrlimit(resource.RLIMIT_RTPRIO)),
            ("memlock", resource.getrlimit(resource.RLIMIT_MEMLOCK)),
        )
    )
    tried = subprocess.run(
        [sys.executable, "-c", _TRY_REAL_TIME],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)},
        capture_output=True,
        text=True,
        timeout=_TRY_S,
        check=True,
    )
    refused = tried.stdout.strip()
    if not refused:
        return Finding("real time", f"SCHED_FIFO and locked memory are permitted (limits: {limits})")
    advice = (
        "for --priority, in /etc/security/limits.d/faintspot.conf: '@GROUP - rtprio 99' and "
        "'@GROUP - memlock unlimited', then log in again; in Docker --ulimit rtprio=99 --ulimit memlock=-1"
    )
    return Finding("real time", f"not permitted: {refused} (limits: {limits})", advice)
