"""What does a followed sodium profile gain in a closed loop, and what does a profile leave that changes?

Prints Markdown tables for the configuration `lgs_eight_metre`: Strehl ratio and wavefront error against flux,
and the low Zernike modes that are left after a second peak of the sodium layer has appeared. Every method has
the same turbulence and noise. Window widths are chosen in other turbulence than is scored.

    python examples/laser_guide_star_loop.py
"""

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np

import faintspot as fs
from faintspot.cli.output import progress_bar
from faintspot.experiments.closed_loop.search import FIRST_TUNING_REALISATION
from faintspot.loop.simulation import LoopConfiguration, LoopRecord, Method, load_loop, simulate_loop

FLUXES = (60.0, 200.0)
FRAMES, SETTLE = 160, 50
WIDTHS_PX = (2.5, 4.0, 6.3)
TUNING_FRAMES = 100
REALISATIONS = 3
LARGEST_PX = 2.0  # search range

# A layer of 8 km; later 45 % of the flux in a peak of 3 km, 8 km above. The mean altitude stays: it is focus.
ALTITUDES = np.arange(74e3, 103e3, 1e3)
SHARE, ABOVE_M = 0.45, 8e3
BEFORE = fs.SodiumProfile.gaussian(88e3, 8e3).at(ALTITUDES).density
LOWER, PEAK = (
    fs.SodiumProfile.gaussian(88e3 - SHARE * ABOVE_M + above, width).at(ALTITUDES).density
    for above, width in ((0.0, 8e3), (ABOVE_M, 3e3))
)
CHANGE_FRAMES, CHANGED_FROM_S, CHANGED_TO_S = 440, 0.1, 0.3
CHANGE_FLUX_E = 200.0
SCORED_FROM = 360  # 0.42 s after the end of the change
LOW = slice(3, 10)  # Zernike modes 5 to 11 of a record

Advance = Callable[[int], None]


def window(width_px: float) -> Method:
    """Return a weighted centre of gravity."""
    return Method("weighted centre of gravity", fs.Settings("window", window_fwhm_px=width_px))


def others() -> list[Method]:
    """Return the methods without a tuned option."""
    linear, ml = fs.Settings("window"), fs.Settings("ml", search_range_px=LARGEST_PX)
    return [
        Method("linear matched filter, static", linear, variants=("filter",)),
        Method("linear matched filter, followed", linear, variants=("filter", "followed")),
        Method("ml, followed", ml, variants=("followed",)),
    ]


def run(
    loop: LoopConfiguration, method: Method, realisation: int, frames: int, advance: Advance
) -> LoopRecord:
    """Simulate a loop of so many frames."""
    short = loop.replace("run", frames=frames, settle_frames=min(SETTLE, frames - 1))
    record = simulate_loop(short, [method], realisation=realisation)
    advance(frames)
    return record


def tuned(loop: LoopConfiguration, advance: Advance) -> Method:
    """Return the weighted centre of gravity with the best width in other turbulence."""
    found = {
        width: run(loop, window(width), FIRST_TUNING_REALISATION, TUNING_FRAMES, advance).mean_strehl()
        for width in WIDTHS_PX
    }
    return window(max(found, key=lambda width: found[width]))


