"""Where denoising pays in a closed loop: methods over flux, read noise and turbulence.

    python examples/denoising_map.py FOLDER [--quick]

In each cell every method has its own settings, pixels kept and loop gain, tuned in other turbulence than that
which scores it. Finished units are remembered in FOLDER; the table is printed, and the picture written there.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from faintspot.base.report.texts import with_error
from faintspot.base.statistics import paired_mean
from faintspot.experiments import run_magnitude
from faintspot.experiments.closed_loop.search import QUICK, Search
from faintspot.experiments.closed_loop.verdict import equal_methods
from faintspot.loop.simulation import load_loop

METHODS = "brightest", "tv", "smoothed", "window", "map"
R0_M = 0.071, 0.127  # brightest pixels have Strehl ratios of about 0.2 and 0.6 without noise
FLUXES_E = 10.0, 30.0, 100.0, 300.0, 1000.0
CAMERAS = {f"{noise:g} e-": {"read_noise_e": noise} for noise in (0.1, 1.0, 3.0, 16.0)}
CAMERAS["EMCCD"] = {"read_noise_e": 100.0, "em_gain": 1000.0, "gain_e_per_adu": 20.0, "bits": 16}
RUN = {"frames": 700, "settle_frames": 100, "realisations": 10}
QUICK_RUN = {"frames": 400, "settle_frames": 100, "realisations": 4}
SEARCH = Search(coarse_frames=200, frames=300, realisations=1, finalists=2, climbs=1, rounds=3)


def main() -> None:
    """Measure all cells, print them, and draw the gain of TV."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--quick", action="store_true")
    asked = parser.parse_args()
    asked.folder.mkdir(exist_ok=True)
    fluxes = FLUXES_E[::2] if asked.quick else FLUXES_E
    gains = np.zeros((len(R0_M), len(CAMERAS), len(fluxes)))
    winners = np.full(gains.shape, "-", "U20")
    print("r0, cm | read noise | e- |", " | ".join(METHODS), "| TV minus none | wins")
    for column, r0_m in enumerate(R0_M):
        for row, (name, camera) in enumerate(CAMERAS.items()):
            loop = load_loop("camera_3e").replace("atmosphere", r0_m=r0_m).replace("camera", **camera)
            loop = loop.replace("run", **(QUICK_RUN if asked.quick else RUN))
            place = asked.folder / f"r0-{100 * r0_m:g}cm-{name.replace(' ', '')}"
            search = QUICK if asked.quick else SEARCH
            result = run_magnitude(loop, place, METHODS, fluxes, search=search)
            for flux, photons in enumerate(result.photons):
                gain = paired_mean(result.strehl[1, flux] - result.strehl[0, flux])
                best = equal_methods(result, flux)
                if len(best) == 1:  # above all others beyond the error
                    winners[column, row, flux] = METHODS[best[0]]
                gains[column, row, flux] = gain.value
                strehl = [with_error(paired_mean(runs[flux])) for runs in result.strehl]
                cells = [f"{100 * r0_m:g}", name, f"{photons:g}", *strehl, with_error(gain, sign=True)]
                print(" | ".join([*cells, winners[column, row, flux]]), flush=True)
    draw(gains, winners, fluxes).savefig(asked.folder / "denoising_map.png", dpi=144)


def draw(gains: np.ndarray, winners: np.ndarray, fluxes: tuple[float, ...]) -> Figure:
    """Draw the gain of TV over flux and camera, one panel for each turbulence."""
    figure, reach = Figure((13, 4.6), layout="constrained"), max(0.02, float(np.abs(gains).max()))
    for axes, r0_m, gain, winner in zip(figure.subplots(1, len(R0_M)), R0_M, gains, winners, strict=True):
        drawn = axes.imshow(gain, cmap="RdBu", vmin=-reach, vmax=reach, aspect="auto", origin="lower")
        for (row, column), value in np.ndenumerate(gain):
            axes.text(column, row, f"{value:+.3f}\n{winner[row, column]}", ha="center", va="center")
        axes.set_xticks(range(len(fluxes)), [f"{flux:g}" for flux in fluxes])
        axes.set_yticks(range(len(CAMERAS)), list(CAMERAS))
        axes.set(xlabel="photo-electrons of a sub-aperture in a frame", title=f"r0 {100 * r0_m:g} cm")
    figure.colorbar(drawn, ax=axes, label="Strehl ratio with TV minus without")
    return figure


if __name__ == "__main__":
    main()
