"""Interleaved observations: without denoising, then with strengths that rise, again and again."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintspot.algorithms.noise import suggested_strength
from faintspot.ao_loop.configuration import LoopConfiguration
from faintspot.ao_loop.files import make_folder
from faintspot.ao_loop.methods import Method
from faintspot.ao_loop.record import LoopRecord
from faintspot.ao_loop.simulation import simulate_loop
from faintspot.base.checks import number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.npz import read_arrays, save_arrays
from faintspot.estimators.base import Estimator
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.total_variation import TotalVariation
from faintspot.experiments.loop_results import InterleavedResult, set_file
from faintspot.experiments.magnitude import Experiment
from faintspot.experiments.running import Advance, Unit, WorkerPool, run_units
from faintspot.experiments.search import FIRST_TUNING_REALISATION
from faintspot.experiments.store import Arrays
from faintspot.pipeline.settings import Settings

KIND = "interleaved"
_MOST_ITERATIONS = 100  # near infeasible strengths the denoising is far from done after ten
_TOLERANCE = 1e-3


@dataclass(frozen=True)
class ObservingPlan:
    """Schedule of the interleaved observations.

    Parameters
    ----------
    block_frames : int
        Frames of a measurement.
    settle_in_block : int
        Of these, those at its start that are not scored.
    strengths : tuple of int
        Number of strengths in each set, evenly spaced from 0 to `strongest_e`.
    em_fractions : tuple of float
        Multiplication gain in each set, as a fraction of the configuration's.
    repeats : tuple of int
        How often each set goes through its measurements.
    strongest_e : float
        The largest strength, electrons.
    kept, gains : tuple of float
        Numbers of kept pixels, as fractions of the window's, and loop gains that are tried together.
    tuning_frames : int
        Of a run in which they are tried.

    Raises
    ------
    InputError
        For numbers out of range, or lists of different lengths.
    """

    block_frames: int = 700
    settle_in_block: int = 100
    strengths: tuple[int, ...] = (8, 20, 8, 20)
    em_fractions: tuple[float, ...] = (1.0, 1.0, 0.75, 0.75)
    repeats: tuple[int, ...] = (12, 5, 12, 5)
    strongest_e: float = 2.0
    kept: tuple[float, ...] = (0.045, 0.09, 0.18, 0.35)
    gains: tuple[float, ...] = (0.2, 0.35, 0.5, 0.65)
    tuning_frames: int = 600

    def __post_init__(self) -> None:
        number_between("plan.settle_in_block", self.settle_in_block, 0, 10**6, integer=True)
        number_between("plan.block_frames", self.block_frames, self.settle_in_block + 1, 10**6, integer=True)
        number_between(
            "plan.tuning_frames", self.tuning_frames, self.settle_in_block + 1, 10**6, integer=True
        )
        numbers_between("plan.kept", self.kept, 0, 1)
        numbers_between("plan.gains", self.gains, 0, 2)
        number_between("plan.strongest_e", self.strongest_e, 0, 1e6, low_open=True)
        if not len(self.strengths) == len(self.em_fractions) == len(self.repeats) >= 1:
            raise InputError("plan: expected strengths, em_fractions and repeats for each set")
        for strengths, fraction, repeats in zip(self.strengths, self.em_fractions, self.repeats, strict=True):
            number_between("plan.strengths", strengths, 2, 126, integer=True)
            number_between("plan.em_fractions", fraction, 0, 1, low_open=True)
            number_between("plan.repeats", repeats, 1, 10**4, integer=True)

    def frames(self, number: int) -> int:
        """Return the frames of a set, counted from 0."""
        return self.block_frames * (1 + self.strengths[number]) * self.repeats[number]


QUICK_PLAN = ObservingPlan(
    block_frames=460, settle_in_block=60, strengths=(8, 20, 8, 20), repeats=(2, 1, 2, 1), tuning_frames=200
)


def run_interleaved(
    configuration: LoopConfiguration,
    folder: str | Path,
    *,
    quick: bool = False,
    plan: ObservingPlan | None = None,
    place: WorkerPool | None = None,
    overwrite: bool = False,
) -> InterleavedResult:
    """Observe in four sets, two at full and two at 75 % of the multiplication gain, or what is left of them.

    Each set consists of a measurement without denoising, then 8 or 20 with strengths rising from 0 to 2
    electrons, and again, while the loop stays closed and the turbulence drifts. All methods of a set have the
    same number of kept pixels and the same loop gain: those that are best for denoising and none together,
    in turbulence that is not scored. Without multiplication all sets are the same but for the air.

    Parameters
    ----------
    configuration : LoopConfiguration
    folder : path
        Folder for finished sets; created if absent.
    quick : bool
        Fewer and shorter measurements.
    plan : ObservingPlan, optional
    place : WorkerPool, optional
        Where the work is done. Default: processes on this machine.
    overwrite : bool
        Whether another experiment in the folder is replaced.

    Raises
    ------
    InputError
        When the folder holds another experiment or cannot be written.
    MissingExtraError
        When HCIPy, or Dask where it is needed, is not installed.

    Examples
    --------
    >>> from faintspot.experiments import run_interleaved
    >>> from faintspot.ao_loop import load_loop
    >>> result = run_interleaved(load_loop("canary"), "interleaved", quick=True)  # doctest: +SKIP
    """
    place = WorkerPool() if place is None else place
    plan = plan or (QUICK_PLAN if quick else ObservingPlan())
    experiment = Experiment(configuration, plan, make_folder(folder), KIND, place, overwrite)
    folder = experiment.folder
    best = _tuned(experiment)
    sets = range(len(plan.strengths))
    units = [
        Unit(
            str(number + 1),
            (configuration, plan, number, *best[plan.em_fractions[number]]),
            plan.frames(number),
        )
        for number in sets
    ]
    place.say("observing")
    run_units(_observe, units, _SetStore(folder), place)
    result = InterleavedResult(
        tuple(LoopRecord.load(set_file(folder, number + 1)) for number in sets),
        tuple(blocks_of(plan, number) for number in sets),
        tuple(strengths_of(plan, number) for number in sets),
        tuple(_set_name(plan, number) for number in sets),
        plan.settle_in_block,
    )
    result.save_description(folder)
    return result


def blocks_of(plan: ObservingPlan, number: int) -> NDArray[np.int64]:
    """Return the measurement that each frame of a set belongs to; sets are counted from 0."""
    return np.arange(plan.frames(number)) // plan.block_frames


def strengths_of(plan: ObservingPlan, number: int) -> NDArray[np.float64]:
    """Return the strength of each method of a set, electrons; NaN for the first, which does not denoise."""
    return np.concatenate([[np.nan], np.linspace(0, plan.strongest_e, plan.strengths[number])])


def _set_name(plan: ObservingPlan, number: int) -> str:
    fraction = plan.em_fractions[number]
    gain = "full gain" if fraction == 1 else f"{fraction * 100:g} % of the gain"
    return f"{gain}, {plan.strengths[number]} strengths"


def _mean_pixel_noise_e(configuration: LoopConfiguration) -> float:
    scene = configuration.scene
    return float(suggested_strength(scene.dark_noise_e, scene.flux_e, scene.pixels))


def _with_multiplication(configuration: LoopConfiguration, fraction: float) -> LoopConfiguration:
    return configuration.replace("camera", em_gain=max(1.0, fraction * configuration.camera.em_gain))


def _method(label: str, strength_e: float, kept: int, gain: float) -> Method:
    estimator: Estimator = BrightestPixels(keep_brightest=kept)
    if not math.isnan(strength_e):
        estimator = TotalVariation(
            noise_std=strength_e, keep_brightest=kept, max_iterations=_MOST_ITERATIONS, tolerance=_TOLERANCE
        )
    return Method(label, Settings(estimator), gain)


def _kept_pixels(configuration: LoopConfiguration, fraction: float) -> int:
    """Return a number of kept pixels for a fraction of the window's."""
    pixels = configuration.scene.pixels
    return max(4, min(pixels - 1, round(fraction * pixels)))


