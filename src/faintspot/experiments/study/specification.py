"""Specification of a study: sweeps, methods, and the options from which each method chooses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import tomlkit

from faintspot.base.checks import number_between, one_of
from faintspot.base.config.options import Option
from faintspot.base.errors import InputError
from faintspot.base.sizes import check_size
from faintspot.base.toml_files import check_keys, checked_table, parse_text, read_text
from faintspot.experiments.methods import DEFAULT_METHODS, knows_the_spot
from faintspot.experiments.store import fingerprint_of
from faintspot.experiments.study.sweep import PARAMETERS, RANGES, Cell, Sweep, checked_numbers
from faintspot.slopes.estimators.registry import estimators

BEST, CORRECTED = "best", "corrected"
_MOST_CELLS = 100_000
_CANDIDATE_RANGES = {
    "strengths": Option("", "1", 0.0, 10.0, low_open=True),
    "widths": Option("", "px", 0.0, 10.0, low_open=True),
    "thresholds": Option("", "1", 0.0, 100.0),
    "weight_widths": Option("", "1", 0.0, 100.0, low_open=True),
    "blurs": Option("", "px", 0.0, 10.0),
    "model_errors": Option("", "1", 0.0, 10.0),
}
_RANGE_KEYS = ("from", "to", "points", "spacing")


@dataclass(frozen=True)
class StudySpecification:
    """A Monte-Carlo study of the slope error.

    Parameters
    ----------
    name : str
    sweeps : sequence of Sweep
        A cell that is in several sweeps is measured once.
    seed : int
        From 0. Every cell's own seed comes from this one and its coordinates.
    realisations : int
        Simulated images of each cell, at least 20. Settings are chosen on the first half of them and scored
        on the second.
    estimators : sequence of str
        What is compared: names of estimators (`faintspot.slopes.estimators.estimators()`).
        Default: the built-in ones that know nothing of the spot.
    strengths : sequence of float
        Strengths of the denoising (option `noise_std`) to choose from, as fractions of the noise of a mean
        pixel.
    widths : sequence of float
        Widths of the smoothing (option `smoothing_px`) to choose from.
    thresholds : sequence of float
        Thresholds (option `threshold_e`) to choose from, in units of the noise of a mean pixel.
    weight_widths : sequence of float
        Widths of the weight (option `weight_fwhm_px`) to choose from, as fractions of the spot's.
    blurs : sequence of float
        Standard deviations of the Gaussian that blurs the PSF (option `blur_px`) to choose from for spots
        that turbulence has speckled. Other spots are not blurred.
    model_errors : sequence of float
        Values of the option `model_error` to choose from, together with the blur, for the same spots.
    fixed_k : sequence of int
        Numbers of kept pixels of the modes in which all methods keep the same number.
    corrected : bool
        Whether there is also a mode in which settings are chosen for the smallest gain-corrected rms.
    search_range_px : float, optional
        Largest position of any estimator, on each axis. Default: the range of true positions of each cell if
        an estimator knows the spot, so that all have the same; else none.

    Raises
    ------
    InputError
        For a value out of its range, an empty list, an unknown method, two sweeps of one name, a `fixed_k`
        that no window of the study has enough pixels for.

    Examples
    --------
    >>> from faintspot.experiments import StudySpecification, Sweep
    >>> light = Sweep("light", flux_e=[30, 100])
    >>> study = StudySpecification("mine", [light], realisations=200, estimators=["brightest", "tv"])
    >>> len(study.cells()), study.modes
    (2, ('best', 'fixed20', 'fixed40', 'fixed60'))
    """

    name: str
    sweeps: Sequence[Sweep]
    seed: int = 1
    realisations: int = 10_000
    estimators: Sequence[str] = DEFAULT_METHODS
    strengths: Sequence[float] = (0.3, 0.5, 0.7, 0.85, 1.0)
    widths: Sequence[float] = (0.4, 0.6, 0.8, 1.0, 1.3)
    thresholds: Sequence[float] = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
    weight_widths: Sequence[float] = (1.0, 1.4, 2.0, 3.0, 4.5)
    blurs: Sequence[float] = (0.0, 0.5, 1.0, 1.8, 3.0, 5.0)
    model_errors: Sequence[float] = (0.0, 0.2, 0.5)
    fixed_k: Sequence[int] = (20, 40, 60)
    corrected: bool = False
    search_range_px: float | None = None

    LISTED: ClassVar[Mapping[str, tuple[str, bool]]] = {
        "noise_std": ("strengths", False),
        "smoothing_px": ("widths", False),
        "threshold_e": ("thresholds", False),
        "weight_fwhm_px": ("weight_widths", False),
        "blur_px": ("blurs", True),
        "model_error": ("model_errors", True),
    }
    """By option of an estimator, which field lists its values, and whether only for speckled spots."""

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"name: expected a text, got {self.name!r}")
        self._set("seed", int(number_between("seed", self.seed, 0, 2**63 - 1, integer=True)))
        number = number_between("realisations", self.realisations, 20, 10_000_000, integer=True)
        self._set("realisations", int(number))
        self._set("sweeps", _checked_sweeps(self.sweeps))
        names = [
            one_of("estimators", name, list(estimators()))
            for name in _checked_list("estimators", self.estimators)
        ]
        self._set("estimators", tuple(dict.fromkeys(names)))
        for name, bounds in _CANDIDATE_RANGES.items():
            items = _checked_list(name, getattr(self, name))
            self._set(name, tuple(checked_numbers(name, items, bounds)))
        self._set("fixed_k", self._checked_fixed_k())
        if not isinstance(self.corrected, bool):
            raise InputError(f"corrected = {self.corrected!r}: expected true or false")
        if self.search_range_px is not None:
            search = number_between("search_range_px", self.search_range_px, 0.0, low_open=True)
            self._set("search_range_px", search)

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _checked_fixed_k(self) -> tuple[int, ...]:
        if not len(self.fixed_k):
            return ()
        largest = max(cell.pixels for cell in self.cells()) ** 2
        kept = checked_numbers("fixed_k", self.fixed_k, Option("", "px", 1, 1e9, whole=True))
        for k in kept:
            if k >= largest:
                raise InputError(
                    f"fixed_k = {k}: expected less than the {largest} pixels of the largest window"
                )
        return tuple(dict.fromkeys(kept))

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the modes: "best", then "fixed20" and so on, and "corrected" where it is asked for."""
        return (BEST, *(f"fixed{k}" for k in self.fixed_k), *([CORRECTED] if self.corrected else []))

    def kept_pixels(self, cell: Cell) -> dict[str, int | None]:
        """Return the number of pixels that each mode keeps, None where methods choose it.

        Modes that keep more pixels than the window of the cell has are left out.
        """
        fixed = {f"fixed{k}": k for k in self.fixed_k if k < cell.pixels**2}
        return {mode: fixed.get(mode) for mode in self.modes if mode in (BEST, CORRECTED, *fixed)}

    def search_range_of(self, cell: Cell) -> float:
        """Return the largest position of all methods in a cell, px; infinite where there is none."""
        if self.search_range_px is not None:
            return self.search_range_px
        return cell.position_range_px if any(map(knows_the_spot, self.estimators)) else math.inf

    def cells(self) -> list[Cell]:
        """Return all cells, each once, in the order of the sweeps."""
        return list(dict.fromkeys(cell for sweep in self.sweeps for cell in sweep.cells()))

    @property
    def largest_k(self) -> int:
        """The largest number of pixels that can be kept in any window."""
        return max(cell.pixels for cell in self.cells()) ** 2 - 1

    @property
    def fingerprint(self) -> str:
        """A text that differs whenever the results could."""
        return fingerprint_of(self.to_text())

    def to_text(self) -> str:
        """Return the specification as TOML with every value written out."""
        document = tomlkit.document()
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name != "sweeps" and value is not None:  # TOML has no word for nothing
                document[field.name] = list(value) if isinstance(value, tuple) else value
        sweeps = tomlkit.table()
        for sweep in self.sweeps:
            sweeps[sweep.name] = {name: list(getattr(sweep, name)) for name in PARAMETERS}
        document["sweeps"] = sweeps
        return tomlkit.dumps(document)

    @classmethod
    def from_text(cls, text: str, where: str = "specification") -> StudySpecification:
        """Read a specification from TOML text; `where` names it in messages.

        Raises
        ------
        InputError
            When it is not TOML, has an unknown key, lacks one or has a bad value.
        """
        document = parse_text(text, where)
        try:
            return _build(document)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None

    @classmethod
    def from_file(cls, path: str | Path) -> StudySpecification:
        """Read a specification from a TOML file.

        Raises
        ------
        InputError
            As `from_text`, and when the file cannot be read.
        """
        return cls.from_text(read_text(path), str(path))


