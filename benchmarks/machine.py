"""What a machine is, and what runs on it: results of the same fingerprint can be compared."""

import hashlib
import json
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np

PACKAGES = (
    "faintspot",
    "numpy",
    "numba",
    "llvmlite",
    "jax",
    "scikit-image",
    "pyrtcao",
    "hcipy",
)


def fingerprint() -> dict[str, str]:
    """Return everything that must be the same for two runs to be comparable."""
    from faintspot.slopes.kernels.host import lanes_for
    from faintspot.slopes.kernels.parallel import available_cpus

    return {
        "processor": _processor(),
        "processors": f"{available_cpus()} of {os.cpu_count()}",
        "SIMD lanes (float32)": str(lanes_for(np.float32).width),
        "kernel": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
    }


def short(fingerprint: dict[str, str]) -> str:
    """Return eight characters that stand for a fingerprint."""
    return hashlib.sha256(json.dumps(fingerprint, sort_keys=True).encode()).hexdigest()[:8]


def versions() -> dict[str, str]:
    """Return the versions of the packages that are compared."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found


def load_average() -> str:
    """Return the load average of the last 1, 5 and 15 minutes."""
    return ", ".join(f"{load:.1f}" for load in os.getloadavg())


def _processor() -> str:
    information = Path("/proc/cpuinfo")
    if information.exists():
        names = [line for line in information.read_text().splitlines() if line.startswith("model name")]
        if names:
            return names[0].split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
