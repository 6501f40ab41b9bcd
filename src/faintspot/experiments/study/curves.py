"""Error curves of a study, the kept pixels of figure 5, TV against the other methods, and verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from enum import StrEnum
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.base.report.texts import Texts
from faintspot.experiments.curves import Curve
from faintspot.experiments.methods import TV

if TYPE_CHECKING:
    import xarray


_TEXT = Texts("faintspot.experiments")
_USUAL = [words for _, words in _TEXT["standard_parameters"].values()]
_IN_ORDER = (
    "elongation", "read_noise_e", "pixels", "position_range_px", "background_e", "em_gain", "d_over_r0"
)  # fmt: skip


def parameter_in_words(name: str, value: object) -> str:
    """Return a cell's parameter with its unit."""
    standard, words = _TEXT["standard_parameters"].get(name, (None, ""))
    return str(words) if value == standard else str(_TEXT[f"parameters.{name}"]).format(value)


def shared_in_words(values: Mapping[str, object]) -> str:
    """Return parameters with their units, without those that are not there."""
    named = (parameter_in_words(name, value) for name, value in values.items())
    return ", ".join(text for text in named if not text.startswith("no "))


@dataclass(frozen=True, order=True)
class StudyConditions:
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

    def in_words(self, without: str = "") -> str:
        """Return the configuration in one line, without one of its parameters."""
        size = "" if without == "size" else f" of size {self.size:g}"
        words = {name: parameter_in_words(name, getattr(self, name)) for name in _IN_ORDER}
        words["position_range_px"] = f"±{self.position_range_px:g} px"
        unusual = [text for name, text in words.items() if name != without and text not in _USUAL]
        return ", ".join([f"{self.profile} spot{size}", *unusual])


def names_of(dataset: xarray.Dataset, coordinate: str) -> list[str]:
    """Return the names of a study's methods ("estimator") or modes ("mode")."""
    return [str(name) for name in dataset[coordinate].values]


def measured_profiles(dataset: xarray.Dataset) -> list[str]:
    """Return the spot profiles of finished cells, in order."""
    return sorted({str(name) for name in dataset["profile"].values[dataset["done"].values]})


def study_curves(dataset: xarray.Dataset, mode: str) -> dict[StudyConditions, Curve]:
    """Return the curve of every configuration in a mode, from the finished cells of a study.

    Raises
    ------
    InputError
        For a mode that the study does not have.
    """
    if mode not in (modes := names_of(dataset, "mode")):
        raise InputError(f"mode {mode!r}: expected one of {', '.join(modes)}")
    methods = tuple(names_of(dataset, "estimator"))
    of_mode = dataset[["error", "error_covariance"]].sel(mode=mode)
    error = of_mode["error"].transpose("cell", "estimator").values
    covariance = of_mode["error_covariance"].transpose("cell", "estimator", "estimator2").values
    flux = np.asarray(dataset["flux_e"].values, dtype=np.float64)
    return {
        configuration: Curve(flux[cells], methods, error[cells], covariance[cells])
        for configuration, cells in cells_by_configuration(dataset).items()
    }


def cells_by_configuration(dataset: xarray.Dataset) -> dict[StudyConditions, NDArray[np.int64]]:
    """Return the indices of the finished cells of every configuration, by increasing flux."""
    columns = {field.name: dataset[field.name].values for field in fields(StudyConditions)}
    groups: dict[StudyConditions, list[int]] = {}
    for cell in np.flatnonzero(dataset["done"].values):
        values: dict[str, Any] = {name: column[cell].item() for name, column in columns.items()}
        groups.setdefault(StudyConditions(**values), []).append(int(cell))
    flux = dataset["flux_e"].values
    return {key: np.array(sorted(cells, key=lambda cell: flux[cell])) for key, cells in groups.items()}


KEPT_RANGE = (10, 60)
"""The smallest and largest k between which the dependence is measured."""

# Basden et al.'s text compares read noises at 50 electrons, the lower of the two signals of its first panel.
_WANTED_SIGNALS_E = (50.0, 200.0)
_SHOWN_NOISES_E = (0.1, 1.0, 3.0, 16.0)


@dataclass(frozen=True)
class KeptPanel:
    """The cells of one part of the figure: what varies, and (label, cell index) of each."""

    title: str
    cells: Sequence[tuple[str, int]]


