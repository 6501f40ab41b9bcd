"""How much of faintspot a task loads: modules, and lines of code without docstrings, comments and blanks.

Each task runs in a fresh interpreter and a folder of its own, after the commands that make its files. Child
processes do not count. `python -m benchmarks.loaded TASK` lists the modules of one task.
"""

import ast
import io
import os
import shutil
import subprocess
import sys
import tempfile
import tokenize
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from benchmarks.measuring import Row, Table

_REPORT = """
import atexit, sys

def report():
    with open("loaded.txt", "w") as file:
        for name, module in sorted(sys.modules.items()):
            if name.partition(".")[0] == "faintspot" and getattr(module, "__file__", None):
                file.write(f"{name} {module.__file__}\\n")

atexit.register(report)
"""
_COMMAND = "from faintspot.cli import main; main({arguments!r}.split())"
_FRAMES = """
import numpy as np
y, x = np.mgrid[:16, :16] - 7.5
spots = np.tile(8 * np.exp(-(x**2 + y**2) / 8), (4, 4)) + 1
np.save("frames.npy", np.random.default_rng(1).poisson(spots, (300, 64, 64)).astype(np.float32))
"""
_FRAME = """
import numpy as np, faintspot as fs
layout = fs.Layout.grid((4, 4), pixels=16)
frame = np.random.default_rng(1).poisson(2.0, layout.frame_shape).astype(np.float32)
fs.SlopePipeline(layout, fs.Settings("tv", noise_std=0.5))(frame)
"""
_SMALL_LOOP = """
text = "[telescope]\\ndiameter_m = 1.8\\n[sensor]\\nsubapertures = 4\\npixels = 8\\nsamples = 9\\n"
open("small.toml", "w").write(text + "[run]\\nframes = 60\\nsettle_frames = 20\\n")
"""
_LAYOUT = "layout frames.npy --grid 4x4 -o faintspot.toml"
_SLOPES = "slopes frames.npy -o slopes.zarr"


@dataclass(frozen=True)
class Task:
    """What a user does, the commands that make its files, and the most lines that it may load."""

    run: str
    """Python code, or arguments of the command line."""
    most_lines: int
    before: tuple[str, ...] = ()
    beside: str = ""
    """Command that runs at the same time."""


TASKS = {
    "SlopePipeline, one TV frame": Task(_FRAME, 8_000),
    "slopes of a recording": Task(_SLOPES, 11_000, (_FRAMES, _LAYOUT)),
    "telemetry": Task("telemetry slopes.zarr --frame-rate-hz 250", 12_200, (_FRAMES, _LAYOUT, _SLOPES)),
    "loop magnitude": Task(
        "loop magnitude small.toml --quick --methods brightest --flux-e 20 --workers 0",
        15_700,
        (_SMALL_LOOP,),
    ),
    "realtime run": Task(
        "realtime run --frames 20 --name {name}",
        15_000,
        (_FRAMES, _LAYOUT),
        "realtime replay frames.npy --name {name}",
    ),
    "tune": Task("tune --read-noise-e 1 --pixels 8 --fwhm-px 1.8 --flux-e 100 -o tuned.toml", 16_000),
}


def _arguments(run: str, first: str = "") -> list[str]:
    code = run if "\n" in run else _COMMAND.format(arguments=run.format(name=f"loaded-{os.getpid()}"))
    return [sys.executable, "-c", first + code]


def _options(folder: str) -> dict[str, Any]:
    """Return how a process runs in a folder."""
    root = Path(__file__).parents[1] / "src"
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return {"cwd": folder, "env": os.environ | {"PYTHONPATH": str(root)}, **quiet}


@cache
def _lines(path: str) -> int:
    """Return the lines of code of a module."""
    text = Path(path).read_text(encoding="utf-8")
    ignored = ["COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER"]
    code: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if tokenize.tok_name[token.type] not in ignored:
            code.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        for part in body if isinstance(body, list) else ():
            if isinstance(part, ast.Expr) and isinstance(getattr(part.value, "value", None), str):
                code.difference_update(range(part.lineno, (part.end_lineno or part.lineno) + 1))
    return len(code)


@cache
def _made(before: tuple[str, ...]) -> tempfile.TemporaryDirectory[str]:
    """Return a folder with the files that commands make, each of them run once."""
    folder = tempfile.TemporaryDirectory()
    if before:
        shutil.copytree(_made(before[:-1]).name, folder.name, dirs_exist_ok=True)
        subprocess.run(_arguments(before[-1]), check=True, **_options(folder.name))
    return folder


def loaded(task: Task) -> dict[str, int]:
    """Return the lines of each module that a task loads."""
    with tempfile.TemporaryDirectory() as folder:
        options = _options(folder)
        shutil.copytree(_made(task.before).name, folder, dirs_exist_ok=True)
        beside = subprocess.Popen(_arguments(task.beside), **options) if task.beside else None
        try:
            subprocess.run(_arguments(task.run, _REPORT), check=True, **options)
        finally:
            if beside is not None:
                beside.kill()
                beside.wait()
        modules = (line.split(maxsplit=1) for line in (Path(folder) / "loaded.txt").read_text().splitlines())
        return {name: _lines(path) for name, path in modules}


def run() -> list[Table]:
    """Count for all tasks."""
    rows = []
    for name, task in TASKS.items():
        lines = loaded(task)
        total = sum(lines.values())
        values = {"modules": float(len(lines)), "lines": float(total)}
        rows.append(Row(name, values, f"{task.most_lines} lines", total <= task.most_lines))
    return [Table("loaded", "Modules and lines of faintspot that a task loads", rows)]


if __name__ == "__main__":
    for module, count in loaded(TASKS[sys.argv[1]]).items():
        print(f"{count:6} {module}")