def _checked_list(name: str, values: Any) -> list[Any]:
    """Return a list without repeated items, or raise InputError when it is none or empty."""
    if isinstance(values, str) or np.ndim(values) != 1:
        raise InputError(f"{name}: expected a list, got {values!r}")
    if not len(values):
        raise InputError(f"{name}: expected at least one value, got an empty list")
    return list(dict.fromkeys(values))


def _checked_sweeps(values: Any) -> tuple[Sweep, ...]:
    sweeps = tuple(values) if isinstance(values, Iterable) else ()
    if not sweeps or not all(isinstance(sweep, Sweep) for sweep in sweeps):
        raise InputError(f"sweeps: expected at least one sweep, got {values!r}")
    names = [sweep.name for sweep in sweeps]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"sweeps: expected different names, got {name!r} {names.count(name)} times")
    check_size("sweeps: cells", [sum(sweep.n_cells for sweep in sweeps)], _MOST_CELLS, "cells")
    return sweeps


# Reading -----------------------------------------------------------------------------------------------


def _build(document: dict[str, Any]) -> StudySpecification:
    names = [field.name for field in fields(StudySpecification)]
    check_keys("", document, names, required=("name", "sweeps"))
    tables = document["sweeps"]
    if not isinstance(tables, dict) or not tables:
        raise InputError("sweeps: expected at least one table, such as [sweeps.signal]")
    sweeps = [_sweep(name, table) for name, table in tables.items()]
    return StudySpecification(**{**document, "sweeps": sweeps})


