"""Tables and sentences on a study's estimators: photon efficiency and calibration of standard errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.page import Section
from faintspot.base.report.texts import Texts, number_or_dash
from faintspot.experiments.methods import knows_the_spot
from faintspot.experiments.study.curves import StudyConditions
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.slopes.estimators.built_in.maximum_a_posteriori import MaximumAPosteriori
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumLikelihood
from faintspot.slopes.estimators.built_in.weighted import Weighted

if TYPE_CHECKING:
    import xarray


Floats = NDArray[np.float64]

ENOUGH_PHOTONS = {0.1: 30.0, 3.0: 120.0, 16.0: 500.0}
"""Fewest electrons, by read noise, at which an estimator that knows the spot is expected at the bound."""
ML, MAP = MaximumLikelihood.name, MaximumAPosteriori.name
EXPECTED_EFFICIENCY = {ML: 0.95, MAP: 0.95, Weighted.name: 0.75}
"""Least photon efficiency, by method, where there is flux enough."""
NEAR_BEST = 1.04
"""Gain-corrected rms over the smallest of all methods up to which a method counts as near the best."""
_TEXT = Texts("faintspot.experiments")
_OUTLIERS = 0.01  # fraction of the likelihood's slopes, from which outliers dominate its error


def compares_estimators(dataset: xarray.Dataset) -> bool:
    """Whether a study has methods that know the spot."""
    return any(knows_the_spot(str(method)) for method in dataset["estimator"].values)


def enough_photons(read_noise_e: float, flux_e: float) -> bool:
    """Whether there is flux enough for the bound to be within reach.

    Between the read noises of `ENOUGH_PHOTONS`, logarithms are interpolated.
    """
    noises, fluxes = np.log(list(ENOUGH_PHOTONS)), np.log(list(ENOUGH_PHOTONS.values()))
    needed = np.exp(np.interp(np.log(max(read_noise_e, 1e-3)), noises, fluxes))
    return bool(flux_e >= needed * (1 - 1e-9))


def findings(dataset: xarray.Dataset) -> list[str]:
    """Return what a study says about the estimators, a sentence or two each."""
    cells, speckled = _finished(dataset, speckled=False), _finished(dataset, speckled=True)
    found = [*_efficient(cells), *_outlier_dominated(cells)]
    return found + (_near_the_best(speckled) if speckled.sizes["cell"] else [])


def calibration_sections(dataset: xarray.Dataset) -> list[Section]:
    """Return the table of stated over actual errors of estimators that know the spot; none without cells."""
    cells = _in_order(_finished(dataset, speckled=False))
    if not cells.sizes["cell"]:
        return []
    knowing = [method for method in _methods(dataset) if knows_the_spot(method)]
    stated = [cells[f"stated_over_actual{part}"].sel(estimator=knowing).values for part in ("", "_all")]
    rows = [
        [
            words,
            *(
                f"{number_or_dash(inliers)} ({number_or_dash(every)})"
                for inliers, every in zip(*pair, strict=True)
            ),
        ]
        for words, *pair in zip(_in_words(cells), *stated, strict=True)
    ]
    return [_TEXT.section("calibration-table", _TEXT.table("calibration-table", rows, knowing))]


def _finished(dataset: xarray.Dataset, *, speckled: bool) -> xarray.Dataset:
    """Return the finished cells of a study, with or without speckles."""
    done = dataset["done"].values & ((dataset["d_over_r0"].values > 0) == speckled)
    return dataset.isel(cell=np.flatnonzero(done)).transpose("cell", "estimator", ...)


def _in_order(cells: xarray.Dataset) -> xarray.Dataset:
    """Return cells by spot, camera and flux."""
    names = (
        "profile",
        "elongation",
        "size",
        "pixels",
        "position_range_px",
        "read_noise_e",
        "d_over_r0",
        "flux_e",
    )
    return cells.isel(cell=np.lexsort([cells[name].values for name in reversed(names)]))


def _methods(cells: xarray.Dataset) -> list[str]:
    return [str(method) for method in cells["estimator"].values]


def _in_words(cells: xarray.Dataset) -> list[str]:
    """Return each cell in one line."""
    names = StudyConditions.__dataclass_fields__
    columns = [cells[name].values.tolist() for name in names]
    keys = [StudyConditions(**dict(zip(names, values, strict=True))) for values in zip(*columns, strict=True)]
    fluxes = cells["flux_e"].values
    return [f"{flux:g} e-, {key.in_words()}" for flux, key in zip(fluxes, keys, strict=True)]


def _corrected_rms(cells: xarray.Dataset) -> tuple[Floats, Floats]:
    """Return the gain-corrected rms, (cells, methods), and its ratio to the smallest of all methods."""
    values = cells["corrected_rms"].sel(mode=corrected_mode(cells)).values
    return values, values / np.nanmin(values, axis=1, keepdims=True)


def _efficient(cells: xarray.Dataset) -> list[str]:
    conditions = zip(cells["read_noise_e"].values, cells["flux_e"].values, strict=True)
    enough = [enough_photons(float(noise), float(flux)) for noise, flux in conditions]
    bright = cells.isel(cell=np.flatnonzero(enough))
    sentences = []
    for method, target in EXPECTED_EFFICIENCY.items():
        if method in _methods(cells) and any(enough):
            efficiency = bright["photon_efficiency"].sel(mode=BEST, estimator=method).values
            lowest = int(np.argmin(efficiency))
            values = {"lowest": efficiency[lowest], "where": _in_words(bright)[lowest]}
            counts = {"reached": np.sum(efficiency >= target), "cells": len(efficiency)}
            sentences.append(_TEXT("findings.efficient", method=method, target=target, **counts, **values))
    return sentences


def _outlier_dominated(cells: xarray.Dataset) -> list[str]:
    if not {ML, MAP} <= set(_methods(cells)):
        return []
    best = cells.sel(mode=BEST)
    dominated = best.isel(cell=np.flatnonzero(best["outlier_fraction"].sel(estimator=ML).values > _OUTLIERS))
    if not dominated.sizes["cell"]:
        return []
    smallest, of_map = dominated["error"].values.min(axis=1), dominated.sel(estimator=MAP)
    error, stated = of_map["error"].values, of_map["stated_over_actual_all"].values
    return [
        _TEXT(
            "findings.outliers",
            limit=_OUTLIERS,
            cells=len(error),
            smallest=np.sum(error <= smallest),
            near=np.sum(error - smallest <= 2 * of_map["error_se"].values),
            most=np.max(error / smallest),
            low=stated.min(),
            high=stated.max(),
        )
    ]


def _near_the_best(cells: xarray.Dataset) -> list[str]:
    _, every = _corrected_rms(cells)
    d_over_r0 = cells["d_over_r0"].values
    sentences = []
    for words, part in (("all", d_over_r0 > 0), ("d/r0 up to 1", d_over_r0 <= 1), ("above 1", d_over_r0 > 1)):
        if part.any():
            near, worst = (every[part] <= NEAR_BEST).sum(axis=0), 100 * (every[part].max(axis=0) - 1)
            ranked = sorted(zip(-near, worst, _methods(cells), strict=True), key=lambda each: each[:2])[:5]
            listed = ", ".join(f"{name} {-count} (worst {percent:.0f} %)" for count, percent, name in ranked)
            counts = {"which": words, "cells": part.sum(), "near": 100 * (NEAR_BEST - 1)}
            sentences.append(_TEXT("findings.near_best", **counts, ranked=listed))
    return sentences


def corrected_mode(dataset: xarray.Dataset) -> str:
    """Return the mode whose settings are chosen for the gain-corrected rms, where the study has it."""
    return CORRECTED if CORRECTED in dataset["mode"].values else BEST
