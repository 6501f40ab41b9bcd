"""The error budget: what the Strehl ratio would be without one of the things that spoil it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.magnitude import Experiment, checked_methods
from faintspot.experiments.closed_loop.methods import Choice, MethodKind
from faintspot.experiments.closed_loop.results import BudgetResult
from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.running import Advance, WorkerPool
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration
from faintspot.loop.simulation.configuration.sections import CLOSED
from faintspot.loop.simulation.files import BUDGET_FILE
from faintspot.loop.simulation.simulation import DisabledErrors, simulate_loop
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

Floats = NDArray[np.float64]


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
    experiment = Experiment.begun(configuration, folder, KIND, quick, search, pool, overwrite)
    configuration, flux = experiment.configuration, configuration.photons
    kinds = checked_methods(DEFAULT_METHODS if methods is None else methods)
    _, array_of = experiment.measured(
        kinds,
        [flux],
        budget_run,
        {term: term for term in TERMS},
        lambda kind, term, choices: (configuration, choices[flux], term),
    )
    names, labels = (tuple(getattr(kind, attribute) for kind in kinds) for attribute in ("name", "label"))
    result = BudgetResult(names, tuple(TERMS), labels, array_of("strehl"), array_of("residual_nm"))
    result.save(experiment.folder / BUDGET_FILE)
    return result


def budget_run(
    kind: MethodKind,
    configuration: LoopConfiguration,
    choice: Choice,
    term: str,
    realisation: int,
    advance: Advance,
) -> dict[str, NDArray[Any]]:
    """Run a tuned method once with a term switched off; Strehl ratio and rms wavefront as arrays.

    Raises
    ------
    InputError
        For an unknown term.
    """
    off = TERMS[one_of("term", term, list(TERMS))]
    method = kind.method(configuration, choice)
    record = simulate_loop(
        configuration,
        [method],
        realisation=realisation,
        progress=lambda done, total: advance(done),
        disabled_errors=off,
    )
    scored = record.scored & off.settled(record.frames)
    return {
        "strehl": np.asarray(record.strehl[scored].mean()),
        "residual_nm": np.asarray(np.sqrt(np.mean(record.residual_nm[scored] ** 2))),
    }
