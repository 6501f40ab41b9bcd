"""The cells of a study: their parameters in words, and what they measured as a table."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.study.claims import BEST_MODE
from faintspot.study.specification import CORRECTED
from faintspot.study.sweep import PARAMETERS

if TYPE_CHECKING:
    import xarray


_STATISTICS = ("gain", "rms", "corrected_rms", "outlier_fraction", "photon_efficiency")


def mode_in_words(mode: str) -> str:
    """Return "best k", "fixed k = 40", or "best gain-corrected rms"."""
    if mode == CORRECTED:
        return "best gain-corrected rms"
    return "best k" if mode == BEST_MODE else f"fixed k = {mode.removeprefix('fixed')}"


def parameters_of(dataset: xarray.Dataset, cells: Sequence[int]) -> list[dict[str, Any]]:
    """Return the physical parameters of cells."""
    columns = {name: dataset[name].values for name in PARAMETERS}
    return [{name: column[cell].item() for name, column in columns.items()} for cell in cells]


def parameter_in_words(name: str, value: Any) -> str:
    """Return a cell's parameter with its unit."""
    words = {
        "flux_e": "{:g} e- signal",
        "read_noise_e": "{:g} e- read noise",
        "profile": "{} spots",
        "size": "size {:g}",
        "elongation": "elongated {:g} times",
        "pixels": "{0:g} × {0:g} px",
        "position_range_px": "positions within ±{:g} px",
        "background_e": "background {:g} e-/px",
        "em_gain": "EM gain {:g}",
        "d_over_r0": "d/r0 {:g}",
    }
    without = {
        ("elongation", 1.0): "round",
        ("background_e", 0.0): "no background",
        ("em_gain", 1.0): "no EM gain",
        ("d_over_r0", 0.0): "no turbulence",
    }
    return without.get((name, value)) or words[name].format(value)


def table_of_cells(dataset: xarray.Dataset, cells: Sequence[int]) -> tuple[list[str], list[list[Any]]]:
    """Return a table of all arms and modes of cells."""
    header = [
        *PARAMETERS,
        "mode",
        "arm",
        "R_px",
        "R_se_px",
        "chosen_k",
        "chosen_candidate",
        "invalid_fraction",
        *_STATISTICS,
    ]
    names = ("error", "error_se", "chosen_k", "chosen_candidate", "invalid_fraction", *_STATISTICS)
    arrays = [dataset[name].transpose("cell", "mode", "arm").values for name in names]
    rows = []
    for cell, parameters in zip(cells, parameters_of(dataset, cells), strict=True):
        for m, mode in enumerate(dataset["mode"].values):
            for a, arm in enumerate(dataset["arm"].values):
                values = [float(array[cell, m, a]) for array in arrays]
                if np.isfinite(values[0]):
                    rows.append([*parameters.values(), str(mode), str(arm), *(f"{v:.6g}" for v in values)])
    return header, rows
