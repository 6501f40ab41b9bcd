"""Small synthetic studies with known curves, in the form that a run of a study has."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import xarray

from faintspot.experiments.methods import keeps_every_k
from faintspot.experiments.study.sweep import STANDARD
from faintspot.slopes.estimators.registry import estimator_named

METHODS = ("brightest", "tv", "smoothed", "thresholded")
ESTIMATOR_METHODS = ("ml", "map", "weighted")
MODES = ("best", "fixed20", "fixed40", "fixed60")
Cell = dict[str, Any]
FLUXES_E = (10.0, 30.0, 80.0, 300.0, 1000.0)


def cells(*, fluxes: Sequence[float] = FLUXES_E, **parameters: Any) -> list[Cell]:
    return [{**STANDARD, **parameters, "flux_e": flux} for flux in fluxes]


def power_law(gain: Callable[[Cell, str, str], float]) -> Callable[[Cell, str, str], float]:
    """R as if a method had `gain(cell, method, mode)` times the flux."""

    def error(cell: Cell, method: str, mode: str) -> float:
        flux = cell["flux_e"] * gain(cell, method, mode)
        return float(0.9 * cell["size"] * np.sqrt(1 / flux + (3 * cell["read_noise_e"] / flux) ** 2))

    return error


def dataset(
    every: list[Cell],
    error: Callable[[Cell, str, str], float],
    *,
    relative_se: float = 0.003,
    correlation: float = 0.6,
    rise_with_k: Callable[[str], float] = lambda method: 0.5 if method == "brightest" else 0.1,
    unfinished: Sequence[int] = (),
    methods: tuple[str, ...] = METHODS,
) -> xarray.Dataset:
    """Return the dataset of a study whose scored errors are exactly those of `error`."""
    n, k = len(every), np.arange(1, max(cell["pixels"] for cell in every) ** 2)
    values = np.array(
        [[[error(cell, method, mode) for mode in MODES] for method in methods] for cell in every]
    )
    se = relative_se * values
    bound = 0.9 * values[:, :, 0].min(axis=1)
    matrix = np.full((len(methods), len(methods)), correlation) + (1 - correlation) * np.eye(len(methods))
    covariance = np.einsum("cam,cbm,ab->cmab", se, se, matrix)
    rise = np.array([[1 + rise_with_k(method) * np.log(k / 10) ** 2 / 3 for method in methods]])
    at_k = values[:, :, :1] * rise
    beyond = np.array([cell["pixels"] ** 2 - 1 for cell in every])[:, None, None] < k
    at_k = np.where(beyond, np.nan, at_k)
    at_k[:, [not keeps_every_k(estimator_named(method)) for method in methods]] = np.nan
    done = np.ones(n, dtype=bool)
    done[list(unfinished)] = False
    choice = np.broadcast_to(0.5, values.shape).copy()
    data = {
        "error": (("cell", "estimator", "mode"), values),
        "error_se": (("cell", "estimator", "mode"), se),
        "error_covariance": (("cell", "mode", "estimator", "estimator2"), covariance),
        "chosen_k": (("cell", "estimator", "mode"), np.full(values.shape, 12.0)),
        "chosen_candidate": (("cell", "estimator", "mode"), choice),
        "chosen_model_error": (("cell", "estimator", "mode"), np.zeros(values.shape)),
        "error_at_k": (("cell", "estimator", "k"), at_k),
        "error_at_k_se": (("cell", "estimator", "k"), relative_se * at_k),
        "invalid_fraction": (("cell", "estimator", "mode"), np.zeros(values.shape)),
        "gain": (("cell", "estimator", "mode"), np.full(values.shape, 0.9)),
        "gain_se": (("cell", "estimator", "mode"), np.full(values.shape, 0.01)),
        "rms": (("cell", "estimator", "mode"), 1.25 * values),
        "rms_se": (("cell", "estimator", "mode"), 1.25 * se),
        "corrected_rms": (("cell", "estimator", "mode"), 1.3 * values),
        "corrected_rms_se": (("cell", "estimator", "mode"), 1.3 * se),
        "outlier_fraction": (("cell", "estimator", "mode"), np.clip(values - 0.15, 0.0, 1.0)),
        "outlier_fraction_se": (("cell", "estimator", "mode"), np.full(values.shape, 0.001)),
        "photon_efficiency": (("cell", "estimator", "mode"), np.square(bound[:, None, None] / values)),
        "stated_over_actual": (("cell", "estimator"), np.ones(values.shape[:2])),
        "stated_over_actual_all": (("cell", "estimator"), np.full(values.shape[:2], 1.1)),
        "bound": (("cell",), bound),
        "bound_rms": (("cell",), 1.25 * bound),
    }
    for name, (dims, array) in data.items():
        array = array.astype(float)
        array[~done] = np.nan
        data[name] = (dims, array)
    coordinates = {name: ("cell", np.array([cell[name] for cell in every])) for name in STANDARD}
    return xarray.Dataset(
        {**data, "done": ("cell", done)},
        coords={
            **coordinates,
            "estimator": list(methods),
            "mode": list(MODES),
            "estimator2": list(methods),
            "k": k,
        },
        attrs={
            "specification": 'name = "synthetic"\n',
            "seed": 1,
            "n": 2000,
            "fingerprint": "0",
            "faintspot_version": "0",
        },
    )
