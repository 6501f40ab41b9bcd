"""Whether a folder holds the results of closed-loop experiments; light, so that other commands may ask."""

from __future__ import annotations

from pathlib import Path

INTERLEAVED_FILE = "interleaved.json"
MAGNITUDE_FILE = "magnitude.npz"
BUDGET_FILE = "budget.npz"
"""Names of the files in a folder of results; the sets beside the first are set-1.npz and so on."""


def holds_loop_results(path: Path) -> bool:
    """Return whether a folder holds results of `faintspot loop`."""
    return any((path / name).is_file() for name in (INTERLEAVED_FILE, MAGNITUDE_FILE, BUDGET_FILE))