def _sweep(name: str, table: Any) -> Sweep:
    check_keys(f"sweeps.{name}.", checked_table(f"sweeps.{name}", table), PARAMETERS)
    values = {
        key: _spread(f"sweeps.{name}.{key}", key, value) if isinstance(value, dict) else value
        for key, value in table.items()
    }
    return Sweep(name, **values)


def _spread(where: str, parameter: str, table: dict[str, Any]) -> list[float]:
    """Return the numbers of { from = 10, to = 1000, points = 9, spacing = "log" }."""
    check_keys(f"{where}.", table, _RANGE_KEYS, required=("from", "to", "points"))
    if parameter not in RANGES:
        raise InputError(f"{where}: expected a text or a list of texts, got a range")
    spacing = one_of(f"{where}.spacing", table.get("spacing", "linear"), ("linear", "log"))
    low, high = (number_between(f"{where}.{key}", table[key]) for key in ("from", "to"))
    if low >= high:
        raise InputError(f"{where}: expected from below to, got the empty range {low:g} to {high:g}")
    if spacing == "log" and low <= 0:
        raise InputError(f"{where}.from = {low:g}: expected a number above 0 for a logarithmic spacing")
    points = int(number_between(f"{where}.points", table["points"], 2, 10_000, integer=True))
    numbers = (np.geomspace if spacing == "log" else np.linspace)(low, high, points)
    return [float(f"{number:.4g}") for number in numbers]
