"""How long tests wait for what must come: longer where FAINTSPOT_PATIENCE says so, as in an emulator."""

from __future__ import annotations

import os

LIMIT_S = 60.0 * float(os.environ.get("FAINTSPOT_PATIENCE", "1"))
