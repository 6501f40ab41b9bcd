"""Analysis of interleaved observations, curves against magnitude and recorded telemetry."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from faintspot.ao_loop.pseudo_open_loop import r0_of_record
from faintspot.ao_loop.record import LoopRecord
from faintspot.base.errors import InputError
from faintspot.experiments.loop_results import (
    InterleavedResult,
    MagnitudeResult,
    RegressionLine,
    magnitude_gain,
    neighbour_differences,
    regression_line,
)
from faintspot.experiments.statistics import Estimate, mean_by_blocks, paired_mean
from faintspot.turbulence.seeing import Seeing, mean_r0

Floats = NDArray[np.float64]

BEST_STRENGTHS = (0.6, 1.1)
"""Strengths, electrons, of which the paper's table has a row of its own."""
STRENGTH_EDGES = (0.0, 0.3, 0.6, 1.1, 1.6, np.inf)
"""Strengths, electrons, between which measurements are taken together; upper ends belong to their range."""
NO_TV, TV, TV_BEST = "no TV", "TV, all strengths", "TV, strength 0.6 to 1.1"
GROUPS = (NO_TV, TV, TV_BEST)

_FEWEST_FRAMES = 20
_LEAST_VALID = 0.9
_STREHL_LEVELS = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)


@dataclass(frozen=True, eq=False)
class Measurements:
    """One row for each measurement of interleaved observations, by set and time; arrays (rows,)."""

    set_names: tuple[str, ...]
    set_number: NDArray[np.int64]
    """Index into set_names."""
    method: NDArray[np.int64]
    strength_e: Floats
    """NaN: no TV."""
    time_s: Floats
    """Middle of the measurement, from the start of its set."""
    strehl: Floats
    """Long exposure."""
    r0_m: Floats
    """From its pseudo-open-loop slopes, at 500 nm; NaN where fewer than 90 % of the slopes were measured."""
    true_r0_m: Floats
    frames: NDArray[np.int64]

    def rows(self, chosen: NDArray[np.bool_]) -> Measurements:
        """Return the table with some of its rows."""
        columns = {item.name: getattr(self, item.name) for item in fields(self)[1:]}
        return Measurements(self.set_names, **{name: column[chosen] for name, column in columns.items()})

    def group(self, name: str) -> NDArray[np.bool_]:
        """Return which rows belong to one of GROUPS. A strength of 0 changes nothing and is in none.

        Raises
        ------
        InputError
            For another name.
        """
        if name == NO_TV:
            return np.isnan(self.strength_e)
        if name == TV:
            return self.strength_e > 0
        if name == TV_BEST:
            return (self.strength_e >= BEST_STRENGTHS[0]) & (self.strength_e <= BEST_STRENGTHS[1])
        raise InputError(f"group = {name!r}: expected one of {', '.join(map(repr, GROUPS))}")


@dataclass(frozen=True)
class GroupRow:
    """A row of the paper's table, and what it could not have."""

    group: str
    mean: float
    standard_deviation: float
    """Standard deviation of the measurements; NaN for fewer than two."""
    count: int
    difference: Estimate | None
    """From the neighbours without TV; None for these themselves."""
    at_equal_r0: Estimate | None
    """The same after the dependence on r0 is taken out of all measurements; None where it is not known."""


@dataclass(frozen=True)
class StrengthRow:
    """Measurements with strengths in a range of `STRENGTH_EDGES`."""

    strength_e: float
    """Mean."""
    strehl: float
    """Mean."""
    count: int
    difference: Estimate
    """From the neighbours without TV."""


@dataclass(frozen=True)
class SetSeeing:
    """r0 of a whole set."""

    set_name: str
    true_r0_m: float
    """Fried parameter of steady turbulence with the mean strength."""
    seeing: Seeing
    """From the slopes about their mean over the pupil."""
    with_tip_tilt: Seeing
    """From the whole slopes."""


