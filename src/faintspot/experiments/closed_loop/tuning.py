"""Recommend an estimator and a control for a closed loop, from a quick measurement of `run_magnitude`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.answer import LoopAnswer
from faintspot.experiments.closed_loop.experiment import with_flux
from faintspot.experiments.closed_loop.magnitude import run_magnitude
from faintspot.experiments.closed_loop.question import LoopQuestion
from faintspot.experiments.closed_loop.search import Search
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation.configuration.configuration import LoopConfiguration

_SEARCH = Search(
    coarse_frames=120, frames=120, settle_frames=40, realisations=2, finalists=3, climbs=1, rounds=1
)


@dataclass(frozen=True)
class LoopPlan:
    """Amount of simulation.

    Parameters
    ----------
    fluxes : int
        Number of fluxes measured; limiting magnitudes are interpolated between them.
    frames, settle_frames : int
        Frames of a scored run, and how many at its start do not count.
    realisations : int
        Realisations of the atmosphere that are scored, the same for all candidates.
    search : Search
        Search for the settings.
    """

    fluxes: int = 5
    frames: int = 360
    settle_frames: int = 60
    realisations: int = 4
    search: Search = _SEARCH

    def __post_init__(self) -> None:
        lowest = {"fluxes": 3, "frames": self.settle_frames + 1, "realisations": 1, "settle_frames": 0}
        for name, low in lowest.items():
            number_between(f"plan.{name}", getattr(self, name), low, 10**6, integer=True)

    def configuration(self, loop: LoopConfiguration) -> LoopConfiguration:
        """Return a loop with the length and number of scored runs; its own star does not count."""
        run = {name: getattr(self, name) for name in ("frames", "settle_frames", "realisations")}
        return with_flux(loop.replace("run", **run, photons_per_subaperture=()), 1.0)


def tune_loop(
    question: LoopQuestion,
    folder: str | Path,
    *,
    plan: LoopPlan | None = None,
    pool: WorkerPool | None = None,
    overwrite: bool = False,
) -> LoopAnswer:
    """Find out which estimator and control suit a closed loop, and with which settings.

    Candidates are tuned and scored as by `run_magnitude`, with short runs and a short search. The answer
    depends on question, plan and the configuration's seed alone, not on the speed of the machine.

    Parameters
    ----------
    question : LoopQuestion
    folder : path
        Where finished units are remembered; made where it is not there. Interrupted, the same call goes on.
    plan : LoopPlan, optional
    pool : WorkerPool, optional
        Where the work is done. Default: processes on this machine.
    overwrite : bool
        Whether another question's units in the folder are replaced.

    Raises
    ------
    InputError
        For a question of the wrong kind, or a folder that holds another question's units.
    MissingExtraError
        When HCIPy or zarr is not installed.

    Examples
    --------
    >>> from faintspot.loop.simulation import load_loop
    >>> from faintspot.experiments import LoopQuestion, tune_loop
    >>> question = LoopQuestion(load_loop("canary"), magnitudes=(10.0, 13.0))
    >>> answer = tune_loop(question, "loop-tune")  # doctest: +SKIP
    """
    if not isinstance(question, LoopQuestion):
        raise InputError(f"question: expected a LoopQuestion, got {type(question).__name__}")
    plan = LoopPlan() if plan is None else plan
    base, fluxes = plan.configuration(question.configuration), question.photons(plan.fluxes)
    names = [kind.name for kind in question.kinds]
    result = run_magnitude(base, folder, names, fluxes, search=plan.search, pool=pool, overwrite=overwrite)
    return LoopAnswer(question, result, plan.frames - plan.settle_frames, dict(question.left_out))
