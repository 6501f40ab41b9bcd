"""A folder with a C library, and the bundles of the sensors that it measures."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import NamedTuple

from faintspot.adapters.library.bundle import PIXELS, Call, Variant, bundle_of, check_exportable
from faintspot.adapters.library.objects import TARGETS, fingerprint, object_file, targets_of
from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.base.files import output_errors, write_atomically
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline

_FLAGS = "-O2 -fPIC -shared -fvisibility=hidden -Wl,--no-undefined"
BUILD = f"{_FLAGS} -o libfaintspot.so faintspot.c kernels/*.o -lm"
"""Arguments of a C compiler, in the folder."""


class ExportedLibrary(NamedTuple):
    """Result of an export."""

    bundle: Path
    """Tables of the sensor and estimator."""
    library: Path | None
    """The library; None if there is no C compiler, or it was not asked for."""
    build_line: str
    """Command that builds the library."""
    compiled: int
    """Number of kernels that were compiled; others were in the folder."""


def export_library(
    pipeline: SlopePipeline,
    folder: str | Path,
    name: str = "sensor",
    *,
    cpus: Sequence[str] = (),
    compiler: str | None = "cc",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ExportedLibrary:
    """Write a C library that measures as a pipeline does, and the bundle of its sensor.

    The folder gets faintspot.h, faintspot.c, kernels as object files and NAME.bundle. Exports of several
    sensors or estimators into the same folder share one library; nothing is compiled twice.

    Parameters
    ----------
    pipeline : SlopePipeline
    folder : path
    name : str
        Name of the bundle.
    cpus : sequence of str
        Kinds of processors, of `objects.TARGETS`; the library chooses the fastest that it runs on. Default:
        all like this one.
    compiler : str, optional
        C compiler. None: do not build the library.
    progress : function
        Called with the number of kernels that are compiled, and of all.

    Raises
    ------
    InputError
        When the settings are not covered, the folder cannot be written, or a compiler fails.
    """
    check_exportable(pipeline)
    chosen = [one_of("cpu", cpu, tuple(TARGETS)) for cpu in cpus] or targets_of(platform.machine())
    wanted = [cpu for cpu in TARGETS if cpu in chosen]
    machine = _only_machine(Path(folder) / "kernels", wanted)
    folder = Path(folder)
    with output_errors(folder):
        (folder / "kernels").mkdir(parents=True, exist_ok=True)
    variants = [(Variant.of(pipeline, kind, TARGETS[cpu].width), cpu) for cpu in wanted for kind in PIXELS]
    keys = [(_key(variant.measure, cpu), _key(variant.check, cpu)) for variant, cpu in variants]
    calls = {
        key: (call, cpu)
        for (variant, cpu), pair in zip(variants, keys, strict=True)
        for key, call in zip(pair, (variant.measure, variant.check), strict=True)
    }
    compiled = _compile(folder / "kernels", calls, progress)
    parts = [(variant, *pair) for (variant, _), pair in zip(variants, keys, strict=True)]
    bundle = folder / f"{name}.bundle"
    write_atomically(bundle, bundle_of(parts, pipeline.fingerprint()))
    for file in ("faintspot.h", "faintspot.c"):
        write_atomically(folder / file, (files(__package__) / "runtime" / file).read_bytes())
    objects = sorted((folder / "kernels").glob("*.o"))
    rows = (f"KERNEL({path.stem.partition('-')[0]}, {path.stem.partition('-')[2]})" for path in objects)
    write_atomically(folder / "kernels" / "list.h", "\n".join([*rows, ""]))
    build_line = f"cd {folder} && cc {BUILD}"
    library = _built(folder, compiler if machine == platform.machine() else None)
    return ExportedLibrary(bundle, library, build_line, compiled)


def _only_machine(folder: Path, cpus: Sequence[str]) -> str:
    """Return the kind of the processors; refuse several kinds in one folder of kernels."""
    levels = {int(path.stem.rpartition("-")[2]) for path in folder.glob("*.o")}
    machines = {target.machine for target in TARGETS.values() if target.level in levels}
    machines |= {TARGETS[cpu].machine for cpu in cpus}
    if len(machines) > 1:
        raise InputError(f"cpu: {' and '.join(sorted(machines))} in {folder}: choose another folder for each")
    return machines.pop()


def _key(call: Call, cpu: str) -> str:
    return fingerprint(call.kernel, call.kinds, cpu)


def _compile(folder: Path, calls: dict[str, tuple[Call, str]], progress: Callable[[int, int], None]) -> int:
    """Write the object files that are missing; return their number."""
    missing = {key: call for key, call in calls.items() if not (folder / _object_name(key, call[1])).exists()}
    for done, (key, (call, cpu)) in enumerate(missing.items()):
        progress(done, len(missing))
        content = object_file(call.kernel, call.kinds, cpu, f"faintspot_kernel_{key}")
        write_atomically(folder / _object_name(key, cpu), content)
    progress(len(missing), len(missing))
    return len(missing)


def _object_name(key: str, cpu: str) -> str:
    return f"{key}-{TARGETS[cpu].level}.o"


def _built(folder: Path, compiler: str | None) -> Path | None:
    """Build the library if there is a compiler."""
    if compiler is None or shutil.which(compiler) is None:
        return None
    line = f"{compiler} {BUILD}"
    done = subprocess.run(["sh", "-c", line], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[0]
        raise InputError(f"{folder}: `{line}` failed ({reason})")
    return folder / "libfaintspot.so"