@lru_cache(maxsize=2)
def measurements(result: InterleavedResult) -> Measurements:
    """Return the table of all measurements of interleaved observations; the last ones made are kept.

    Raises
    ------
    InputError
        When no measurement has 20 frames after settling.
    """
    rows = [
        (number, *row)
        for number, (record, block, strengths) in enumerate(
            zip(result.records, result.block, result.strengths, strict=True)
        )
        for row in _rows_of_set(record, block, strengths, result.settle_in_block)
    ]
    if not rows:
        raise InputError(
            f"interleaved observations: no measurement has {_FEWEST_FRAMES} frames after settling"
        )
    number, method, strength, time, strehl, r0, truth, frames = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    return Measurements(result.set_names, number, method, strength, time, strehl, r0, truth, frames)


def group_rows(table: Measurements, set_number: int | None = None) -> list[GroupRow]:
    """Return mean and scatter of the Strehl ratio of each group, and paired differences with intervals.

    Each measurement with TV is compared with the straight line between the measurements without just before
    and after it; intervals come from drawing whole cycles (moving blocks).

    Parameters
    ----------
    table : Measurements
    set_number : int, optional
        Of this set alone.
    """
    wanted = np.ones(len(table.strehl), np.bool_) if set_number is None else table.set_number == set_number
    differences = paired_differences(table)
    adjusted = _at_equal_r0_differences(table)
    rows = []
    for name in GROUPS:
        chosen = table.group(name) & wanted
        values = table.strehl[chosen]
        if not len(values):
            continue
        scatter = float(values.std(ddof=1)) if len(values) > 1 else float("nan")
        compared: list[Estimate | None] = [None, None]
        if name != NO_TV:
            compared = [_interval(table, each, chosen) for each in (differences, adjusted)]
        rows.append(GroupRow(name, float(values.mean()), scatter, len(values), *compared))
    return rows


def paired_differences(table: Measurements) -> Floats:
    """Return each measurement's Strehl less the straight line between its neighbours without TV.

    Of the same set; NaN for measurements without TV, and for sets that have none.
    """
    return _differences(table, table.strehl)


def differences_by_strength(table: Measurements) -> list[StrengthRow]:
    """Return the paired difference in Strehl from the neighbours without TV, for each range of strengths.

    The intervals hold together, for all ranges, with 95 %.
    """
    differences = paired_differences(table)
    parts = [
        chosen & np.isfinite(differences)
        for chosen in (
            (table.strength_e > low) & (table.strength_e <= high)
            for low, high in itertools.pairwise(STRENGTH_EDGES)
        )
    ]
    parts = [part for part in parts if part.any()]
    rows = []
    for part in parts:
        difference = _interval(table, differences, part, len(parts))
        assert difference is not None  # there are some
        rows.append(
            StrengthRow(
                float(table.strength_e[part].mean()),
                float(table.strehl[part].mean()),
                int(part.sum()),
                difference,
            )
        )
    return rows


def seeing_of_sets(result: InterleavedResult) -> list[SetSeeing]:
    """Return r0 from all frames of each set in which at least 90 % of the slopes were measured.

    Sets without 20 such frames are left out.
    """
    found = []
    for name, record, block in zip(result.set_names, result.records, result.block, strict=True):
        share = np.bincount(block, record.valid.mean(axis=1)) / np.maximum(1, np.bincount(block))
        frames = record.scored & (share[block] >= _LEAST_VALID)
        if frames.sum() < _FEWEST_FRAMES:
            continue
        found.append(
            SetSeeing(
                name,
                mean_r0(record.r0_m[frames]),
                r0_of_record(record, frames),
                r0_of_record(record, frames, remove_tip_tilt=False),
            )
        )
    return found


def regression_lines(table: Measurements) -> dict[str, RegressionLine]:
    """Return Strehl against r0 as a line, for each group with three measurements or more."""
    known = np.isfinite(table.r0_m)
    lines = {}
    for name in GROUPS:
        chosen = table.group(name) & known
        if chosen.sum() >= 3:
            lines[name] = regression_line(table.r0_m[chosen], table.strehl[chosen])
    return lines


