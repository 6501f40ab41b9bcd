"""Whether a folder holds the results of a study; light, so that other commands may ask."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from faintspot.compare.store import store_attributes


def study_attributes(path: Path) -> dict[str, Any] | None:
    """Return the attributes of the store of a study, also of version 0.1; None for something else."""
    attributes = store_attributes(path)
    return attributes if attributes is not None and "specification" in attributes else None
