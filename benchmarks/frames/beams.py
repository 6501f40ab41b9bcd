"""Is every lit spot of a beam a sub-aperture of the layout, or named as left out?

Random beams whose flux falls like a Gaussian from their centre, by a factor of 3 to 100 at the radius of the
pupil: centred or not, free, or cut by a disk, an annulus or a straight edge, on square and hexagonal arrays.
A spot is measurable if the Cramér-Rao bound of its position, with its photon noise, the background's and the
read noise, is below 0.1 px. Each measurable spot of which all is in the frame is one of these:

- taken: the window of a sub-aperture contains it;
- named: it is among the lenslets cut by the frame or the spots outside all windows;
- unsaid: neither.

A sub-aperture is false if its lenslet has no flux, or none is near.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.frames import references
from benchmarks.frames.simulated_arrays import RATIOS, Floats, Points, gaussians
from benchmarks.measuring import Row, Table
from faintspot.base.errors import InputError
from faintspot.slopes.sensor.found_layout import FoundLayout, find_layout

NUMBER, SEED = 200, 6000
MEASURABLE_PX, NEAR = 0.1, 0.3  # px; pitches
EDGE_FACTORS, FLUX_E, READ_NOISE_E = (3.0, 100.0), (2e3, 5e5), (1.0, 20.0)
PUPILS = ("free", "disk", "annulus", "one side cut")


@dataclass(frozen=True)
class Beam:
    """A frame, the spots of its lenslets (x + 1j * y), and the bounds of their errors, infinite if dark."""

    frame: Floats
    pitch: float
    spots: Points
    error_px: Floats
    whole: NDArray[np.bool_]
    """Spots that lie in the frame as a whole."""
    kinds: tuple[str, ...]


def beam(seed: int, index: int) -> Beam:
    """Return a random beam."""
    rng = np.random.default_rng([seed, index])
    geometry, pupil = str(rng.choice(list(RATIOS))), PUPILS[index % len(PUPILS)]
    factor, flux_e, noise_e = (_log(rng, *limits) for limits in (EDGE_FACTORS, FLUX_E, READ_NOISE_E))
    across, pitch = rng.uniform(7, 20), rng.uniform(10, 28)
    width, radius = max(pitch * rng.uniform(0.06, 0.13), 0.8), across / 2
    away = _lenslets(rng, across, geometry)
    centre = rng.uniform(0, 0.4) * radius * np.exp(2j * np.pi * rng.random())
    flux = flux_e * np.exp(-np.log(factor) * np.abs((away - centre) / radius) ** 2)
    flux *= _open(rng, pupil, away, radius)
    turn = pitch * np.exp(1j * rng.uniform(0, 2 * np.pi))
    size = round(pitch * (across + rng.uniform(-1, 3)))
    middle = (size - 1) / 2 * (1 + 1j)
    shifts = rng.uniform(-0.02, 0.02) * away + rng.uniform(0, 0.02) * _normal(rng, len(away))
    spots = middle + turn * (away + shifts)
    background = rng.uniform(0, 30)
    image = gaussians((size, size), spots, flux / (2 * np.pi * width**2), width) + background
    frame = 100 + rng.poisson(image) + rng.normal(0, noise_e, image.shape)
    depth = np.minimum.reduce([spots.real, spots.imag, size - 1 - spots.real, size - 1 - spots.imag])
    error = np.array([_bound_px(value, width, background + noise_e**2) for value in flux])
    steep = "edge factor 3 to 10" if factor < 10 else "10 to 30" if factor < 30 else "30 to 100"
    whole = depth > max(2 * width, 0.15 * pitch)
    return Beam(frame, pitch, spots, error, whole, ("all", geometry, pupil, steep))


def _log(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _normal(rng: np.random.Generator, count: int) -> Points:
    return np.asarray(rng.standard_normal(count) + 1j * rng.standard_normal(count))


def _lenslets(rng: np.random.Generator, across: float, geometry: str) -> Points:
    """Return the lenslets around the middle in pitches, farther out than the corners of the frame."""
    count = np.arange(-2 * int(across), 2 * int(across) + 1)
    cells = (count + count[:, None] * RATIOS[geometry]).ravel() + complex(*rng.uniform(-0.5, 0.5, 2))
    return np.asarray(cells[np.abs(cells) < 0.75 * across + 3])


def _open(rng: np.random.Generator, pupil: str, away: Points, radius: float) -> Floats:
    """Return the part of each lenslet that is within the pupil."""
    inner, cut = rng.uniform(0.15, 0.4) * radius, rng.uniform(0.1, 0.7) * radius
    turn = np.exp(2j * np.pi * rng.random())
    inside: dict[str, Callable[[Points], NDArray[np.bool_]]] = {
        "free": lambda at: np.ones(at.shape, bool),
        "disk": lambda at: np.abs(at) < radius,
        "annulus": lambda at: (np.abs(at) < radius) & (np.abs(at) > inner),
        "one side cut": lambda at: (at * turn).real < cut,
    }
    step = (np.arange(5) - 2) / 5
    return np.asarray(inside[pupil](away[:, None] + (step + 1j * step[:, None]).ravel()).mean(axis=1))


def _bound_px(flux_e: float, width_px: float, variance: float) -> float:
    """Return the Cramér-Rao bound of a spot's position along an axis, infinite without flux."""
    if flux_e <= 0:
        return np.inf
    y, x = np.mgrid[-20:21, -20:21]
    spot = flux_e / (2 * np.pi * width_px**2) * np.exp(-0.5 * (x**2 + y**2) / width_px**2)
    return float(np.sum((x / width_px**2 * spot) ** 2 / (spot + variance)) ** -0.5)


