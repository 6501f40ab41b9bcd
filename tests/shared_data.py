"""Where tests find the real frames and reference values that are not part of the project."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[2] / "shared"


def shared_file(name: str) -> Path:
    """Return the path of a file of the shared folder; skip the test where it is absent."""
    path = Path(os.environ.get("FAINTSPOT_SHARED", _DEFAULT)) / name
    if not path.exists():
        pytest.skip(f"needs {name}, which is not part of the project (set FAINTSPOT_SHARED to its folder)")
    return path
