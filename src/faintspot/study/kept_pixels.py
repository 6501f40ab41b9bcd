"""How much the slope error depends on the number of brightest pixels kept (figure 5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from faintspot.study.curves import Configuration, cells_by_configuration

if TYPE_CHECKING:
    import xarray

KEPT_RANGE = (10, 60)
"""The smallest and largest k between which the dependence is measured."""

# Basden et al.'s text compares read noises at 50 electrons, the lower of the two signals of its first panel.
_WANTED_SIGNALS_E = (50.0, 200.0)
_SHOWN_NOISES_E = (0.1, 1.0, 3.0, 16.0)


@dataclass(frozen=True)
class KeptPanel:
    """The cells of one part of the figure: what varies, and (label, cell index) of each."""

    title: str
    cells: Sequence[tuple[str, int]]


def kept_panels(dataset: xarray.Dataset, profile: str) -> list[KeptPanel]:
    """Return the three parts of the figure for a spot profile: signals, spot sizes, read noises.

    16 x 16 pixels (or the study's largest), round spots, the smallest position range. Where a study does not
    have the paper's fluxes, the nearest are taken.
    """
    by_configuration = {
        configuration: cells
        for configuration, cells in cells_by_configuration(dataset).items()
        if configuration.profile == profile and configuration.elongation == 1
    }
    if not by_configuration:
        return []
    reach = min(configuration.position_range_px for configuration in by_configuration)
    pixels = max(configuration.pixels for configuration in by_configuration)
    kept = {c: i for c, i in by_configuration.items() if (c.position_range_px, c.pixels) == (reach, pixels)}
    noise = min(c.read_noise_e for c in kept) if kept else 0.0
    size = min(c.size for c in kept) if kept else 0.0
    low, high = _WANTED_SIGNALS_E
    quiet = [c for c in kept if c.read_noise_e == noise]
    sharp = [c for c in kept if c.size == size and c.read_noise_e in (*_SHOWN_NOISES_E, noise)]
    signals = [
        (f"{flux:g} e-", cell)
        for c in quiet
        if c.size == size
        for flux, cell in dict(_nearest(dataset, kept[c], wanted) for wanted in (low, high)).items()
    ]
    fixed = f"{profile}, {pixels} × {pixels} px, ±{reach:g} px"
    return [
        KeptPanel(f"signals, size {size:g}, {noise:g} e- read noise; {fixed}", signals),
        _panel("spot sizes", dataset, kept, sorted(quiet), low, f"{noise:g} e- read noise; {fixed}"),
        _panel("read noises", dataset, kept, sorted(sharp), low, f"size {size:g}; {fixed}"),
    ]


def spread(dataset: xarray.Dataset, cell: int, arm: str) -> tuple[float, float] | None:
    """Return ln(largest R / smallest R) for k within KEPT_RANGE, and an upper limit of its standard error.

    The two R are from the same realisations; their correlation, which is not known, would make the error
    smaller. None when the arm has no k or the cell too few pixels.
    """
    part = dataset.sel(arm=arm, k=slice(*KEPT_RANGE)).isel(cell=cell)
    values, errors = part["error_at_k"].values, part["error_at_k_se"].values
    if values.size < 2 or not np.all(np.isfinite(values)):
        return None
    low, high = int(np.argmin(values)), int(np.argmax(values))
    relative = np.hypot(errors[low] / values[low], errors[high] / values[high])
    return float(np.log(values[high] / values[low])), float(relative)


def _panel(
    what: str,
    dataset: xarray.Dataset,
    kept: dict[Configuration, np.ndarray],
    configurations: Sequence[Configuration],
    wanted_e: float,
    fixed: str,
) -> KeptPanel:
    """Return one cell of each configuration, all of one flux: the nearest to the wanted one they share."""
    cells = []
    for configuration in configurations:
        flux, cell = _nearest(dataset, kept[configuration], wanted_e)
        value = (
            f"size {configuration.size:g}" if what == "spot sizes" else f"{configuration.read_noise_e:g} e-"
        )
        cells.append((value, cell, flux))
    fluxes = {flux for _, _, flux in cells}
    at = f"{fluxes.pop():g} e-" if len(fluxes) == 1 else "signals as named"
    labelled = [
        (name if at != "signals as named" else f"{name}, {flux:g} e-", cell) for name, cell, flux in cells
    ]
    return KeptPanel(f"{what} at {at}, {fixed}", labelled)


def _nearest(dataset: xarray.Dataset, cells: np.ndarray, wanted_e: float) -> tuple[float, int]:
    flux = dataset["flux_e"].values[cells]
    best = int(np.argmin(np.abs(np.log(flux / wanted_e))))
    return float(flux[best]), int(cells[best])
