"""Tables and sentences on a study's estimators: photon efficiency and calibration of standard errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.estimators.maximum_a_posteriori import MaximumAPosteriori
from faintspot.estimators.maximum_likelihood import MaximumLikelihood
from faintspot.estimators.weighted import Weighted
from faintspot.estimators.window import Window
from faintspot.experiments.arms import knows_the_spot
from faintspot.experiments.specification import BEST, CORRECTED
from faintspot.experiments.study_curves import Configuration
from faintspot.report.texts import Texts

if TYPE_CHECKING:
    import xarray


Floats = NDArray[np.float64]

ENOUGH_PHOTONS = {0.1: 30.0, 3.0: 120.0, 16.0: 500.0}
"""Fewest electrons, by read noise, at which an estimator that knows the spot is expected at the bound."""
ML, MAP = MaximumLikelihood.name, MaximumAPosteriori.name
EXPECTED_EFFICIENCY = {ML: 0.95, MAP: 0.95, Weighted.name: 0.75}
"""Least photon efficiency, by arm, where there is flux enough."""
NEAR_BEST = 1.04
"""Gain-corrected rms over the smallest of all arms up to which an arm counts as near the best."""
_TEXT = Texts("faintspot.experiments")
_OUTLIERS = 0.01  # fraction of the likelihood's slopes, from which outliers dominate its error


def compares_estimators(dataset: xarray.Dataset) -> bool:
    """Whether a study has arms that know the spot."""
    return any(knows_the_spot(str(arm)) for arm in dataset["arm"].values)


def enough_photons(read_noise_e: float, flux_e: float) -> bool:
    """Whether there is flux enough for the bound to be within reach.

    Between the read noises of `ENOUGH_PHOTONS`, logarithms are interpolated.
    """
    noises, fluxes = np.log(list(ENOUGH_PHOTONS)), np.log(list(ENOUGH_PHOTONS.values()))
    needed = np.exp(np.interp(np.log(max(read_noise_e, 1e-3)), noises, fluxes))
    return bool(flux_e >= needed * (1 - 1e-9))


class _Cells:
    """Finished cells of a study, with their values by arm."""

    def __init__(self, dataset: xarray.Dataset, speckled: bool) -> None:
        done = dataset["done"].values & ((dataset["d_over_r0"].values > 0) == speckled)
        self._dataset = dataset.isel(cell=np.flatnonzero(done))
        self.arms = [str(arm) for arm in dataset["arm"].values]
        self.count = int(done.sum())

    def coordinate(self, name: str) -> NDArray[Any]:
        return self._dataset[name].values

    def values(self, name: str, mode: str | None = None) -> Floats:
        """Values of all arms, (cells, arms)."""
        variable = self._dataset[name] if mode is None else self._dataset[name].sel(mode=mode)
        return np.asarray(variable.transpose("cell", "arm").values, dtype=np.float64)

    def of(self, name: str, arm: str, mode: str | None = BEST) -> Floats:
        """Values of one arm, (cells,)."""
        return self.values(name, mode)[:, self.arms.index(arm)]

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
    found = []
    cells = _Cells(dataset, speckled=False)
    if cells.count:
        found += _efficient(cells)
        found += _outlier_dominated(cells)
    speckled = _Cells(dataset, speckled=True)
    if speckled.count:
        found += _near_the_best(speckled, dataset)
    return found


def _efficient(cells: _Cells) -> list[str]:
    conditions = zip(cells.coordinate("read_noise_e"), cells.coordinate("flux_e"), strict=True)
    enough = np.array([enough_photons(float(noise), float(flux)) for noise, flux in conditions])
    found = []
    for arm, target in EXPECTED_EFFICIENCY.items():
        if arm in cells.arms and enough.any():
            values = np.where(enough, cells.of("photon_efficiency", arm), np.inf)
            lowest = int(np.argmin(values))
            reached = int(np.sum(values[enough] >= target))
            words = {"arm": arm, "target": target, "reached": reached, "cells": enough.sum()}
            where = cells.words(lowest)
            found.append(_TEXT("findings.efficient", **words, lowest=values[lowest], where=where))
    return found


def _outlier_dominated(cells: _Cells) -> list[str]:
    if not {ML, MAP} <= set(cells.arms):
        return []
    dominated = cells.of("outlier_fraction", ML) > _OUTLIERS
    if not dominated.any():
        return []
    errors, se = cells.values("error", BEST)[dominated], cells.of("error_se", MAP)[dominated]
    own = cells.of("error", MAP)[dominated]
    smallest = errors.min(axis=1)
    ratio = own / smallest
    stated = cells.of("stated_over_actual_all", MAP, None)[dominated]
    return [
        _TEXT(
            "findings.outliers",
            limit=_OUTLIERS,
            cells=dominated.sum(),
            smallest=int(np.sum(ratio <= 1)),
            near=int(np.sum(own - smallest <= 2 * se)),
            most=ratio.max(),
            low=stated.min(),
            high=stated.max(),
        )
    ]


def _near_the_best(cells: _Cells, dataset: xarray.Dataset) -> list[str]:
    mode = CORRECTED if CORRECTED in dataset["mode"].values else BEST
    ratio = _ratio_to_best(cells.values("corrected_rms", mode))
    d_over_r0 = cells.coordinate("d_over_r0")
    found = []
    for words, part in (("all", d_over_r0 > 0), ("d/r0 up to 1", d_over_r0 <= 1), ("above 1", d_over_r0 > 1)):
        if part.any():
            near = {arm: int(np.sum(ratio[part, i] <= NEAR_BEST)) for i, arm in enumerate(cells.arms)}
            worst = {arm: float(ratio[part, i].max()) for i, arm in enumerate(cells.arms)}
            ranked = sorted(near, key=lambda arm: (-near[arm], worst[arm]))
            listed = ", ".join(
                f"{arm} {near[arm]} (worst {100 * (worst[arm] - 1):.0f} %)" for arm in ranked[:5]
            )
            near_percent = 100 * (NEAR_BEST - 1)
            counts = {"which": words, "cells": part.sum(), "near": near_percent}
            found.append(_TEXT("findings.near_best", **counts, ranked=listed))
    return found


def _ratio_to_best(values: Floats) -> Floats:
    ratio: Floats = values / np.nanmin(values, axis=1, keepdims=True)
    return ratio


def markdown(dataset: xarray.Dataset, command: str) -> str:
    """Return the tables of a study as a Markdown page.

    Parameters
    ----------
    dataset : xarray.Dataset
    command : str
        That makes the page.
    """
    parts = [
        _TEXT("markdown.head", command=command, n=dataset.attrs["n"], seed=dataset.attrs["seed"]),
        *([_TEXT["markdown.windows"]] if Window.name in dataset["arm"].values else []),
        "## What it says\n",
        *(f"- {line}" for line in findings(dataset)),
        "",
    ]
    cells, speckled = _Cells(dataset, speckled=False), _Cells(dataset, speckled=True)
    if cells.count:
        parts += _efficiency_section(cells) + _calibration_section(cells)
    if speckled.count:
        parts += _turbulence_section(speckled, dataset)
    return "\n".join(parts) + "\n"


def _efficiency_section(cells: _Cells) -> list[str]:
    values = cells.values("photon_efficiency", BEST)
    bound = cells.coordinate("bound")
    return [
        _TEXT["markdown.efficiency"],
        *_table(cells, ["R at the bound, px"], lambda i: [f"{bound[i]:.4f}"], lambda i: _numbers(values[i])),
    ]


def _calibration_section(cells: _Cells) -> list[str]:
    near, whole = (cells.values(f"stated_over_actual{part}") for part in ("", "_all"))
    kept = [i for i, arm in enumerate(cells.arms) if knows_the_spot(arm)]
    rows = ["| | " + " | ".join(cells.arms[i] for i in kept) + " |", "|---|" + "---|" * len(kept)]
    for index in cells.order():
        texts = [f"{near[index, i]:.2f} ({whole[index, i]:.2f})" for i in kept]
        rows.append(f"| {cells.words(index)} | " + " | ".join(texts) + " |")
    return [_TEXT["markdown.calibration"], *rows]


def _turbulence_section(cells: _Cells, dataset: xarray.Dataset) -> list[str]:
    mode = CORRECTED if CORRECTED in dataset["mode"].values else BEST
    values = cells.values("corrected_rms", mode)
    excess = 100 * (_ratio_to_best(values) - 1)
    best = np.nanargmin(values, axis=1)
    return [
        _TEXT["markdown.turbulence"],
        *_table(
            cells,
            ["best, px", "by"],
            lambda i: [f"{values[i, best[i]]:.4f}", cells.arms[best[i]]],
            lambda i: [f"{value:.0f}" if np.isfinite(value) else "–" for value in excess[i]],
        ),
    ]


def _numbers(values: Sequence[float] | Floats) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "–" for value in values]


def _table(
    cells: _Cells, names: list[str], first: Callable[[int], list[str]], rest: Callable[[int], list[str]]
) -> list[str]:
    """A table of all cells: some columns, then one for each arm."""
    header = ["", *names, *cells.arms]
    rows = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    for index in cells.order():
        rows.append("| " + " | ".join([cells.words(index), *first(index), *rest(index)]) + " |")
    return rows
