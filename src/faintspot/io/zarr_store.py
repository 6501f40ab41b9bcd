"""What a Zarr store is on the disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from faintspot.files import replace_file

_MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_store(path: Path) -> bool:
    """Tell whether a directory is a Zarr group or array."""
    return any((path / mark).is_file() for mark in _MARKS)


def replace_attributes(path: Path, changed: Mapping[str, Any]) -> None:
    """Change attributes of a group in one step, which the store's own setter does not promise."""
    metadata = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    metadata["attributes"].update(changed)
    replace_file(path / "zarr.json", json.dumps(metadata, indent=2))
