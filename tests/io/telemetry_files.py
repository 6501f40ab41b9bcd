"""Telemetry of a small sensor, for the tests of its files."""

from typing import Any

import numpy as np

from faintspot.io.telemetry import item_type

N, SHAPE, WINDOW = 8, (24, 24), (8, 8)
CELLS = [[row, column] for row in range(3) for column in range(3) if (row, column) != (1, 1)]
ATTRIBUTES: dict[str, Any] = {
    "name": "bench",
    "layout": {
        "frame_shape": SHAPE,
        "window": WINDOW,
        "corners": [[8 * row, 8 * column] for row, column in CELLS],
        "centres": [[8 * column + 3.75, 8 * row + 3.5] for row, column in CELLS],
        "cells": CELLS,
    },
    "settings": '[estimator]\nname = "tv"\nnoise_std = 1.5\n[settings]\nflux_e = 30.0\n',
    "methods": ["none", "tv"],
    "dropped_records": 2,
}
CHANGES = [
    {"frame": 12, "number": 1, "changes": {"noise_std": 2.5, "rule": "it's"}, "where": [1, 2]},
    {"frame": 20, "number": 2, "changes": {"noise_std": [i / 7 for i in range(200)]}, "where": None},
]
FLOATS = "x", "y", "flux", "standard_error_x", "standard_error_y", "covariance_xy"
SIZES = {"subaperture": N, "row": 24, "column": 24, "window_row": 8, "window_column": 8}
LATER = ("late", "lost", "lost_because", "loop", "commands")
RECORD, IMAGE = item_type("frame", SIZES, LATER), item_type("image", SIZES)
START_NS = 1_700_000_000_000_000_000


def records_of(first: int, count: int) -> np.ndarray:
    """Records of frames at 1 kHz, some 1000 s after the machine was started."""
    rng = np.random.default_rng(first)
    records = np.zeros(count, RECORD)
    records["frame"] = np.arange(first, first + count)
    records["method"], records["change"] = records["frame"] % 2, first
    records["last_row_time_ns"] = 10**12 + records["frame"] * 10**6
    records["published_time_ns"] = records["last_row_time_ns"] + 50_000
    records["clock_offset_ns"] = START_NS - 10**12
    for name in FLOATS:
        records[name] = rng.normal(size=(count, N))
    records["flags"][:, 3] = 1
    return records


def images_of(*frames: int) -> np.ndarray:
    images = np.zeros(len(frames), IMAGE)
    images["image_frame"] = frames
    images["raw"] = np.arange(24)[:, None] * 100 + np.arange(24) + np.array(frames)[:, None, None]
    images["denoised"] = np.array(frames)[:, None, None, None]
    return images
