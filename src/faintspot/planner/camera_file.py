"""The camera file (TOML): what is known of camera, spot and star."""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any

from faintspot import configuration
from faintspot.errors import InputError
from faintspot.sensor.layout import Layout

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
    path = Path(path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not a TOML file: {error}") from None
    values: dict[str, Any] = {}
    for table, content in document.items():
        if table == "layout":
            values["layout"] = _layout(path, content)
            continue
        _known(f"{path}: ", table, [*TABLES, "layout"], "table")
        if not isinstance(content, dict):
            raise InputError(f"{path}: {table}: expected a table, got {content!r}")
        for key, value in content.items():
            _known(f"{path}: {table}.", key, list(TABLES[table]), "key")
            values[key] = value
    return values


def _layout(path: Path, content: Any) -> Layout:
    grid = content.get("grid") if isinstance(content, dict) else None
    if not isinstance(grid, dict):
        raise InputError(f"{path}: layout: expected a table [layout.grid]")
    for key in grid:
        _known(f"{path}: layout.grid.", key, list(configuration.GRID_KEYS), "key")
    for key in ("shape", "pixels"):
        if key not in grid:
            raise InputError(f"{path}: layout.grid.{key}: expected a value, found none")
    return Layout.grid(**grid)


def _known(prefix: str, name: str, known: list[str], what: str) -> None:
    if name not in known:
        close = difflib.get_close_matches(name, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"known: {', '.join(known)}"
        raise InputError(f"{prefix}{name}: unknown {what}; {hint}")
