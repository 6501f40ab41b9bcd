"""Small synthetic studies with known curves, in the form that a run of a study has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray

from faintspot.estimators.registry import estimator_named
from faintspot.experiments.arms import keeps_every_k

ARMS = ("brightest", "tv", "smoothed", "thresholded")
ESTIMATOR_ARMS = ("ml", "map", "weighted")
MODES = ("best", "fixed20", "fixed40", "fixed60")
DEFAULTS: dict[str, Any] = {
    "flux_e": 100.0,
    "read_noise_e": 0.1,
    "profile": "diffraction",
    "size": 1.0,
    "elongation": 1.0,
    "pixels": 16,
    "position_range_px": 1.0,
    "background_e": 0.0,
    "em_gain": 1.0,
    "d_over_r0": 0.0,
}
Cell = dict[str, Any]
FLUXES_E = (10.0, 30.0, 80.0, 300.0, 1000.0)


def cells(*, fluxes: Sequence[float] = FLUXES_E, **parameters: Any) -> list[Cell]:
    return [{**DEFAULTS, **parameters, "flux_e": flux} for flux in fluxes]


def power_law(gain: Callable[[Cell, str, str], float]) -> Callable[[Cell, str, str], float]:
    """R as if an arm had `gain(cell, arm, mode)` times the flux."""

    def error(cell: Cell, arm: str, mode: str) -> float:
        flux = cell["flux_e"] * gain(cell, arm, mode)
        return float(0.9 * cell["size"] * np.sqrt(1 / flux + (3 * cell["read_noise_e"] / flux) ** 2))

    return error


def dataset(
    every: list[Cell],
    error: Callable[[Cell, str, str], float],
    *,
    relative_se: float = 0.003,
    correlation: float = 0.6,
    rise_with_k: Callable[[str], float] = lambda arm: 0.5 if arm == "brightest" else 0.1,
    unfinished: Sequence[int] = (),
    arms: tuple[str, ...] = ARMS,
) -> xarray.Dataset:
    """Return the dataset of a study whose scored errors are exactly those of `error`."""
    n, k = len(every), np.arange(1, max(cell["pixels"] for cell in every) ** 2)
    values = np.array([[[error(cell, arm, mode) for mode in MODES] for arm in arms] for cell in every])
    se = relative_se * values
    bound = 0.9 * values[:, :, 0].min(axis=1)
    matrix = np.full((len(arms), len(arms)), correlation) + (1 - correlation) * np.eye(len(arms))
    covariance = np.einsum("cam,cbm,ab->cmab", se, se, matrix)
    rise = np.array([[1 + rise_with_k(arm) * np.log(k / 10) ** 2 / 3 for arm in arms]])
    at_k = values[:, :, :1] * rise
    beyond = np.array([cell["pixels"] ** 2 - 1 for cell in every])[:, None, None] < k
    at_k = np.where(beyond, np.nan, at_k)
    at_k[:, [not keeps_every_k(estimator_named(arm)) for arm in arms]] = np.nan
    done = np.ones(n, dtype=bool)
    done[list(unfinished)] = False
    choice = np.broadcast_to(0.5, values.shape).copy()
    data = {
        "error": (("cell", "arm", "mode"), values),
        "error_se": (("cell", "arm", "mode"), se),
        "error_covariance": (("cell", "mode", "arm", "arm2"), covariance),
        "chosen_k": (("cell", "arm", "mode"), np.full(values.shape, 12.0)),
        "chosen_candidate": (("cell", "arm", "mode"), choice),
        "chosen_model_error": (("cell", "arm", "mode"), np.zeros(values.shape)),
        "error_at_k": (("cell", "arm", "k"), at_k),
        "error_at_k_se": (("cell", "arm", "k"), relative_se * at_k),
        "invalid_fraction": (("cell", "arm", "mode"), np.zeros(values.shape)),
        "gain": (("cell", "arm", "mode"), np.full(values.shape, 0.9)),
        "gain_se": (("cell", "arm", "mode"), np.full(values.shape, 0.01)),
        "rms": (("cell", "arm", "mode"), 1.25 * values),
        "rms_se": (("cell", "arm", "mode"), 1.25 * se),
        "corrected_rms": (("cell", "arm", "mode"), 1.3 * values),
        "corrected_rms_se": (("cell", "arm", "mode"), 1.3 * se),
        "outlier_fraction": (("cell", "arm", "mode"), np.clip(values - 0.15, 0.0, 1.0)),
        "outlier_fraction_se": (("cell", "arm", "mode"), np.full(values.shape, 0.001)),
        "photon_efficiency": (("cell", "arm", "mode"), np.square(bound[:, None, None] / values)),
        "stated_over_actual": (("cell", "arm"), np.ones(values.shape[:2])),
        "stated_over_actual_all": (("cell", "arm"), np.full(values.shape[:2], 1.1)),
        "bound": (("cell",), bound),
        "bound_rms": (("cell",), 1.25 * bound),
    }
    for name, (dims, array) in data.items():
        array = array.astype(float)
        array[~done] = np.nan
        data[name] = (dims, array)
    coordinates = {name: ("cell", np.array([cell[name] for cell in every])) for name in DEFAULTS}
    return xarray.Dataset(
        {**data, "done": ("cell", done)},
        coords={**coordinates, "arm": list(arms), "mode": list(MODES), "arm2": list(arms), "k": k},
        attrs={
            "specification": 'name = "synthetic"\n',
            "seed": 1,
            "n": 2000,
            "fingerprint": "0",
            "faintspot_version": "0",
        },
    )
