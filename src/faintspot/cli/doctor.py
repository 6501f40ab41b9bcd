"""faintspot doctor: versions, extras and processor, for reports of faults."""

from __future__ import annotations

import os
import platform
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import click

from faintspot.base.extras import EXTRAS, present
from faintspot.base.json_text import to_json
from faintspot.base.version import __version__
from faintspot.cli.shared.commands import option

_REQUIRED = ("numpy", "scipy", "numba", "llvmlite", "tomlkit", "click", "rich")
_DISTRIBUTIONS = {"PIL": "pillow", "pyrtc": "pyrtcao"}
"""Names in the package index that differ from those of imports."""
_FORCING = ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "FAINTSPOT_SIMD_WIDTH", "NUMBA_DISABLE_JIT")


@dataclass(frozen=True)
class Finding:
    """A version, an extra or the processor."""

    name: str
    value: str
    """Finding, in one line."""
    advice: str | None = None
    """Advice, in one line; None where nothing is missing."""


@click.command()
@option("--json", "as_json", is_flag=True, help="As JSON: name, value and advice of each finding.")
def command(as_json: bool) -> None:
    """Show versions, extras and processor, and how to add what is missing.

    A missing extra is no error: most of faintspot needs none. Put the output into a report of a fault.

    \b
    Examples:
      faintspot doctor
      faintspot doctor --json > doctor.json
    """
    findings = examine()
    if as_json:
        click.echo(to_json([asdict(finding) for finding in findings], indent=1))
        return
    for finding in findings:
        click.echo(f"{finding.name:14s} {finding.value}")
        if finding.advice is not None:
            click.echo(f"{'':14s} -> {finding.advice}")


def examine() -> list[Finding]:
    """Return versions, extras and the processor; a broken installation is a finding, not an error."""
    system = f"{platform.system()} {platform.release()}"
    return [
        Finding("faintspot", f"{__version__} in {Path(__file__).parents[1]}"),
        Finding("Python", f"{platform.python_version()} ({system}, {platform.machine()})"),
        Finding("packages", ", ".join(f"{name} {_version(name)}" for name in _REQUIRED)),
        *(_extra(name) for name in EXTRAS),
        _processor(),
    ]


def _version(package: str) -> str:
    try:
        return version(_DISTRIBUTIONS.get(package, package))
    except PackageNotFoundError:
        return "of unknown version" if present(package) else "missing"


def _extra(name: str) -> Finding:
    packages = EXTRAS[name]
    missing = [package for package in packages if not present(package)]
    words = ", ".join(f"{package} {_version(package)}" for package in packages)
    return Finding(f"extra {name}", words, f"pip install 'faintspot[{name}]'" if missing else None)


def _processor() -> Finding:
    """Return the processor that kernels are compiled for."""
    try:
        from llvmlite import binding

        from faintspot.slopes.kernels.compilation.host import lanes_for
        from faintspot.slopes.kernels.compilation.target import compile_target

        target, host = compile_target(), binding.get_host_cpu_name()
        lanes = lanes_for("float32").width
    except Exception as error:
        words = " ".join(f"{type(error).__name__}: {error}".split())
        return Finding("processor", f"cannot be found out ({words})", "report this line")
    words = f"{host}; kernels for {target.cpu} ({target.triple}), {lanes} lanes of float32"
    forced = ", ".join(f"{name}={os.environ[name]}" for name in _FORCING if name in os.environ)
    advice = f"{forced}: unset for the fastest kernels on this machine" if forced else None
    return Finding("processor", words, advice)
