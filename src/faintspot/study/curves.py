"""The curves of a study: one configuration (all parameters of a cell but its flux) in one mode."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.compare.curves import Curve
from faintspot.errors import InputError

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True, order=True)
class Configuration:
    """All parameters of a cell but its flux; units as in the dataset."""

    profile: str
    position_range_px: float
    read_noise_e: float
    size: float
    elongation: float
    pixels: int
    background_e: float = 0.0
    em_gain: float = 1.0
    d_over_r0: float = 0.0

    @property
    def prior_error_px(self) -> float:
        """R of an estimator that always answers the centre: half of the range."""
        return self.position_range_px / 2

    def in_words(self) -> str:
        """Return the configuration in one line."""
        words = [
            f"{self.profile} spot of size {self.size:g}",
            f"{self.read_noise_e:g} e- read noise",
            f"{self.pixels} × {self.pixels} px",
            f"±{self.position_range_px:g} px",
        ]
        if self.elongation != 1:
            words.insert(1, f"elongated {self.elongation:g} times")
        if self.background_e:
            words.append(f"background {self.background_e:g} e-/px")
        if self.em_gain != 1:
            words.append(f"EM gain {self.em_gain:g}")
        if self.d_over_r0:
            words.append(f"d/r0 {self.d_over_r0:g}")
        return ", ".join(words)


def study_curves(dataset: xarray.Dataset, mode: str) -> dict[Configuration, Curve]:
    """Return the curve of every configuration in a mode, from the finished cells of a study.

    Raises
    ------
    InputError
        For a mode that the study does not have.
    """
    modes = [str(name) for name in dataset["mode"].values]
    if mode not in modes:
        raise InputError(f"mode {mode!r}: expected one of {', '.join(modes)}")
    arms = tuple(str(name) for name in dataset["arm"].values)
    of_mode = dataset[["error", "error_se", "error_covariance"]].sel(mode=mode)
    error = of_mode["error"].transpose("cell", "arm").values
    error_se = of_mode["error_se"].transpose("cell", "arm").values
    covariance = of_mode["error_covariance"].transpose("cell", "arm", "arm2").values
    flux = np.asarray(dataset["flux_e"].values, dtype=np.float64)
    return {
        configuration: Curve(
            configuration, flux[cells], arms, error[cells], error_se[cells], covariance[cells]
        )
        for configuration, cells in cells_by_configuration(dataset).items()
    }


def cells_by_configuration(dataset: xarray.Dataset) -> dict[Configuration, NDArray[np.int64]]:
    """Return the indices of the finished cells of every configuration, by increasing flux."""
    columns = {field.name: dataset[field.name].values for field in fields(Configuration)}
    found: dict[Configuration, list[int]] = {}
    for cell in np.flatnonzero(dataset["done"].values):
        values: dict[str, Any] = {name: column[cell].item() for name, column in columns.items()}
        found.setdefault(Configuration(**values), []).append(int(cell))
    flux = dataset["flux_e"].values
    return {key: np.array(sorted(cells, key=lambda cell: flux[cell])) for key, cells in found.items()}