def differences_by_flux(result: MagnitudeResult, method: int, reference: int) -> list[Estimate]:
    """Return a method's Strehl less the reference's at each flux, over realisations.

    The intervals hold together, for all fluxes, with 95 %.
    """
    fluxes = len(result.photons)
    return [
        paired_mean(result.strehl[method, f] - result.strehl[reference, f], fluxes) for f in range(fluxes)
    ]


def gains_in_magnitude(result: MagnitudeResult, method: int, reference: int) -> dict[float, Estimate]:
    """Return the gain in limiting magnitude at each Strehl ratio that the reference's curve passes."""
    curve = np.array([paired_mean(values).value for values in result.strehl[reference]])
    known = curve[np.isfinite(curve)]
    return {
        level: magnitude_gain(result.magnitudes, result.strehl[method], result.strehl[reference], level)
        for level in _STREHL_LEVELS
        if len(known) and known.min() < level <= known.max()
    }


def _rows_of_set(
    record: LoopRecord, block: NDArray[np.int64], strengths: Floats, settle: int
) -> list[tuple[int, float, float, float, float, float, int]]:
    first = np.concatenate([[0], np.flatnonzero(np.diff(block)) + 1])
    since = np.arange(len(block)) - np.repeat(first, np.diff(np.append(first, len(block))))
    usable = (since >= settle) & record.scored
    rows = []
    for start in first:
        chosen = usable & (block == block[start])
        frames = int(chosen.sum())
        if frames < _FEWEST_FRAMES:
            continue
        method = int(record.method[start])
        measured = float(record.valid[chosen].mean()) >= _LEAST_VALID
        rows.append(
            (
                method,
                float(strengths[method]),
                float(np.flatnonzero(chosen).mean() + 0.5) / record.frame_rate_hz,
                float(record.strehl[chosen].mean()),
                r0_of_record(record, chosen).r0_m if measured else np.nan,
                mean_r0(record.r0_m[chosen]),
                frames,
            )
        )
    return rows


def _differences(table: Measurements, values: Floats) -> Floats:
    """Return each measurement's difference from its neighbours without TV, set by set; NaN for these."""
    differences = np.full(len(values), np.nan)
    for number in range(len(table.set_names)):
        rows = np.flatnonzero(table.set_number == number)
        without = table.group(NO_TV)[rows]
        if without.any():
            differences[rows] = neighbour_differences(values[rows], table.time_s[rows], without)
    return differences


def _at_equal_r0_differences(table: Measurements) -> Floats | None:
    """Return differences of Strehl ratios moved to the mean r0; NaN or None where r0 is not known.

    Moved by the slope against r0 that is common to measurements with and without TV.
    """
    known = np.isfinite(table.r0_m)
    if not (known & table.group(NO_TV)).any() or not (known & table.group(TV)).any():
        return None
    sums = np.zeros(2)
    for chosen in (table.group(NO_TV) & known, table.group(TV) & known):
        away = table.r0_m[chosen] - table.r0_m[chosen].mean()
        sums += away @ away, away @ (table.strehl[chosen] - table.strehl[chosen].mean())
    slope = sums[1] / sums[0] if sums[0] > 0 else 0.0
    moved = table.strehl - slope * (table.r0_m - table.r0_m[known].mean())
    differences = np.full(len(moved), np.nan)
    differences[known] = _differences(table.rows(known), moved[known])
    return differences


def _interval(
    table: Measurements, differences: Floats | None, chosen: NDArray[np.bool_], comparisons: int = 1
) -> Estimate | None:
    """Return the mean difference of some measurements; those of about one cycle are drawn together."""
    if differences is None:
        return None
    values = differences[chosen]
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    cycles = max(1, int(table.group(NO_TV)[np.isin(table.set_number, table.set_number[chosen])].sum()))
    return mean_by_blocks(values, max(1, round(len(values) / cycles)), comparisons=comparisons)
