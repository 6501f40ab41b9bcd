"""Specification of a study: sweeps, methods, and options; the built-in studies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.checks import number_between, one_of, strings_of
from faintspot.base.errors import InputError, errors_within
from faintspot.base.files import check_size
from faintspot.base.options import FLAG, LIST, REQUIRED, TEXT, Option, Options, number, setting
from faintspot.base.tables import tables_as_text
from faintspot.base.text_files import check_keys, checked_table, parse_text, read_text
from faintspot.experiments.methods import DEFAULT_METHODS, knows_the_spot
from faintspot.experiments.store import fingerprint_of
from faintspot.experiments.study.sweep import PARAMETERS, RANGES, Cell, Sweep
from faintspot.slopes.estimators.registry import estimators

BEST, CORRECTED = "best", "corrected"
_MOST_CELLS = 100_000
_RANGE_KEYS = ("from", "to", "points", "spacing")


def _checked_sweeps(name: str, values: object) -> tuple[Sweep, ...]:
    sweeps = tuple(values) if isinstance(values, Iterable) else ()
    if not sweeps or not all(isinstance(sweep, Sweep) for sweep in sweeps):
        raise InputError(f"expected at least one sweep, got {values!r}", name=name)
    names = [sweep.name for sweep in sweeps]
    for each in names:
        if names.count(each) > 1:
            raise InputError(f"expected different names, got {each!r} {names.count(each)} times", name=name)
    check_size(f"{name}: cells", [sum(sweep.n_cells for sweep in sweeps)], _MOST_CELLS, "cells")
    return sweeps


def _checked_estimators(name: str, values: object) -> tuple[str, ...]:
    return tuple(one_of(name, each, list(estimators())) for each in strings_of(name, values))


TRIED = {
    "noise_std": (0.3, 0.5, 0.7, 0.85, 1.0),
    "smoothing_px": (0.4, 0.6, 0.8, 1.0, 1.3),
    "threshold_e": (0.0, 1.0, 2.0, 3.0, 4.0, 5.0),
    "weight_fwhm_px": (1.0, 1.4, 2.0, 3.0, 4.5),
    "blur_px": (0.0, 0.5, 1.0, 1.8, 3.0, 5.0),
    "model_error": (0.0, 0.2, 0.5),
}
"""Values of options of estimators that a study chooses from."""
_LARGEST = {"threshold_e": 100.0, "weight_fwhm_px": 100.0}  # others: 10
_ABOVE_ZERO = ("noise_std", "smoothing_px", "weight_fwhm_px")


def _checked_options(name: str, values: object) -> dict[str, tuple[float, ...]]:
    """Return the values of all options, those of `TRIED` where there are no others."""
    given = checked_table(name, values) if values != () else {}
    check_keys(f"{name}.", given, list(TRIED))
    checked: dict[str, tuple[float, ...]] = dict(TRIED)
    for key, listed in given.items():
        bounds: dict[str, Any] = {"high": _LARGEST.get(key, 10.0), "low_open": key in _ABOVE_ZERO}
        declared = Option(low=0.0, per_subaperture=False, kind=LIST, **bounds)
        checked[key] = tuple(dict.fromkeys(declared.checked(f"{name}.{key}", listed)))
        if not checked[key]:
            raise InputError("expected at least one value, got an empty list", name=f"{name}.{key}")
    return checked


@dataclass(frozen=True)
class StudySpecification(Options):
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
    options : mapping of str to sequence of float
        Values of options of estimators to choose from, instead of those of `TRIED`: noise_std and threshold_e
        as fractions of the noise of a mean pixel, smoothing_px, weight_fwhm_px as a fraction of the spot's
        width; for spots that turbulence has speckled also blur_px and model_error, which are 0 for others.
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

    name: str = setting(REQUIRED, kind=TEXT)
    sweeps: Sequence[Sweep] = setting(REQUIRED, check=_checked_sweeps)
    seed: int = number(1, 0, 2**53, whole=True)
    realisations: int = number(10_000, 20, 10_000_000, whole=True)
    estimators: Sequence[str] = setting(DEFAULT_METHODS, check=_checked_estimators)
    options: Any = setting((), check=_checked_options)
    fixed_k: Sequence[int] = number((20, 40, 60), 1, 1e9, whole=True, kind=LIST)
    corrected: bool = setting(False, kind=FLAG)
    search_range_px: float | None = number(None, 0.0, math.inf, low_open=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("estimators", "fixed_k"):
            values = tuple(dict.fromkeys(getattr(self, name)))
            if not values and name != "fixed_k":
                raise InputError("expected at least one value, got an empty list", name=name)
            object.__setattr__(self, name, values)
        largest = self.largest_k + 1
        for k in self.fixed_k:
            if k >= largest:
                expected = f"expected less than the {largest} pixels of the largest window"
                raise InputError(expected, name="fixed_k", value=k)

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
        known = {name: value for name in self.declared() if (value := getattr(self, name)) is not None}
        sweeps = {
            sweep.name: {name: list(getattr(sweep, name)) for name in PARAMETERS} for sweep in self.sweeps
        }
        del known["sweeps"], known["options"]  # the tables come last
        return tables_as_text({**known, "options": self.options, "sweeps": sweeps})

    @classmethod
    def from_text(cls, text: str, where: str = "specification") -> StudySpecification:
        """Read a specification from TOML text; `where` names it in messages.

        Raises
        ------
        InputError
            When it is not TOML, has an unknown key, lacks one or has a bad value.
        """
        document = parse_text(text, where)
        with errors_within(where):
            return _build(document)

    @classmethod
    def from_file(cls, path: str | Path) -> StudySpecification:
        """Read a specification from a TOML file.

        Raises
        ------
        InputError
            As `from_text`, and when the file cannot be read.
        """
        return cls.from_text(read_text(path), str(path))


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


def _spread(where: str, parameter: str, table: Mapping[str, object]) -> list[float]:
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


FIGURES = ("fig2", "fig3", "fig4", "fig5", "fig6", "fig7")
NIGHT = "night"
"""Name of the paper's observations beside those of its figures."""


