"""What tests do otherwise in an emulator, which sets FAINTSPOT_PATIENCE: how many times longer they wait."""

from __future__ import annotations

import os

LIMIT_S = 60.0 * float(os.environ.get("FAINTSPOT_PATIENCE", "1"))
"""How long to wait for what must come."""