def flux_tables(loop: LoopConfiguration, advance: Advance) -> None:
    """Print Strehl ratio and wavefront error against flux; differences are paired."""
    strehl: dict[str, list[str]] = {}
    error: dict[str, list[str]] = {}
    for flux in FLUXES:
        star = loop.replace("camera", photons_per_subaperture=flux)
        first = None
        for method in [tuned(star, advance), *others()]:
            runs = [run(star, method, each, FRAMES, advance) for each in range(REALISATIONS)]
            values = np.array([each.mean_strehl() for each in runs])
            nm = np.array([np.sqrt(np.square(each.residual_nm[each.scored]).mean()) for each in runs])
            first = values if first is None else first
            change = values - first
            text = f"{values.mean():.3f}"
            if method.label != "weighted centre of gravity":
                text += f" ({change.mean():+.3f} ± {change.std(ddof=1) / np.sqrt(len(change)):.3f})"
            strehl.setdefault(method.label, []).append(text)
            spread = nm.std(ddof=1) / np.sqrt(len(nm))
            error.setdefault(method.label, []).append(f"{nm.mean():.0f} ± {spread:.0f}")
    for title, rows in (("Strehl ratio", strehl), ("wavefront error [nm rms]", error)):
        print(f"\n| {title} | " + " | ".join(f"{flux:g} e-" for flux in FLUXES) + " |")
        print("|---" * (1 + len(FLUXES)) + "|")
        for label, cells in rows.items():
            print(f"| {label} | " + " | ".join(cells) + " |", flush=True)


def change_table(loop: LoopConfiguration, advance: Advance) -> None:
    """Print what the change of the profile adds to the low modes: against the same run without it."""
    after = (1 - SHARE) * LOWER + SHARE * PEAK
    star = loop.replace("camera", photons_per_subaperture=CHANGE_FLUX_E)
    layer: dict[str, Any] = {
        "altitude_m": tuple(ALTITUDES),
        "follow_every_frames": 50,
        "follow_time_constant_frames": 50.0,
    }
    constant = star.replace("laser", **layer, time_s=(0.0,), density=(tuple(BEFORE),))
    times = 0.0, CHANGED_FROM_S, CHANGED_TO_S
    densities = tuple(map(tuple, (BEFORE, BEFORE, after)))
    changing = star.replace("laser", **layer, time_s=times, density=densities)
    compared = others()[1:3]
    low: dict[str, list[Any]] = {method.label: [] for method in compared}
    focus: dict[str, list[Any]] = {label: [] for label in low}
    strehl: dict[str, list[Any]] = {label: [] for label in low}
    for realisation in range(REALISATIONS):  # what is learnt before a run is kept from one method to the next
        for method in compared:
            records = [
                run(each, method, realisation, CHANGE_FRAMES, advance) for each in (changing, constant)
            ]
            change = np.subtract(*(each.zernike_nm[SCORED_FROM:].mean(axis=0) for each in records))
            low[method.label].append(np.sqrt(np.square(change[LOW]).sum()))
            focus[method.label].append(abs(change[2]))
            strehl[method.label].append([each.strehl[SCORED_FROM:].mean() for each in records])
    print("\n| method | Zernike modes 5 to 11 [nm rms] | focus [nm] | Strehl ratio, without change |")
    print("|---|---|---|---|")
    for label in low:
        with_change, without = np.mean(strehl[label], axis=0)
        cells = [label, _with_error(low[label]), _with_error(focus[label])]
        print("| " + " | ".join([*cells, f"{with_change:.3f}, {without:.3f}"]) + " |", flush=True)


def _with_error(values: list[Any]) -> str:
    """Return mean and standard error of realisations."""
    return f"{np.mean(values):.1f} ± {np.std(values, ddof=1) / np.sqrt(len(values)):.1f}"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description="Measure what a followed sodium profile gains in a loop.")
    parser.add_argument("--parts", nargs="*", default=["flux", "change"], help="Tables.")
    chosen = parser.parse_args()
    loop, methods = load_loop("lgs_eight_metre"), 1 + len(others())
    steps = {
        "flux": len(FLUXES) * (len(WIDTHS_PX) * TUNING_FRAMES + methods * REALISATIONS * FRAMES),
        "change": 2 * 2 * REALISATIONS * CHANGE_FRAMES,
    }
    total, done = sum(steps[part] for part in chosen.parts), 0
    with progress_bar("Laser guide star", "frames") as show:

        def advance(count: int) -> None:
            nonlocal done
            done += count
            show(done, total)

        if "flux" in chosen.parts:
            flux_tables(loop, advance)
        if "change" in chosen.parts:
            change_table(loop, advance)


if __name__ == "__main__":
    main()
