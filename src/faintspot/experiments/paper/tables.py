"""The tables of a study's page: cells in words and numbers, verdicts on claims, baselines, gains."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from faintspot.base.files import csv_text
from faintspot.base.report.page import Section
from faintspot.base.report.texts import NOTHING, Texts
from faintspot.experiments.curves import Gain, gain_at_error
from faintspot.experiments.methods import NO_TV, TV, TV_OVER_NO_TV, label_of
from faintspot.experiments.paper.claims import fixed_mode
from faintspot.experiments.paper.judges import LEVEL_PX
from faintspot.experiments.study.curves import (
    StudyConditions,
    Verdict,
    against_tv,
    study_curves,
)
from faintspot.experiments.study.specification import BEST, CORRECTED
from faintspot.experiments.study.sweep import PARAMETERS

if TYPE_CHECKING:
    import xarray


_TEXT = Texts("faintspot.experiments")
_STATISTICS = ("gain", "rms", "corrected_rms", "outlier_fraction", "photon_efficiency")


def mode_in_words(mode: str) -> str:
    """Return "best k", "fixed k = 40", or "best gain-corrected rms"."""
    if mode == CORRECTED:
        return "best gain-corrected rms"
    return "best k" if mode == BEST else f"fixed k = {mode.removeprefix('fixed')}"


def parameters_of(dataset: xarray.Dataset, cells: Sequence[int]) -> list[dict[str, Any]]:
    """Return the physical parameters of cells."""
    columns = {name: dataset[name].values for name in PARAMETERS}
    return [{name: column[cell].item() for name, column in columns.items()} for cell in cells]


def parameter_in_words(name: str, value: object) -> str:
    """Return a cell's parameter with its unit."""
    standard, words = _TEXT["standard_parameters"].get(name, (None, ""))
    return str(words) if value == standard else str(_TEXT[f"parameters.{name}"]).format(value)


def in_words(names: Sequence[str], values: Sequence[object]) -> str:
    """Return parameters with their units."""
    return ", ".join(map(parameter_in_words, names, values))


def grouped(
    dataset: xarray.Dataset, cells: Sequence[int], by: Sequence[str], axis: str
) -> dict[tuple[Any, ...], list[int]]:
    """Return cells by the values of some parameters, in order, each by increasing value of another one."""
    groups: dict[tuple[Any, ...], list[int]] = {}
    pairs = zip(cells, parameters_of(dataset, cells), strict=True)
    for cell, row in sorted(pairs, key=lambda pair: pair[1][axis]):
        groups.setdefault(tuple(row[name] for name in by), []).append(cell)
    return dict(sorted(groups.items()))


def cases_csv(judged: Sequence[Verdict]) -> tuple[str, str]:
    """Return name and text of the file with all cases that the verdicts rest on."""
    data = [
        [item.number, item.claim, finding.mode, case.where, case.finding, case.outcome.value]
        for item in judged
        for finding in (item.best, item.fixed)
        for case in finding.cases
    ]
    return "verdicts.csv", csv_text(["number", "claim", "mode", "where", "finding", "outcome"], data)


def baselines_section(dataset: xarray.Dataset) -> Section:
    """Return the section that compares TV with every other method."""
    records = [
        {
            **vars(row),
            "label": label_of(row.method),
            "mode": mode_in_words(mode),
            "undecided": row.cells - row.smaller - row.larger,
        }
        for mode in (BEST, fixed_mode(dataset))
        if mode in dataset["mode"].values
        for row in against_tv(dataset, mode)
    ]
    return _TEXT.section("baselines", _TEXT.table("baselines", records))


def gains_section(dataset: xarray.Dataset) -> Section:
    """Return the section of the flux gain, for every way to choose the number of pixels."""
    modes = [str(mode) for mode in dataset["mode"].values]
    rows = [
        [
            key.in_words(),
            *(NOTHING if (gain := gains.get(mode)) is None else gain.in_words() for mode in modes),
        ]
        for key, gains in gains_by_mode(dataset).items()
    ]
    return _TEXT.section("gains", _TEXT.table("gains", rows, [mode_in_words(mode) for mode in modes]))


def gains_by_mode(dataset: xarray.Dataset) -> dict[StudyConditions, dict[str, Gain | None]]:
    """Return the flux gain of TV over no denoising at R = `LEVEL_PX`, by configuration and mode.

    Parameters
    ----------
    dataset : xarray.Dataset
        Results of a study.

    Returns
    -------
    dict
        Configurations that have a gain in at least one mode; None where a mode has none, as when the error
        without denoising does not come down to that level.
    """
    rng = np.random.default_rng(0)  # of the bootstrap: the same study gives the same page
    table: dict[StudyConditions, dict[str, Gain | None]] = {}
    for mode in dataset["mode"].values:
        for configuration, curve in study_curves(dataset, str(mode)).items():
            gain = gain_at_error(curve, LEVEL_PX, rng, **TV_OVER_NO_TV) if curve.has(TV, NO_TV) else None
            table.setdefault(configuration, {})[str(mode)] = gain
    return {key: gains for key, gains in table.items() if any(gain is not None for gain in gains.values())}