def judged(truth: Beam, found: FoundLayout) -> dict[str, float]:
    """Count the measurable spots by what became of them, and the false sub-apertures."""
    layout, spots = found.layout, np.column_stack([truth.spots.real, truth.spots.imag])
    middles = layout.corners[:, ::-1] + 0.5 * (np.array(layout.window[::-1]) - 1)
    off, nearest = cKDTree(middles).query(spots, p=np.inf)
    taken = off <= 0.5 * max(layout.window)
    others = np.concatenate([found.cut, found.outside, np.full((1, 2), -1e9)])
    named = cKDTree(others).query(spots)[0] < NEAR * truth.pitch
    measurable = truth.whole & (truth.error_px < MEASURABLE_PX)
    lit = np.isfinite(truth.error_px)
    parts = {"taken": taken, "named": ~taken & named, "unsaid": ~taken & ~named}
    return {
        "measurable": float(measurable.sum()),
        **{name: float((measurable & part).sum()) for name, part in parts.items()},
        "false": float(len(layout) - len(np.unique(nearest[taken & lit]))),
    }


def run(number: int = NUMBER, seed: int = SEED) -> list[Table]:
    """Judge the layouts of random beams, and differences from references of another light."""
    sums: dict[str, dict[str, float]] = {}
    for index in range(number):
        truth = beam(seed, index)
        try:
            found = find_layout(truth.frame)
        except InputError:
            counts = {"refused": 1.0}
        else:
            counts = {**judged(truth, found), "doubted": float(bool(found.lenslets.doubt))}
        for kind in truth.kinds:
            total = sums.setdefault(kind, {})
            for name, value in {"beams": 1.0, **counts}.items():
                total[name] = total.get(name, 0.0) + value
    names = ("beams", "measurable", "taken", "named", "unsaid", "false", "doubted", "refused")
    rows = [
        Row(kind, {name: total.get(name, 0.0) for name in names}, "none unsaid or false", _met(total))
        for kind, total in sums.items()
    ]
    return [Table("beams", f"Lit spots of {number} random beams (seed {seed})", rows), references.table()]


def _met(total: dict[str, float]) -> bool:
    return not (total.get("unsaid") or total.get("false"))
