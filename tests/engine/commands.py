"""Commands in processes of their own, which run this checkout."""

import multiprocessing
import multiprocessing.process
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import faintspot
from faintspot.engine.processes.segment import FOLDER, Segment

needs_shared_memory = pytest.mark.skipif(not FOLDER.is_dir(), reason="needs shared memory as Linux has it")
SOURCE = str(Path(faintspot.__file__).parents[1])


@contextmanager
def process(target: Callable[..., None], *arguments: Any) -> Iterator[multiprocessing.process.BaseProcess]:
    """Run a function in a process of its own, which is killed at the end if it has not ended."""
    started = multiprocessing.get_context("spawn").Process(target=target, args=arguments, daemon=True)
    started.start()
    try:
        yield started
    finally:
        started.kill()
        started.join()
        started.close()


def is_stale(segment: Segment) -> bool:
    """Ask again: a type checker takes a property for a constant."""
    return segment.stale


def start(code: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Start a line of Python with arguments; its output and errors are kept unless told otherwise."""
    environment = {**os.environ, "PYTHONPATH": SOURCE, "OPENBLAS_NUM_THREADS": "1"}
    usual: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "env": environment}
    return subprocess.Popen([sys.executable, "-c", code, *arguments], text=True, **{**usual, **options})
