"""Tables and sentences on a study's estimators: photon efficiency and calibration of standard errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.page import Section
from faintspot.base.report.texts import Texts
from faintspot.experiments.methods import knows_the_spot
from faintspot.experiments.study.curves import Configuration
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.experiments.words import number_or_dash
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


class _Cells:
    """Finished cells of a study, with their values by method."""

    def __init__(self, dataset: xarray.Dataset, speckled: bool) -> None:
        done = dataset["done"].values & ((dataset["d_over_r0"].values > 0) == speckled)
        self._dataset = dataset.isel(cell=np.flatnonzero(done))
        self.methods = [str(method) for method in dataset["estimator"].values]
        self.count = int(done.sum())

    def coordinate(self, name: str) -> NDArray[Any]:
        return self._dataset[name].values

    def values(self, name: str, mode: str | None = None) -> Floats:
        """Values of all methods, (cells, methods)."""
        variable = self._dataset[name] if mode is None else self._dataset[name].sel(mode=mode)
        return np.asarray(variable.transpose("cell", "estimator").values, dtype=np.float64)

    def of(self, name: str, method: str, mode: str | None = BEST) -> Floats:
        """Values of one method, (cells,)."""
        return self.values(name, mode)[:, self.methods.index(method)]

    def words(self, cell: int) -> str:
        """A cell in one line."""
        names = Configuration.__dataclass_fields__
        configuration = Configuration(**{name: self.coordinate(name)[cell].item() for name in names})
        return f"{self.coordinate('flux_e')[cell]:g} e-, {configuration.in_words()}"

    def order(self) -> list[int]:
        """Indices by spot, camera and flux."""
        names = ("profile", "elongation", "size", "pixels", "position_range_px", "read_noise_e")
        keys = [self.coordinate(name) for name in (*names, "d_over_r0", "flux_e")]
        return [int(index) for index in np.lexsort(keys[::-1])]


def findings(dataset: xarray.Dataset) -> list[str]:
    """Return what a study says about the estimators, a sentence or two each."""
    sentences = []
    cells = _Cells(dataset, speckled=False)
    if cells.count:
        sentences += _efficient(cells)
        sentences += _outlier_dominated(cells)
    speckled = _Cells(dataset, speckled=True)
    if speckled.count:
        sentences += _near_the_best(speckled, dataset)
    return sentences


def _efficient(cells: _Cells) -> list[str]:
    conditions = zip(cells.coordinate("read_noise_e"), cells.coordinate("flux_e"), strict=True)
    enough = np.array([enough_photons(float(noise), float(flux)) for noise, flux in conditions])
    sentences = []
    for method, target in EXPECTED_EFFICIENCY.items():
        if method in cells.methods and enough.any():
            values = np.where(enough, cells.of("photon_efficiency", method), np.inf)
            lowest = int(np.argmin(values))
            reached = int(np.sum(values[enough] >= target))
            words = {"method": method, "target": target, "reached": reached, "cells": enough.sum()}
            condition = cells.words(lowest)
            sentences.append(_TEXT("findings.efficient", **words, lowest=values[lowest], where=condition))
    return sentences


def _outlier_dominated(cells: _Cells) -> list[str]:
    if not {ML, MAP} <= set(cells.methods):
        return []
    dominated = cells.of("outlier_fraction", ML) > _OUTLIERS
    if not dominated.any():
        return []
    errors, se = cells.values("error", BEST)[dominated], cells.of("error_se", MAP)[dominated]
    of_map = cells.of("error", MAP)[dominated]
    smallest = errors.min(axis=1)
    ratio = of_map / smallest
    stated = cells.of("stated_over_actual_all", MAP, None)[dominated]
    return [
        _TEXT(
            "findings.outliers",
            limit=_OUTLIERS,
            cells=dominated.sum(),
            smallest=int(np.sum(ratio <= 1)),
            near=int(np.sum(of_map - smallest <= 2 * se)),
            most=ratio.max(),
            low=stated.min(),
            high=stated.max(),
        )
    ]


def _near_the_best(cells: _Cells, dataset: xarray.Dataset) -> list[str]:
    ratio = _ratio_to_best(cells.values("corrected_rms", _corrected_mode(dataset)))
    d_over_r0 = cells.coordinate("d_over_r0")
    sentences = []
    for words, part in (("all", d_over_r0 > 0), ("d/r0 up to 1", d_over_r0 <= 1), ("above 1", d_over_r0 > 1)):
        if part.any():
            near = {
                method: int(np.sum(ratio[part, i] <= NEAR_BEST)) for i, method in enumerate(cells.methods)
            }
            worst = {method: float(ratio[part, i].max()) for i, method in enumerate(cells.methods)}
            ranked = sorted(near, key=lambda method: (-near[method], worst[method]))
            listed = ", ".join(
                f"{method} {near[method]} (worst {100 * (worst[method] - 1):.0f} %)" for method in ranked[:5]
            )
            near_percent = 100 * (NEAR_BEST - 1)
            counts = {"which": words, "cells": part.sum(), "near": near_percent}
            sentences.append(_TEXT("findings.near_best", **counts, ranked=listed))
    return sentences


def _ratio_to_best(values: Floats) -> Floats:
    ratio: Floats = values / np.nanmin(values, axis=1, keepdims=True)
    return ratio


def result_sections(dataset: xarray.Dataset) -> list[Section]:
    """Return the tables of a study: efficiency, calibration of the stated errors, speckled spots."""
    sections = []
    cells, speckled = _Cells(dataset, speckled=False), _Cells(dataset, speckled=True)
    if cells.count:
        efficiency, bound = cells.values("photon_efficiency", BEST), cells.coordinate("bound")
        rows = [[f"{bound[i]:.4f}", *map(number_or_dash, efficiency[i])] for i in cells.order()]
        sections.append(_section(cells, "efficiency", rows, cells.methods))
        inliers, everything = (cells.values(f"stated_over_actual{part}") for part in ("", "_all"))
        kept = [i for i, method in enumerate(cells.methods) if knows_the_spot(method)]
        rows = [
            [f"{number_or_dash(inliers[i, j])} ({number_or_dash(everything[i, j])})" for j in kept]
            for i in cells.order()
        ]
        sections.append(_section(cells, "calibration", rows, [cells.methods[j] for j in kept]))
    if speckled.count:
        values = speckled.values("corrected_rms", _corrected_mode(dataset))
        best, excess = np.nanargmin(values, axis=1), 100 * (_ratio_to_best(values) - 1)
        rows = [
            [
                f"{values[i, best[i]]:.4f}",
                speckled.methods[best[i]],
                *(number_or_dash(percent, 0) for percent in excess[i]),
            ]
            for i in speckled.order()
        ]
        sections.append(_section(speckled, "speckled", rows, speckled.methods))
    return sections


def _section(cells: _Cells, name: str, rows: list[list[str]], methods: list[str]) -> Section:
    """Return the section of a table with a row for each cell."""
    named = [[cells.words(index), *row] for index, row in zip(cells.order(), rows, strict=True)]
    table = _TEXT.table(f"estimator_tables.{name}", named, methods)
    return Section(f"{name}-table", _TEXT[f"estimator_tables.{name}.title"], tables=[table])


def _corrected_mode(dataset: xarray.Dataset) -> str:
    return CORRECTED if CORRECTED in dataset["mode"].values else BEST
