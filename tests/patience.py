"""What tests do otherwise in an emulator, which sets FAINTSPOT_PATIENCE: how many times longer they wait."""

from __future__ import annotations

import os

import pytest

LIMIT_S = 60.0 * float(os.environ.get("FAINTSPOT_PATIENCE", "1"))
"""How long to wait for what must come."""
not_emulated = pytest.mark.skipif(
    "FAINTSPOT_PATIENCE" in os.environ, reason="qemu-user 7.2 fails in processes that fork beside threads"
)
