"""The camera file (TOML): what is known of camera, spot and star."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from faintspot.sensor.layout import GRID_KEYS, Layout
from faintspot.toml_files import check_keys, checked_table, parse_file

_LAYOUT = "layout"

TABLES = {
    "camera": ("read_noise_e", "gain_e_per_adu", "em_gain", "background_e", "pixels"),
    "spot": ("fwhm_px", "profile", "lenslet_m", "wavelength_nm", "pixel_scale_arcsec", "r0_m"),
    "star": (
        "magnitude",
        "flux_e",
        "band",
        "zero_point",
        "frame_rate_hz",
        "throughput",
        "quantum_efficiency",
    ),
    "tune": ("search_range_px", "budget"),
}
"""Keys of each table: the names of `Question`."""


def read_camera(path: str | Path) -> dict[str, Any]:
    """Return the values of a camera file by the names of `faintspot.planner.Question`.

    A table [layout.grid], as in a configuration, gives `layout`.

    Raises
    ------
    InputError
        When the file cannot be read or is not TOML, or has an unknown table or key.
    """
    document = parse_file(path)
    check_keys(f"{path}: ", document, [*TABLES, _LAYOUT], what="table")
    values: dict[str, Any] = {}
    for table, content in document.items():
        found = checked_table(f"{path}: {table}", content)
        if table == _LAYOUT:
            values[_LAYOUT] = _layout(path, found)
            continue
        check_keys(f"{path}: {table}.", found, TABLES[table])
        values |= found
    return values


def _layout(path: str | Path, content: dict[str, Any]) -> Layout:
    check_keys(f"{path}: layout.", content, ["grid"], required=["grid"])
    grid = checked_table(f"{path}: layout.grid", content["grid"])
    check_keys(f"{path}: layout.grid.", grid, GRID_KEYS, required=("shape", "pixels"))
    return Layout.grid(**grid)
