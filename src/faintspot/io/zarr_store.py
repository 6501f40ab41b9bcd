"""What a Zarr store is on the disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from faintspot.files import replace_file

TELEMETRY = "faintspot telemetry"
"""What a store of telemetry has as its format."""
_MARKS = ("zarr.json", ".zgroup", ".zarray")


def is_store(path: Path) -> bool:
    """Tell whether a directory is a Zarr group or array."""
    return any((path / mark).is_file() for mark in _MARKS)


def holds_telemetry(path: Path) -> bool:
    """Tell whether a path is a store of telemetry, as `faintspot.io.telemetry` writes it."""
    try:
        attributes = json.loads((path / "zarr.json").read_text(encoding="utf-8"))["attributes"]
        return bool(attributes["format"] == TELEMETRY)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def replace_attributes(path: Path, changed: Mapping[str, Any]) -> None:
    """Change attributes of a group in one step, which the store's own setter does not promise."""
    metadata = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    metadata["attributes"].update(changed)
    replace_file(path / "zarr.json", json.dumps(metadata, indent=2))
