"""What tests do otherwise in an emulator, which sets FAINTSPOT_PATIENCE: how many times longer they wait."""

from __future__ import annotations

import os
import time
from typing import Any

import pytest

LIMIT_S = 60.0 * float(os.environ.get("FAINTSPOT_PATIENCE", "1"))
"""How long to wait for what must come."""
not_emulated = pytest.mark.skipif(
    "FAINTSPOT_PATIENCE" in os.environ, reason="qemu-user 7.2 fails in processes that fork beside threads"
)


def wait_for(condition: Any, what: object = "") -> None:
    """Wait until something is so; fail after `LIMIT_S`."""
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, what
        time.sleep(0.001)
