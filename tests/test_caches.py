"""Every cache of the package has a bound, but for those named here."""

import ast
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import faintspot

SOURCE = Path(faintspot.__file__).parent

OF_THE_PROGRAM = {
    "adapters/base.py check_version",
    "adapters/pyrtc.py camera",
    "adapters/pyrtc.py loop",
    "adapters/pyrtc.py slopes_process",
    "cli/realtime/__init__.py _command",
    "engine/streams/image_layout.py _libc",
    "engine/streams/shared_streams.py _keeps_order",
    "slopes/camera/dark_frames.py _one_level_limit",
    "slopes/estimators/registry.py _load",
    "slopes/kernels/compiling.py _tell_once",
    "slopes/kernels/compiling.py _warn_once",
    "slopes/kernels/compiling.py _kernels_stamp",
    "slopes/kernels/host.py _lanes",
    "slopes/kernels/compiling.py compile_target",
    "slopes/kernels/groups.py driver_of",
    "slopes/kernels/parallel.py _pool",
    "slopes/kernels/total_variation/flat_start.py flat_start_table",
    "slopes/pipeline/slope_pipeline.py _checks",
}
"""Without a bound: of nothing, types, kernels, or sizes, of which a program has few; a few kB each."""


def caches() -> Iterator[tuple[str, int | None]]:
    """Every function that remembers results, and how many at most."""
    for path in sorted(SOURCE.rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text if "cache" in text else "")):
            for decorator in getattr(node, "decorator_list", []):
                name = ast.unparse(decorator).partition("(")[0].rpartition(".")[2]
                if name in ("cache", "lru_cache"):
                    name = node.name  # type: ignore[attr-defined]
                    file = path.relative_to(SOURCE)
                    module = import_module(".".join(["faintspot", *file.with_suffix("").parts]))
                    yield f"{file.as_posix()} {name}", getattr(module, name).cache_parameters()["maxsize"]


def test_every_other_cache_has_a_bound() -> None:
    bounds = dict(caches())
    assert {name for name, most in bounds.items() if most is None} == OF_THE_PROGRAM
