"""Whether a folder holds the results of a study; light, so that other commands may ask."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def study_attributes(path: Path) -> dict[str, Any] | None:
    """Return the attributes of the store of a study; None when it is something else."""
    try:
        text = (path / "zarr.json").read_text(encoding="utf-8")
        attributes: dict[str, Any] = json.loads(text)["attributes"]
    except (OSError, ValueError, KeyError):
        return None
    return attributes if {"fingerprint", "specification"} <= attributes.keys() else None
