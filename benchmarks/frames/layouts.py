"""Rates at which `faintspot layout` is right, refuses, doubts, or is wrong without a doubt.

2,000 random arrays (`simulated_arrays`), 160 plain small ones, 220 of up to 15 lenslets across with
aberrations of up to half a pitch, and real frames where they are at hand. Each gets one verdict:

- refused: InputError.
- doubted: `LensletGrid.doubt` is not empty, so that the command prints "doubtful".
- right: the geometry is the true one; the pitch is within 2 %, or 0.15 px, of that of the lattice fitted to
  the true spots; at most 2 % of the lit lenslets (flux from 0.6 of the median on) have no window whose centre
  lies within 0.3 pitch of their spot or node; no lenslet has two; and at most 2 % of the windows, or one,
  belong to no lenslet with at least 0.1 of the median flux. Below a signal-to-noise ratio of 20, where noise
  hides or imitates single dim spots, both limits are 5 %. Lenslets at the edge of the frame, under a
  reflection or dead may have a window or not.
- WRONG: anything else, in silence.

`python -m benchmarks.frames.layouts --help` lists the options: seed, fewer arrays, names of the failures.
"""

import gzip
import os
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.frames.simulated_arrays import (
    DARK,
    LIT,
    Array,
    Points,
    aberrated_array,
    plain_small,
    random_array,
)
from benchmarks.measuring import Row, Table
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.found_layout import FoundLayout, find_layout

NUMBER, SEED = 2000, 1
NEAR, PITCH, PITCH_PX, PART, PART_FAINT, FAINT = 0.3, 0.02, 0.15, 0.02, 0.05, 20.0
"""Limits of a right layout, see above."""
DOUBTED = 0.02  # largest part of the arrays with S/N > 20
VERDICTS = ("right", "doubted", "refused", "WRONG")
_SHARED = Path(os.environ.get("FAINTSPOT_SHARED", Path(__file__).resolve().parents[3] / "shared"))
REAL = {
    "ciao_bench_60x224x224.npz": ("square", 27.48, 64),
    "ciao_bench_edge_60x56x224.npz": ("square", 27.48, 14),
    "mmirs_wfs_0150.fits.gz": ("square", 22.08, 157),
    "auto_wfs_0037_ave.fits.gz": ("square", 30.41, 148),
    "test_newf9.fits.gz": ("hexagonal", 37.14, 145),
    "f9wfs_20200225-205600.fits.gz": ("hexagonal", 35.02, 143),
    "f5_hecto_ref.fits.gz": ("square", 29.67, 284),
}
"""Geometry, pitch and number of lit lenslets, as pictures of the windows bear out, within 1 % and 4."""


def verdict(array: Array) -> tuple[str, str]:
    """Return the verdict on one array, and what is wrong or said."""
    try:
        found = find_layout(array.frame)
    except InputError as error:
        return "refused", str(error)
    faults = _faults(array, found)
    if found.lenslets.doubt:
        return "doubted", f"{found.lenslets.doubt} [{faults or 'right'}]"
    return ("WRONG", faults) if faults else ("right", "")


def _faults(array: Array, found: FoundLayout) -> str:
    """Return what is wrong with a layout, or nothing."""
    grid, layout = found.lenslets, found.layout
    true_pitch, nodes = _true_lattice(array)
    if grid.geometry != array.geometry:
        return f"{grid.geometry}, not {array.geometry}; pitch {grid.pitch_px:.2f}, not {true_pitch:.2f}"
    if abs(grid.pitch_px - true_pitch) > max(PITCH * true_pitch, PITCH_PX):
        return f"pitch {grid.pitch_px:.2f}, not {true_pitch:.2f}"
    middles = (layout.corners[:, ::-1] + 0.5 * (np.array(layout.window[::-1]) - 1)) @ np.array([1, 1j])
    owner = _owners(middles, array.spots, nodes, NEAR * true_pitch)
    windows = np.bincount(owner[owner >= 0], minlength=len(nodes))
    missing = np.count_nonzero(array.lit & (windows == 0))
    where, radius = array.reflection
    extra = np.count_nonzero((owner < 0) & (np.abs(middles - where) > radius)) + int(
        windows[(array.flux < DARK) & ~array.either].sum()
    )
    part = PART if array.signal_to_noise > FAINT else PART_FAINT
    faults = []
    if missing > part * np.count_nonzero(array.lit):
        faults.append(f"{missing} of {np.count_nonzero(array.lit)} missing")
    if extra > max(1, part * len(layout)):
        faults.append(f"{extra} of {len(layout)} windows belong to no lenslet")
    if windows.max() > 1:
        faults.append(f"{np.count_nonzero(windows > 1)} lenslets have two windows")
    return "; ".join(faults)


