"""Where tests find the files of the project, and real frames and reference values that are not part of it."""

import os
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
"""Folder of the project."""
_DEFAULT = ROOT.parent / "shared"


def shared_file(name: str) -> Path:
    """Return the path of a file of the shared folder; skip the test where it is absent."""
    path = Path(os.environ.get("FAINTSPOT_SHARED", _DEFAULT)) / name
    if not path.exists():
        pytest.skip(f"needs {name}, which is not part of the project (set FAINTSPOT_SHARED to its folder)")
    return path


def skip_without(package: str) -> None:
    """Skip the tests of a module where a package is not installed; import none, which takes seconds."""
    if find_spec(package) is None:
        pytest.skip(f"{package} is not installed", allow_module_level=True)
