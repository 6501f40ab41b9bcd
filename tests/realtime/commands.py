"""Commands in processes of their own, which run this checkout."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import faintspot

SOURCE = str(Path(faintspot.__file__).parents[1])


def start(code: str, *arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Start a line of Python with arguments; its output and errors are kept unless told otherwise."""
    environment = {**os.environ, "PYTHONPATH": SOURCE, "OPENBLAS_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, "-c", code, *arguments], env=environment, **{**pipes, **options})