def _true_lattice(array: Array) -> tuple[float, Points]:
    """Return pitch and nodes of the regular lattice that fits the spots of all open lenslets best."""
    used = array.flux >= LIT
    columns = np.column_stack([np.ones(len(array.nodes)), array.nodes])
    fit = np.linalg.lstsq(columns[used], array.spots[used], rcond=None)[0]
    distance = np.abs(array.nodes[:, None] - array.nodes[:50])
    return float(np.abs(fit[1]) * distance[distance > 0].min()), np.asarray(columns @ fit)


def _owners(middles: Points, spots: Points, nodes: Points, near_px: float) -> NDArray[np.int64]:
    """Return the lenslet whose spot, or else whose node, is nearest to each window; -1 if none is near."""
    owner = np.full(len(middles), -1)
    for at in (nodes, spots):
        distance, nearest = cKDTree(np.column_stack([at.real, at.imag])).query(
            np.column_stack([middles.real, middles.imag])
        )
        owner = np.where(distance < near_px, nearest, owner)
    return owner


def arrays(number: int, seed: int) -> Iterator[tuple[str, Array]]:
    """Yield the arrays with a name for each."""
    for index, array in enumerate(plain_small(min(160, number))):
        yield f"plain {index}", array
    for index in range(min(220, number)):
        yield f"aberrated {index}", aberrated_array(seed, index)
    for index in range(number):
        yield f"random {index}", random_array(seed, index)


def run(number: int = NUMBER, seed: int = SEED, names: bool = False) -> list[Table]:
    """Judge all arrays, and the real frames."""
    counts: dict[str, Counter[str]] = {}
    for done, (name, array) in enumerate(arrays(number, seed)):
        result, why = verdict(array)
        family = name.split()[0]
        kinds = {
            "random": ("all random", *array.kinds),
            "aberrated": ("all aberrated", *(kind for kind in array.kinds if "aberrations" in kind)),
            "plain": ("plain small",),
        }
        for kind in kinds[family]:
            counts.setdefault(kind, Counter())[result] += 1
        if names and result != "right":
            ratio = f"S/N {array.signal_to_noise:.0f}, {len(array.nodes)} lenslets"
            click.echo(f"{result:8} {name}: {why} ({ratio}; {', '.join(array.kinds)})")
        if done % 50 == 49 and sys.stderr.isatty():
            click.echo(f"\r{done + 1} arrays", nl=False, err=True)
    rows = [_row(kind, counts[kind]) for kind in sorted(counts, key=lambda kind: -sum(counts[kind].values()))]
    about = f"Layouts of {number} random arrays (seed {seed}) and of plain small ones"
    return [Table("layouts", about, rows), *_real_frames()]


def _row(kind: str, count: Counter[str]) -> Row:
    total = sum(count.values())
    values = {"number": float(total), **{name: float(count[name]) for name in VERDICTS}}
    unsure = count["doubted"] + count["refused"]
    if kind == "plain small":
        return Row(kind, values, "all right", count["right"] == total)
    if kind == "S/N > 20":
        met = not count["WRONG"] and unsure <= DOUBTED * total
        return Row(kind, values, f"0 wrong, {DOUBTED:.0%} doubted or refused", met)
    return Row(kind, values, "0 wrong", not count["WRONG"])


def _real_frames() -> list[Table]:
    """Return a table of the real frames at hand."""
    rows = []
    for name, (geometry, pitch_px, lenslets) in REAL.items():
        if not (path := _SHARED / "data" / name).exists():
            continue
        grid = find_layout(_frames(path)).lenslets
        right = grid.geometry == geometry and abs(grid.pitch_px / pitch_px - 1) < 0.01
        right &= abs(len(grid.cells) - lenslets) <= 4
        values = {"lenslets": float(len(grid.cells)), "pitch [px]": grid.pitch_px}
        rows.append(Row(name, values, f"{geometry}, {pitch_px} px, {lenslets}", right))
    return [Table("layouts-real", "Layouts of real frames", rows)] if rows else []


def _frames(path: Path) -> NDArray[Any]:
    if path.suffix == ".npz":
        with np.load(path) as archive:
            return np.asarray(archive["frames"])
    from astropy.io import fits

    with gzip.open(path) as file, fits.open(file) as hdus:
        return np.asarray(hdus[0].data, dtype=np.float64)


@click.command()
@click.option("--number", default=NUMBER, show_default=True, help="Number of random arrays.")
@click.option("--quick", is_flag=True, help="100 random arrays.")
@click.option("--seed", default=SEED, show_default=True, help="Seed of the random arrays.")
@click.option("--names", is_flag=True, help="Name each array that is not right.")
def main(number: int, quick: bool, seed: int, names: bool) -> None:
    """Judge layouts of random arrays."""
    from benchmarks.showing import show

    for table in run(100 if quick else number, seed, names):
        show(table)


if __name__ == "__main__":
    main()