def paper_study(quick: bool = False, figures: Sequence[str] | None = None) -> StudySpecification:
    """Return the specification of the paper's study.

    Parameters
    ----------
    quick : bool
        At most 40 cells of 2,000 realisations instead of 10,000: every figure, but with few points.
    figures : sequence of {"fig2", ..., "fig7"}, optional
        Only the cells of these figures. Default: all.

    Returns
    -------
    StudySpecification
        Its sweeps are named by the figure they belong to, as in "fig4 low noise".

    Raises
    ------
    InputError
        For an unknown figure, and for figure 1, which needs no study.
    """
    names = FIGURES if figures is None else tuple(figures)
    for name in names:
        if name == "fig1":
            raise InputError("figure 'fig1': expected fig2 to fig7; it needs no study and is on every report")
        one_of("figure", name, FIGURES)
    if not names:
        raise InputError("figures: expected at least one of fig2 to fig7, got none")
    study = _study("paper", quick)
    return replace(study, sweeps=[sweep for sweep in study.sweeps if sweep.name.split()[0] in names])


def estimators_study(quick: bool = False) -> StudySpecification:
    """Return the specification of the study of the estimators.

    Parameters
    ----------
    quick : bool
        A few cells of 2,000 realisations instead of 10,000.
    """
    return _study("estimators", quick)


def _study(name: str, quick: bool) -> StudySpecification:
    """Read a study that comes with the package."""
    file = f"{name}{'-quick' if quick else ''}.toml"
    text = files("faintspot.experiments.study").joinpath("studies", file).read_text(encoding="utf-8")
    return StudySpecification.from_text(text, file)
