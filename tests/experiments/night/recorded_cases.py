"""Stores of telemetry as the engine's recorder writes them, with methods that alternate."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.engine.telemetry.ring import image_type, layout_values, record_type
from faintspot.loop.control.configuration import Control, packed_control
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.sensor.layout import Layout

BEGIN_S = 1.7e9
"""Unix time of the first frame."""


def write_recording(
    path: Path,
    layout: Layout,
    slopes_px: NDArray[Any],
    commands: NDArray[Any],
    method: NDArray[Any],
    methods: Sequence[str],
    interaction: NDArray[np.float64],
    *,
    rate_hz: float = 250.0,
    options: ControlOptions | None = None,
    changes: Sequence[dict[str, Any]] = (),
    loop: int = 2,
) -> Path:
    """Write frames; `commands` are those computed from each frame."""
    frames, n = len(slopes_px), len(layout)
    records = np.zeros(frames, record_type(n, commands.shape[1]))
    records["frame"] = np.arange(frames)
    records["method"], records["loop"] = method, loop
    records["last_row_time_ns"] = np.rint(1e9 / rate_hz * np.arange(frames))
    records["published_time_ns"] = records["last_row_time_ns"] + 100_000
    records["clock_offset_ns"] = round(1e9 * BEGIN_S)
    records["x"], records["y"] = np.split(slopes_px, 2, axis=1)
    records["commands"] = commands
    control = Control(interaction, options=options or ControlOptions())
    attributes = {
        "name": "bench",
        "layout": layout_values(layout),
        "settings": '[estimator]\nname = "tv"\nnoise_std = 1.0\n',
        "methods": list(methods),
        "control": packed_control(control),
    }
    kinds = record_type(n, commands.shape[1]), image_type(layout.frame_shape, n, layout.window)
    store = TelemetryStore(path, *kinds, attributes)
    store.append(records, np.empty(0, kinds[1]), {"changes": list(changes), "complete": True})
    return store.path