def kept_panels(dataset: xarray.Dataset, profile: str) -> list[KeptPanel]:
    """Return the three parts of the figure for a spot profile: signals, spot sizes, read noises.

    16 x 16 pixels (or the study's largest), round spots, the smallest position range. Where a study does not
    have the paper's fluxes, the nearest are taken.
    """
    cells_of = {
        configuration: cells
        for configuration, cells in cells_by_configuration(dataset).items()
        if configuration.profile == profile and configuration.elongation == 1
    }
    if not cells_of:
        return []
    reach = min(configuration.position_range_px for configuration in cells_of)
    pixels = max(configuration.pixels for configuration in cells_of)
    kept = [c for c in sorted(cells_of) if (c.position_range_px, c.pixels) == (reach, pixels)]
    noise = min((c.read_noise_e for c in kept), default=0.0)
    size = min((c.size for c in kept), default=0.0)
    fixed = f"{profile}, {pixels} × {pixels} px, ±{reach:g} px"
    low, high = _WANTED_SIGNALS_E

    def nearest(configuration: StudyConditions, target_e: float) -> tuple[float, int]:
        flux = dataset["flux_e"].values[cells_of[configuration]]
        best = int(np.argmin(np.abs(np.log(flux / target_e))))
        return float(flux[best]), int(cells_of[configuration][best])

    def panel(subject: str, named: Sequence[tuple[str, StudyConditions]], common: str) -> KeptPanel:
        """Return one cell of each configuration, at the flux nearest to the lower one that is wanted."""
        closest = [(name, *nearest(configuration, low)) for name, configuration in named]
        fluxes = {flux for _, flux, _ in closest}
        at = f"{fluxes.pop():g} e-" if len(fluxes) == 1 else ""
        cells = [(name if at else f"{name}, {flux:g} e-", cell) for name, flux, cell in closest]
        return KeptPanel(f"{subject} at {at or 'signals as named'}, {common}; {fixed}", cells)

    quiet = [c for c in kept if c.read_noise_e == noise]
    sharp = [c for c in kept if c.size == size and c.read_noise_e in (*_SHOWN_NOISES_E, noise)]
    at_signals = dict(nearest(c, target) for c in quiet if c.size == size for target in (low, high))
    signals = [(f"{flux:g} e-", cell) for flux, cell in at_signals.items()]
    return [
        KeptPanel(f"signals, size {size:g}, {noise:g} e- read noise; {fixed}", signals),
        panel("spot sizes", [(f"size {c.size:g}", c) for c in quiet], f"{noise:g} e- read noise"),
        panel("read noises", [(f"{c.read_noise_e:g} e-", c) for c in sharp], f"size {size:g}"),
    ]


def spread(
    dataset: xarray.Dataset, cell: int, method: str, modes: Sequence[str] = ()
) -> tuple[float, float] | None:
    """Return ln(largest R / smallest R) over k, and an upper limit of its standard error.

    Over k within KEPT_RANGE, or over modes of fixed k. The two R are from the same realisations; their
    correlation, which is not known, would make the error smaller. None when the method has no k or the cell
    too few pixels.
    """
    part = dataset.sel(estimator=method).isel(cell=cell)
    if modes:
        values, errors = (part[name].sel(mode=modes).values for name in ("error", "error_se"))
    else:
        kept = part.sel(k=slice(*KEPT_RANGE))
        values, errors = kept["error_at_k"].values, kept["error_at_k_se"].values
    if values.size < 2 or not np.all(np.isfinite(values)):
        return None
    low, high = int(np.argmin(values)), int(np.argmax(values))
    relative = np.hypot(errors[low] / values[low], errors[high] / values[high])
    return float(np.log(values[high] / values[low])), float(relative)


_FAMILY_FALSE_ALARM = 0.05


@dataclass(frozen=True)
class AgainstTV:
    """A method against TV, over all cells of a spot profile in one mode."""

    method: str
    mode: str
    profile: str
    smaller: int
    """Cells in which the method's R is smaller than TV's; paired, 5 % false alarms for all cells together."""
    larger: int
    cells: int
    mean_ratio: float
    """Geometric mean of R / R of TV."""
    smallest: int
    """Cells in which the method's R is the smallest of all methods, decided or not."""


def against_tv(dataset: xarray.Dataset, mode: str) -> list[AgainstTV]:
    """Return how each method compares with TV, by spot profile; nothing when TV is not in the study."""
    from scipy.special import ndtri

    curves = study_curves(dataset, mode)
    rows = []
    for profile in sorted({key.profile for key in curves}):
        part = [curve for key, curve in curves.items() if key.profile == profile]
        methods = part[0].methods
        if TV not in methods:
            continue
        error = np.concatenate([curve.error for curve in part])
        measured = np.all(np.isfinite(error), axis=1)
        winner = np.argmin(error[measured], axis=1)
        for index, method in enumerate(methods):
            pairs = [curve.difference(TV, method) for curve in part]
            difference, se = (np.concatenate([pair[i] for pair in pairs]) for i in (0, 1))
            finite = np.isfinite(difference)
            n = int(finite.sum())
            if method == TV or n == 0:
                continue
            limit = -float(ndtri(_FAMILY_FALSE_ALARM / n))
            ratio = error[finite, index] / error[finite, methods.index(TV)]
            rows.append(
                AgainstTV(
                    method,
                    mode,
                    profile,
                    int(np.sum(difference[finite] < -limit * se[finite])),
                    int(np.sum(difference[finite] > limit * se[finite])),
                    n,
                    float(np.exp(np.mean(np.log(ratio)))),
                    int(np.sum(winner == index)),
                )
            )
    return rows


class Outcome(StrEnum):
    """Verdict on a claim."""

    HOLDS = "holds"
    IN_PART = "holds in part"
    FAILS = "does not hold"


@dataclass(frozen=True)
class Case:
    """One test of a claim: where, what was found, with errors, and the outcome there."""

    where: str
    finding: str
    outcome: Outcome


@dataclass(frozen=True)
class Judgement:
    """All cases of a claim in one mode."""

    mode: str
    cases: Sequence[Case]


@dataclass(frozen=True)
class Verdict:
    """The verdict on one claim."""

    number: int
    claim: str
    rule: str
    best: Judgement
    fixed: Judgement


def judged(holds: bool, in_part: bool) -> Outcome:
    """Return the outcome of one case."""
    if holds:
        return Outcome.HOLDS
    return Outcome.IN_PART if in_part else Outcome.FAILS
