"""The night in a simulated loop: alternating methods, and the reference alone in the same turbulence."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.experiments.night.protocol import NIGHT_FILE, QUICK_PLAN, Night, NightPlan, counts_per_e
from faintspot.experiments.running import Advance, Unit, WorkerPool, run_units
from faintspot.experiments.store import UnitStore, ZarrStore, fingerprint_of
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.methods import Method
from faintspot.loop.simulation.record import LoopRecord, make_folder, slope_turbulence
from faintspot.loop.simulation.sections import CLOSED
from faintspot.loop.simulation.simulation import simulate_loop
from faintspot.loop.slope_covariance import SlopeTurbulence
from faintspot.loop.turbulence_strength import turbulence_strength

FEWEST_FRAMES = 20


def r0_of_slopes(
    open_loop_px: Floats,
    residual_px: Floats,
    site: SlopeTurbulence,
    outer_scale_m: float | None = None,
    *,
    run: NDArray[np.int64] | None = None,
) -> tuple[float, float]:
    """Return r0 at 500 nm of frames and its standard error, m; NaN where it is not measured.

    Parameters
    ----------
    open_loop_px, residual_px : (frames, 2 n) array
        Pseudo-open-loop slopes, and residual slopes divided by the centroid gain.
    site : SlopeTurbulence
        Geometry; its strength and winds are not used.
    outer_scale_m : float, optional
        Outer scale, where it is known.
    run : (frames,) array of int, optional
        Frames with the same number are consecutive. Default: all are.
    """
    if len(open_loop_px) < FEWEST_FRAMES:
        return math.nan, math.nan
    run = np.zeros(len(open_loop_px), np.int64) if run is None else run
    slopes = np.asarray(open_loop_px, np.float64), np.asarray(residual_px, np.float64)
    strength = turbulence_strength(*slopes, run, site, outer_scale_m=outer_scale_m)
    return strength.r0_m, strength.r0_error_m


KIND = "night"
_PIECES = 10  # of a block, from whose scatter the error of its mean follows
_LEAST_VALID = 0.9  # of the slopes of a block; large ones are missed most, so that r0 comes out too large
_VALUES = (
    "strehl", "strehl_error", "phase_rad2", "phase_error_rad2", "r0_m", "r0_error_m", "true_r0_m"
)  # fmt: skip


def run_night(
    configuration: LoopConfiguration,
    folder: str | Path,
    *,
    plan: NightPlan | None = None,
    quick: bool = False,
    pool: WorkerPool | None = None,
    overwrite: bool = False,
) -> Night:
    """Observe a night in simulation, or what is left of it; the result is also written to the folder.

    The sets follow one another in one continuous atmosphere, in which r0 drifts as configured; the reference
    also runs alone in the same turbulence. Each unit of work is a set; where it is finished, it is not done
    again.

    Parameters
    ----------
    configuration : LoopConfiguration
    folder : path
        Where finished units and the night are kept; made where it is not there.
    plan : NightPlan, optional
        Default: the paper's, or with `quick` a short one.
    quick : bool
        Short blocks and few strengths.
    pool : WorkerPool, optional
        Where the work is done. Default: processes on this machine.
    overwrite : bool
        Whether another experiment in the folder is replaced.

    Raises
    ------
    InputError
        When the folder holds another experiment, or methods and configuration do not fit together.
    MissingExtraError
        When HCIPy or zarr is not installed.

    Examples
    --------
    >>> from faintspot.experiments.night.simulated import run_night
    >>> from faintspot.loop.simulation import load_loop
    >>> night = run_night(load_loop("canary"), "night", quick=True)  # doctest: +SKIP
    """
    plan = plan or (QUICK_PLAN if quick else NightPlan())
    pool, folder = pool or WorkerPool(), make_folder(folder)
    identity = fingerprint_of(configuration.to_text(), str(asdict(plan)), f"quick: {quick}")

    plan.made(plan.configuration(configuration, 0), 0)  # refuses what does not fit before any work
    pool.say("observing")
    units = [
        Unit(_key(number, alone), (configuration, plan, number, alone), plan.frames(number))
        for alone in (False, True)
        for number in range(plan.sets)
    ]
    store = ZarrStore(
        make_folder(folder / "units") / "night.zarr",
        KIND,
        identity,
        [unit.key for unit in units],
        attributes={"name": configuration.name},
        overwrite=overwrite,
    )
    night = _night(configuration, plan, run_units(observe, units, store, pool))
    night.save(folder / NIGHT_FILE)
    return night


def _key(number: int, alone: bool) -> str:
    return f"{number + 1}-reference" if alone else f"{number + 1}"


def observe(
    configuration: LoopConfiguration, plan: NightPlan, number: int, alone: bool, advance: Advance
) -> dict[str, NDArray[np.generic]]:
    """Observe one set; return the values of its blocks, NaN up to the number of blocks of the longest set.

    Parameters
    ----------
    configuration : LoopConfiguration
    plan : NightPlan
    number : int
        Set, counted from 0.
    alone : bool
        Whether the reference measures all blocks.
    advance : callable
        Called with the number of frames done.
    """
    whole = plan.configuration(configuration, number)
    schedule = plan.schedule(number)
    methods = plan.made(whole, number)
    record = simulate_loop(
        whole,
        methods[:1] if alone else methods,
        np.zeros_like(schedule) if alone else schedule,
        first_frame=plan.frame_numbers(number),
        progress=lambda done, total: advance(done),
    )
    most = max(plan.blocks(each) for each in range(plan.sets))
    values = np.full((len(_VALUES), most), np.nan)
    for block in range(plan.blocks(number)):
        first = block * plan.block_frames
        values[:, block] = _of_block(
            record, whole, slice(first + plan.settle_in_block, first + plan.block_frames), seeing=not alone
        )
    return dict(zip(_VALUES, values, strict=True))


def _of_block(record: LoopRecord, configuration: LoopConfiguration, rows: slice, seeing: bool) -> list[float]:
    """Return the values of a block, in the order of `_VALUES`."""
    to_phase = (2e-9 * math.pi / configuration.science.wavelength_m) ** 2
    phase = to_phase * np.square(record.residual_nm[rows])
    r0 = (math.nan, math.nan)
    if seeing and record.valid[rows].mean() >= _LEAST_VALID:
        gain = record.centroid_gain[record.method[rows]][:, None]
        residual = record.slopes_px[rows] / gain
        mirror = record.commands[rows].astype(np.float64) @ record.interaction_matrix.T
        open_loop = residual - mirror if configuration.control.mode == CLOSED else residual
        site = slope_turbulence(configuration, record.cells)
        r0 = r0_of_slopes(open_loop, residual, site, configuration.atmosphere.outer_scale_m)
    true = float(np.mean(record.r0_m[rows] ** (-5 / 3)) ** (-3 / 5))
    return [*_mean(record.strehl[rows]), *_mean(phase), *r0, true]


def _mean(values: Floats) -> tuple[float, float]:
    """Return the mean of a block and its standard error, from consecutive pieces."""
    pieces = [float(piece.mean()) for piece in np.array_split(values, _PIECES)]
    return float(values.mean()), float(np.std(pieces, ddof=1)) / math.sqrt(_PIECES)


def _night(configuration: LoopConfiguration, plan: NightPlan, results: UnitStore) -> Night:
    """Put the sets together."""
    rate = configuration.control.frame_rate_hz
    methods: dict[str, Method] = {}
    sets = []
    for number in range(plan.sets):
        entries, count = plan.entries(number), plan.blocks(number)
        whole = plan.configuration(configuration, number)
        made = plan.made(whole, number)
        for method in made:
            methods.setdefault(method.label, method)
        numbers = np.array([list(methods).index(method.label) for method in made])
        order, observed = np.arange(count) % len(entries), results[_key(number, False)]
        first = plan.first_frames(number) + plan.settle_in_block
        sets.append(
            {
                "set_number": np.full(count, number),
                "method": numbers[order],
                "strength": np.array([strength for _, strength in entries])[order],
                "counts_per_e": np.full(count, counts_per_e(whole)),
                "start_s": first / rate,
                "paired_strehl": results[_key(number, True)]["strehl"][:count],
                **{name: observed[name][:count] for name in _VALUES},
            }
        )
    values: dict[str, Any] = {name: np.concatenate([part[name] for part in sets]) for name in sets[0]}
    scored = plan.block_frames - plan.settle_in_block
    return Night(
        labels=tuple(methods),
        settings=tuple(_in_words(configuration, method) for method in methods.values()),
        reference=0,
        set_names=tuple(plan.set_name(number) for number in range(plan.sets)),
        duration_s=np.full(len(values["start_s"]), scored / rate),
        overhead_s=(plan.settle_in_block + plan.gap_frames) / rate,
        wavelength_m=configuration.science.wavelength_m,
        source="simulated",
        strength_unit=plan.unit,
        configuration=configuration.to_text(),
        **values,
    )


def _in_words(configuration: LoopConfiguration, method: Method) -> str:
    """Return settings and loop gain of a method in words."""
    gain = configuration.control.gain if method.gain is None else method.gain
    words = method.estimator.in_words(1, configuration.sensor.pixels**2)
    return f"{words}; loop gain {gain:.3g}"