def _tuned(experiment: Experiment) -> dict[float, tuple[float, float]]:
    """Return kept pixels (as a fraction) and loop gain for each multiplication gain."""
    configuration, plan = experiment.configuration, experiment.plan
    trials = {
        (fraction, kept, gain): Unit(
            f"{fraction:g}-{kept:g}-{gain:g}",
            (configuration, plan, fraction, kept, gain),
            2 * plan.tuning_frames,
        )
        for fraction in sorted(set(plan.em_fractions))
        for kept in plan.kept
        for gain in plan.gains
    }
    units = list(trials.values())
    store = experiment.store(units, "-tuning")
    if store.is_empty:  # of another experiment
        for old in experiment.folder.glob("set-*.npz"):
            old.unlink(missing_ok=True)
    experiment.place.say("tuning")
    tried = run_units(_trial, units, store, experiment.place)
    strehl = {trial: float(tried[unit.key]["strehl"]) for trial, unit in trials.items()}
    best = {
        fraction: max((t for t in trials if t[0] == fraction), key=strehl.__getitem__)
        for fraction, *_ in trials
    }
    return {fraction: (kept, gain) for fraction, (_, kept, gain) in best.items()}


def _trial(
    configuration: LoopConfiguration,
    plan: ObservingPlan,
    fraction: float,
    kept: float,
    gain: float,
    advance: Advance,
) -> Arrays:
    """Return the mean Strehl ratio of a method with and one without denoising."""
    short = _with_multiplication(configuration, fraction).replace(
        "run", frames=plan.tuning_frames, settle_frames=plan.settle_in_block
    )
    pixels = _kept_pixels(configuration, kept)
    strehl = [
        simulate_loop(
            short, [_method("tuning", strength, pixels, gain)], realisation=FIRST_TUNING_REALISATION
        ).mean_strehl()
        for strength in (np.nan, _mean_pixel_noise_e(short))
    ]
    advance(2 * plan.tuning_frames)
    return {"strehl": np.asarray(np.mean(strehl))}


def _observe(
    configuration: LoopConfiguration,
    plan: ObservingPlan,
    number: int,
    kept: float,
    gain: float,
    advance: Advance,
) -> Arrays:
    """Observe one set; its number is that of the air's realisation."""
    strengths = strengths_of(plan, number)
    pixels = _kept_pixels(configuration, kept)
    methods = [
        _method("no TV" if math.isnan(strength) else f"TV {strength:.3g} e-", float(strength), pixels, gain)
        for strength in strengths
    ]
    schedule = blocks_of(plan, number) % len(methods)
    whole = _with_multiplication(configuration, plan.em_fractions[number]).replace(
        "run", frames=len(schedule), settle_frames=plan.settle_in_block
    )
    record = simulate_loop(
        whole, methods, schedule, realisation=number, progress=lambda done, total: advance(done)
    )
    return record.arrays()


class _SetStore:
    """The sets of an experiment, each in a file of its own."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def done(self, key: str) -> bool:
        return set_file(self._folder, int(key)).exists()

    def read(self, key: str) -> Arrays:
        return read_arrays(set_file(self._folder, int(key)), LoopRecord.WHAT)

    def write(self, key: str, result: Arrays) -> None:
        save_arrays(set_file(self._folder, int(key)), result)
