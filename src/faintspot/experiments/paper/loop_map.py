"""Map of closed-loop gains by denoising: methods over flux, read noise and turbulence."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.report.page import FigureWithData, Report, Section, Table
from faintspot.base.report.plots import Labels, Picture
from faintspot.base.report.texts import NOTHING, Texts, with_error
from faintspot.base.statistics import Estimate, paired_mean
from faintspot.experiments.closed_loop.magnitude import run_magnitude
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.closed_loop.search import QUICK, Search
from faintspot.experiments.closed_loop.verdict import equal_methods
from faintspot.experiments.methods import NO_TV, SMOOTHING, TV, label_of
from faintspot.experiments.running import WorkerPool, in_stages
from faintspot.loop.simulation.configuration import LoopConfiguration, load_loop
from faintspot.loop.simulation.record import make_folder
from faintspot.slopes.estimators.built_in.maximum_likelihood import MaximumAPosteriori
from faintspot.slopes.estimators.built_in.window import Window

METHODS = NO_TV, TV, SMOOTHING, Window.name, MaximumAPosteriori.name
R0_M = 0.071, 0.127
"""Turbulence with which brightest pixels have Strehl ratios of about 0.2 and 0.6 without noise."""
FLUXES_E = 10.0, 30.0, 100.0, 300.0, 1000.0
_QUICK_FLUXES_E = FLUXES_E[::2]
_EMCCD = "EMCCD"
CAMERAS: Mapping[str, Mapping[str, Any]] = {
    **{f"{noise:g} e-": {"read_noise_e": noise} for noise in (0.1, 1.0, 3.0, 16.0)},
    _EMCCD: {"read_noise_e": 100.0, "em_gain": 1000.0, "gain_e_per_adu": 20.0, "bits": 16},
}
"""Cameras by name."""
_TELESCOPE = "camera_3e"
_SEARCH = Search(coarse_frames=200, frames=300, realisations=1, finalists=2, climbs=1, rounds=3)
_RUN = {"frames": 700, "settle_frames": 100, "realisations": 10}
_QUICK_RUN = {"frames": 400, "settle_frames": 100, "realisations": 4}
_TEXT = Texts("faintspot.experiments")
_IN_CELL: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 10}
_IN_CELL |= {"bbox": {"facecolor": "white", "alpha": 0.7, "lw": 0}}


@dataclass(frozen=True)
class LoopCell:
    """Methods with one camera, flux and turbulence."""

    r0_m: float
    camera: str
    photons: float
    strehl: Mapping[str, Estimate]
    """Strehl ratio of each method, over realisations."""
    gain: Estimate
    """Strehl ratio with TV less that without, paired."""
    winner: str
    """The method that is above all others beyond the error; "" for none."""


def run_loop_map(
    folder: str | Path, *, quick: bool = False, pool: WorkerPool | None = None, overwrite: bool = False
) -> list[LoopCell]:
    """Measure with which flux, read noise and turbulence denoising raises the Strehl ratio.

    In each cell every method has its own settings, pixels kept and loop gain, tuned in other turbulence than
    that which scores it, see `run_magnitude`. Finished units are remembered in the folder.

    Parameters
    ----------
    folder : path
    quick : bool
        Fewer fluxes and realisations, a coarse search: a third of the time.
    pool : WorkerPool, optional
        Default: processes on this machine.
    overwrite : bool
        Whether another experiment in the folder is replaced.

    Raises
    ------
    InputError
        For a folder that holds another experiment.
    MissingExtraError
        When HCIPy is not installed.
    """
    folder = make_folder(folder)
    columns = [(r0, camera) for r0 in R0_M for camera in CAMERAS]
    pools = in_stages(pool or WorkerPool(), [1000] * len(columns))
    fluxes, search = (_QUICK_FLUXES_E, QUICK) if quick else (FLUXES_E, _SEARCH)
    cells = []
    for (r0, camera), part in zip(columns, pools, strict=True):
        loop = _loop(r0, CAMERAS[camera], quick)
        place = folder / f"r0-{100 * r0:g}cm-{camera.replace(' ', '')}"
        result = run_magnitude(loop, place, METHODS, fluxes, search=search, pool=part, overwrite=overwrite)
        cells += cells_of(result, r0, camera)
    return cells


def _loop(r0_m: float, camera: Mapping[str, Any], quick: bool) -> LoopConfiguration:
    loop = load_loop(_TELESCOPE).replace("atmosphere", r0_m=r0_m).replace("camera", **camera)
    return loop.replace("run", **(_QUICK_RUN if quick else _RUN))


def cells_of(result: MagnitudeResult, r0_m: float, camera: str) -> list[LoopCell]:
    """Return the cells of one camera and turbulence, from faint to bright."""
    of_tv, without = (result.strehl[result.names.index(name)] for name in (TV, NO_TV))
    cells = []
    for flux, photons in enumerate(result.photons):
        best = equal_methods(result, flux)
        strehl = {
            name: paired_mean(runs[flux]) for name, runs in zip(result.names, result.strehl, strict=True)
        }
        gain = paired_mean(of_tv[flux] - without[flux])
        winner = result.names[best[0]] if len(best) == 1 else ""
        cells.append(LoopCell(r0_m, camera, float(photons), strehl, gain, winner))
    return cells


def loop_map_page(cells: list[LoopCell]) -> Report:
    """Return the page with the picture and the table of the cells."""
    return Report(_TEXT["loop_map.title"], {}, [loop_map_section(cells)])


def loop_map_section(cells: list[LoopCell]) -> Section:
    """Return the section with the picture and the table of the cells, and how often each method wins."""
    counts = {name: sum(cell.winner == name for cell in cells) for name in ("", *METHODS)}
    wins = ", ".join(f"{label_of(name)} in {count}" for name, count in counts.items() if name and count)
    higher, lower = (sum(cell.gain.decided == sign for cell in cells) for sign in (1, -1))
    gains = [cell.gain.value for cell in cells]
    return _TEXT.section(
        "loop_map",
        _figure(cells),
        _table(cells),
        cells=len(cells),
        higher=higher,
        lower=lower,
        largest=max(gains),
        smallest=min(gains),
        wins=wins or "no method",
        none=counts[""],
    )


def _table(cells: list[LoopCell]) -> Table:
    rows = [
        [f"{100 * cell.r0_m:g}", cell.camera, f"{cell.photons:g}"]
        + [with_error(cell.strehl[name]) for name in METHODS]
        + [with_error(cell.gain, sign=True), label_of(cell.winner) if cell.winner else NOTHING]
        for cell in cells
    ]
    return _TEXT.table("loop_map.table", rows)


def _figure(cells: list[LoopCell]) -> FigureWithData:
    """Draw the gain of TV over flux and camera, one panel for each turbulence."""
    cameras, fluxes = list({cell.camera: 0 for cell in cells}), list({cell.photons: 0 for cell in cells})
    reach = max(0.02, *(abs(cell.gain.value) for cell in cells))
    style = {"cmap": "RdBu", "vmin": -reach, "vmax": reach, "aspect": "auto"}
    axes = "photo-electrons of a sub-aperture in a frame", "read noise"
    pictures = []
    for r0 in R0_M:
        gains, words = np.full((len(cameras), len(fluxes)), np.nan), dict[tuple[int, int], str]()
        for cell in (cell for cell in cells if cell.r0_m == r0):
            column, row = fluxes.index(cell.photons), cameras.index(cell.camera)
            gains[row, column] = cell.gain.value
            words[column, row] = f"{cell.gain.value:+.3f}\n{cell.winner or NOTHING}"
        unit = "Strehl ratio with TV minus without" if r0 == R0_M[-1] else ""
        marks = [Labels(list(words), list(words.values()), _IN_CELL)]
        names: dict[str, Any] = {"x_names": [f"{flux:g}" for flux in fluxes], "y_names": cameras}
        pictures.append(Picture(gains, unit, f"r0 {100 * r0:g} cm", *axes, style, marks, **names))
    return _TEXT.figure("loop_map", [pictures], 4.6)
