"""The error budget: what the Strehl ratio would be without one of the things that spoil it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.experiment import Experiment, checked_methods
from faintspot.experiments.closed_loop.results import BudgetResult
from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import CLOSED
from faintspot.loop.simulation.record import BUDGET_FILE
from faintspot.loop.simulation.simulation import DisabledErrors
from faintspot.slopes.estimators.built_in.brightest import BrightestPixels
from faintspot.slopes.estimators.built_in.smoothed import Smoothed
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation

KIND = "budget"
DEFAULT_METHODS = tuple(kind.name for kind in (BrightestPixels, Smoothed, TotalVariation))
_FASTER = 10.0


TERMS = {
    "nothing": DisabledErrors(),
    "photon and read noise": DisabledErrors(noiseless=True),
    "servo lag": DisabledErrors(faster=_FASTER),
    "fitting and aliasing": DisabledErrors(correctable=True),
    "centroid gain error": DisabledErrors(exact_gain=True),
    "slope error": DisabledErrors(true_slopes=True),
    "slope error and servo lag": DisabledErrors(true_slopes=True, faster=_FASTER),
}
"""Loops with something switched off that spoils the Strehl ratio, by its name; the first is nothing."""


def run_budget(
    configuration: LoopConfiguration,
    folder: str | Path,
    methods: Sequence[str] | None = None,
    *,
    quick: bool = False,
    search: Search | None = None,
    pool: WorkerPool | None = None,
    overwrite: bool = False,
) -> BudgetResult:
    """Measure the Strehl ratio of methods with each of `TERMS` switched off, or what is left of it.

    Each method is tuned as for `run_magnitude`, at the configuration's own flux with everything on, and
    keeps these settings and its loop gain throughout. The result is also written to the folder.

    Parameters
    ----------
    methods : sequence of str, optional
        Default: brightest pixels, Gaussian smoothing and TV.
    configuration, folder, quick, search, pool, overwrite
        As for `run_magnitude`.

    Raises
    ------
    InputError
        As `run_magnitude`, and for a loop that is open.

    Examples
    --------
    >>> from faintspot.experiments import run_budget
    >>> from faintspot.loop.simulation import load_loop
    >>> result = run_budget(load_loop("canary"), "budget", quick=True)  # doctest: +SKIP
    """
    if configuration.control.mode != CLOSED:
        raise InputError(
            f"control.mode = {configuration.control.mode!r}: expected 'closed' for an error budget"
        )
    kinds, flux = checked_methods(DEFAULT_METHODS if methods is None else methods), configuration.photons
    experiment = Experiment(configuration, folder, KIND, quick, search, pool, overwrite)
    found = experiment.measured(kinds, {term: (flux, off) for term, off in TERMS.items()})
    names, labels = (tuple(getattr(kind, attribute) for kind in kinds) for attribute in ("name", "label"))
    result = BudgetResult(names, tuple(TERMS), labels, found["strehl"], found["residual_nm"])
    result.save(experiment.folder / BUDGET_FILE)
    return result
