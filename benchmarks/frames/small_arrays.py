"""Is `faintspot layout` right about sensors of 1 x 1 to 4 x 4 sub-apertures, and are its hints?

Random arrays, turned by any angle: spots whose FWHM is a tenth to a half of the pitch, with a
signal-to-noise ratio of 5 to 100 in a matched filter; displaced by seeing, of unequal flux, with a dead
lenslet, faint ghosts, a background, hot pixels. Quad cells are one spot on four blocks of pixels, with and
without gaps. Each is:

- right: as many sub-apertures as lit lenslets, each with its spot within 0.3 pitch of the middle of its
  window; a pitch within 2 % or 0.15 px of the lattice fitted to the true spots;
- doubted: right, and doubtful;
- hinted: refused or doubtful and not right, but right with what the message names: `--grid`, `--pitch-px`,
  `--angle-deg`, or 25 times as many frames where it asks for more;
- lost: refused or doubtful, and no better with the hint;
- WRONG: not right, in silence, also with the hint.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.frames.simulated_arrays import Floats, Points, gaussians
from benchmarks.measuring import Row, Table
from faintspot.base.errors import InputError
from faintspot.slopes.recorded.first_layout import found_in
from faintspot.slopes.sensor.found_layout import FoundLayout

NUMBER, SEED = 1000, 9000
NEAR, PITCH, PITCH_PX, FEWEST_RIGHT = 0.3, 0.02, 0.15, 0.98
VERDICTS = ("right", "doubted", "hinted", "lost", "WRONG")
KINDS = {"1 x 1": 0.15, "2 x 2": 0.35, "3 x 3": 0.15, "4 x 4": 0.1, "others": 0.1, "quad cells": 0.15}
_FWHM = 2.3548  # of a Gaussian, in standard deviations
_MORE = 5.0  # times less noise of the mean of more frames


@dataclass(frozen=True)
class SmallArray:
    """Image without noise, its noise, and the spots of lit lenslets, x + 1j * y [px]."""

    image: Floats
    noise: Floats
    hot: Floats
    grid: tuple[int, int]
    pitch: float
    angle_deg: float
    spots: Points
    nodes: Points
    kinds: tuple[str, ...]

    def found(self, less_noise: float = 1.0, **hints: Any) -> Any:
        """Return the layout found in the frame."""
        return found_in(self.image + self.noise / less_noise + self.hot, **hints)


def small_array(seed: int, index: int) -> SmallArray:
    """Return a random array."""
    rng = np.random.default_rng([seed, index])
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    return _quad_cell(rng) if kind == "quad cells" else _array(rng, kind)


def _array(rng: np.random.Generator, kind: str) -> SmallArray:
    grid = (int(kind[0]), int(kind[0])) if kind != "others" else _other_shape(rng)
    pitch, fill = _log(rng, 12, 64), rng.uniform(0.1, 0.5)
    width = max(fill * pitch, 1.6) / _FWHM
    rows, columns = np.indices(grid).reshape(2, -1)
    away = columns - columns.mean() + 1j * (rows - rows.mean())
    angle = rng.uniform(-45, 45)
    at = pitch * np.exp(1j * np.radians(angle)) * away
    margin = pitch * rng.uniform(0.6, 1.5 if rng.random() < 0.5 else 6.0, (2, 2))
    low, high = np.array([at.real.min(), at.imag.min()]), np.array([at.real.max(), at.imag.max()])
    shape = tuple(np.rint(high - low + margin.sum(axis=0)).astype(int)[::-1])
    nodes = at + (margin[0] - low) @ (1, 1j)
    jitter = rng.uniform(0, 0.04) * pitch
    spots = nodes + jitter * (rng.standard_normal(len(at)) + 1j * rng.standard_normal(len(at)))
    flux, lit, kinds = np.ones(len(at)), np.ones(len(at), bool), [kind]
    if rng.random() < 0.3:
        kinds.append("unequal flux")
        flux = rng.uniform(0.4, 1.0, len(at))
    if rng.random() < 0.15 and min(grid) > 1:
        kinds.append("dead lenslet")
        lit[rng.integers(len(at))] = False
    image = gaussians(shape, spots[lit], flux[lit], width)
    if rng.random() < 0.2:
        kinds.append("ghosts")
        share, step = rng.uniform(0.02, 0.1), pitch * rng.uniform(1.5, 5) * np.exp(2j * np.pi * rng.random())
        image += gaussians(shape, spots[lit] + step, share * flux[lit], 0.7 * width)
    y, x = np.indices(shape) / max(shape)
    image = image + rng.uniform(0.6, 2) + rng.uniform(-0.3, 0.3) * x + rng.uniform(-0.3, 0.3) * y
    ratio = _log(rng, 5, 100)
    kinds.append("S/N > 20" if ratio > 20 else "S/N 10 to 20" if ratio > 10 else "S/N 5 to 10")
    noise = _noise(rng, image, width * np.sqrt(np.pi) / ratio)
    hot = np.zeros(shape)
    if rng.random() < 0.2:
        kinds.append("hot pixels")
        hot.ravel()[rng.integers(0, hot.size, 5)] = rng.uniform(0.3, 3.0, 5)
    return SmallArray(image, noise, hot, grid, pitch, angle, spots[lit], nodes[lit], ("all", *kinds))


def _quad_cell(rng: np.random.Generator) -> SmallArray:
    """Return one spot on four blocks of 1 to 12 pixels on a side, with a gap up to half of the spot."""
    block = int(rng.integers(1, 13))
    fwhm = 2 * block * rng.uniform(0.15, 0.5)
    gap = int(rng.integers(0, int(0.5 * fwhm) + 1)) if rng.random() < 0.6 else 0
    side = 2 * block + gap
    width = np.hypot(fwhm, 1.0) / _FWHM
    at = (side - 1) / 2 * (1 + 1j) + 0.1 * side * complex(*rng.uniform(-1, 1, 2))
    image = gaussians((side, side), np.array([at]), 1.0, width) + rng.uniform(0, 1)
    ratio = _log(rng, 5, 100)
    noise = _noise(rng, image, width * np.sqrt(np.pi) / ratio)
    dark = slice(block, block + gap)
    for array in (image, noise) if rng.random() < 0.5 else (image,):  # pixels that are not there, or opaque
        array[dark] = array[:, dark] = 0.0
    kinds = ("all", "quad cells", "with a gap" if gap else "without a gap")
    spot = np.array([at])
    return SmallArray(image, noise, np.zeros_like(image), (1, 1), float(side), 0.0, spot, spot, kinds)


def _other_shape(rng: np.random.Generator) -> tuple[int, int]:
    rows, columns = (int(n) for n in rng.integers(1, 5, 2))
    return (rows, columns) if rows != columns else (rows, rows % 4 + 1)


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _noise(rng: np.random.Generator, image: Floats, level: float) -> Floats:
    """Return noise of this level, of which a part is photon noise."""
    photons = rng.uniform(0, 1) * (rng.random() < 0.5)
    light = np.clip(image, 0, None) / (1 + np.median(image))
    return np.asarray(level * np.sqrt(1 - photons + photons * light) * rng.standard_normal(image.shape))


def verdict(array: SmallArray) -> tuple[str, str]:
    """Return the verdict on one array, and what is wrong or said."""
    faults, said = _judged(array)
    if not said:
        return ("WRONG", faults) if faults else ("right", "")
    if not faults:
        return "doubted", said
    hints = {
        name: value
        for word, name, value in (
            ("--grid", "grid", array.grid),
            ("pitch", "pitch_px", array.pitch),
            ("angle", "angle_deg", array.angle_deg),
            ("average more", "less_noise", _MORE),
        )
        if word in said
    }
    more = {"less_noise": hints.pop("less_noise")} if "less_noise" in hints else {}
    tried = [{**more, name: value} for name, value in hints.items()] + ([more] if more else [])
    results = [_judged(array, **hint) for hint in tried]
    if any(not faults for faults, _ in results):
        return "hinted", f"{said} [{faults}]"
    if any(faults and not said for faults, said in results):
        return "WRONG", f"with a hint: {said} [{faults}] {results}"
    return "lost", f"{said} [{faults}] {results}"


def _judged(array: SmallArray, **hints: Any) -> tuple[str, str]:
    """Return what is wrong with a layout, and what is said."""
    try:
        found = array.found(**hints)
    except InputError as error:
        return "refused", str(error)
    return _faults(array, found, "pitch_px" in hints), "; ".join(found.doubts)


def _faults(array: SmallArray, found: Any, stated: bool) -> str:
    layout, count = found.layout, len(array.spots)
    if len(layout) != count:
        return f"{len(layout)} sub-apertures, not {count}"
    middles = layout.corners[:, ::-1] + 0.5 * (np.array(layout.window[::-1]) - 1)
    near = NEAR * array.pitch
    distance, nearest = cKDTree(middles).query(np.column_stack([array.spots.real, array.spots.imag]))
    if distance.max() > near or len(set(nearest)) < count:
        return f"a spot {distance.max():.1f} px from its window, pitch {array.pitch:.1f}"
    if count == 1 or stated or not isinstance(found, FoundLayout):
        return ""
    away = array.nodes - array.nodes.mean()
    true = array.pitch * abs(np.vdot(away, array.spots)) / np.vdot(away, away).real
    if abs(layout.pitch_px - true) > max(PITCH * true, PITCH_PX):
        return f"pitch {layout.pitch_px:.2f}, not {true:.2f}"
    return ""


def run(number: int = NUMBER, seed: int = SEED, names: bool = False) -> list[Table]:
    """Judge the layouts of random small arrays."""
    sums: dict[str, dict[str, float]] = {}
    for index in range(number):
        array = small_array(seed, index)
        result, why = verdict(array)
        if names and result != "right":
            print(f"{result:8} {index}: {why} ({', '.join(array.kinds[1:])})")
        for kind in array.kinds:
            total = sums.setdefault(kind, dict.fromkeys(("number", *VERDICTS), 0.0))
            total["number"] += 1
            total[result] += 1
    rows = [
        Row(kind, total, f"{FEWEST_RIGHT:.0%} right or hinted, 0 wrong", _met(total))
        for kind, total in sums.items()
    ]
    return [Table("small-arrays", f"Layouts of {number} random small arrays (seed {seed})", rows)]


def _met(total: dict[str, float]) -> bool:
    return not total["WRONG"] and total["lost"] <= (1 - FEWEST_RIGHT) * total["number"]
