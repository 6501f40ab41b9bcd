"""Choose each candidate's settings on training spots, score it on others, and time it."""

from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table, best, interleaved, pinned, ratio
from benchmarks.yardstick.candidates import (
    BM3D,
    BRIGHT_E,
    SEARCH_PX,
    Denoise,
    Images,
    Known,
    Measure,
    centroids,
    denoisers,
    estimators,
)
from benchmarks.yardstick.network import trained
from benchmarks.yardstick.spots import BENCH, FAMILIES, Floats, UnitSpots
from faintspot.slopes.training.psf_learning import learn_psf_from_images

CELLS = ((10, 0.1), (100, 0.1), (1000, 0.1), (100, 1), (100, 3), (300, 16))
"""Flux and read noise, e-. Left out: where no unbiased estimator finds a spot to a quarter of a pixel."""
_STEPS = 2000
_TRAIN, _SCORE = (1, 700), (2, 1500)
"""Seed and number of spots."""
_FEW, _FEW_FAMILIES = {BM3D: (256, 576)}, ("ours",)
"""Spots of training and scoring where they are fewer, and their origin: it takes 7000 times as long as TV."""
_TIMED, _QUICK = 100, 3


@dataclass(frozen=True)
class Choice:
    """A candidate with the settings that served it best on training spots."""

    rms_px: float
    settings: str
    measure: Measure
    gain: float
    spots: int
    """Number of training spots."""


@dataclass(frozen=True)
class Efficiency:
    """Photon efficiency of a choice on other spots, and its standard error."""

    value: float
    error: float
    choice: Choice


def errors_of(estimate: Floats, spots: UnitSpots, gain: float | None = None) -> tuple[float, Floats]:
    """Return the gain, measured where it is not given, and errors (n, 2) about each lenslet's mean [px]."""
    limited, true = np.clip(estimate, -SEARCH_PX, SEARCH_PX), spots.position[: len(estimate)]
    found, true = (_about_means(values, spots.lenslet[: len(estimate)]) for values in (limited, true))
    if gain is None:
        gain = max(float((found * true).sum() / np.square(true).sum()), 1e-3)
    return gain, found / gain - true


def _about_means(values: Floats, lenslet: NDArray[np.int64]) -> Floats:
    """Take off the mean of each lenslet that has several; the variance stays what it was on average."""
    counts = np.bincount(lenslet)[lenslet, None]
    sums = np.stack([np.bincount(lenslet, column) for column in values.T], axis=1)[lenslet]
    centred = (values - sums / counts) * np.sqrt(counts / np.maximum(counts - 1, 1))
    return np.asarray(centred[counts[:, 0] > 1])


def _choice(choices: dict[str, Measure], images: Images, spots: UnitSpots) -> Choice:
    tried = []
    for name, measure in choices.items():
        gain, errors = errors_of(measure(images), spots)
        tried.append(Choice(float(np.sqrt(np.square(errors).mean())), name, measure, gain, len(images)))
    return min(tried, key=lambda choice: choice.rms_px)


def _denoised_choice(
    ways: dict[str, Denoise], after: dict[str, Measure], images: Images, spots: UnitSpots
) -> Choice:
    """Choose the way to denoise with three centroids, then the centroid among all."""
    quick = dict(list(after.items())[:_QUICK])
    results = {way: denoise(images) for way, denoise in ways.items()}
    way = min(results, key=lambda way: _choice(quick, results[way], spots).rms_px)
    found = _choice(after, results[way], spots)
    both = f"{way}; {found.settings}".strip("; ")
    return replace(found, settings=both, measure=lambda part: found.measure(ways[way](part)))


Efficiencies = dict[tuple[float, float], dict[str, Efficiency]]
"""Of all candidates, by flux and read noise."""


class Judge:
    """Training and scoring spots of one origin."""

    def __init__(self, family: str, steps: int = _STEPS) -> None:
        self.train, self._score = (FAMILIES[family](number, seed) for seed, number in (_TRAIN, _SCORE))
        bright = self.train.noisy(BRIGHT_E, 1.0, 1)
        learnt = learn_psf_from_images(
            bright,
            fs.Calibration(dark=0.0, read_noise_e=1.0),
            search_range_px=SEARCH_PX,
            rng=np.random.default_rng(1),
        )
        self._known = Known(learnt, trained(self.train, steps, 1), self.train.images.shape[1:])
        network = self._known.network
        self._slow = family in _FEW_FAMILIES
        self.note = f"{family}: network trained on {network.images} images in {network.seconds:.0f} s"

    def cell(self, flux_e: float, read_noise_e: float) -> dict[str, Efficiency]:
        """Return the scores of all candidates at a flux and a read noise."""
        known = replace(self._known, flux_e=flux_e, read_noise_e=read_noise_e)
        images, others = (
            spots.noisy(flux_e, read_noise_e, seed) - np.float32(known.background_e)
            for spots, seed in ((self.train, 11), (self._score, 12))
        )
        after = centroids(known)
        chosen = {name: _choice(choices, images, self.train) for name, choices in estimators(known).items()}
        for name, ways in denoisers(known, slow=self._slow).items():
            part = images[: _FEW[name][0]] if name in _FEW else images
            chosen[name] = _denoised_choice(ways, after, part, self.train)
        fluxes = np.geomspace(flux_e / 300, 2 * flux_e, 24)
        bounds = [self._score.bound_px(flux, read_noise_e) for flux in fluxes]
        scores = {}
        for name, choice in chosen.items():
            part = others[: _FEW[name][1]] if name in _FEW else others
            _, errors = errors_of(choice.measure(part), self._score, choice.gain)
            squares = np.square(errors).mean(axis=1)
            of_gain = choice.rms_px / (self.train.position.std() * np.sqrt(2 * choice.spots))
            relative = np.hypot(squares.std() / squares.mean() / np.sqrt(4 * len(squares)), of_gain)
            at = np.sqrt(squares.mean()) * np.array([1, 1 - relative, 1 + relative])
            needed = np.exp(np.interp(-np.log(at), -np.log(bounds), np.log(fluxes))) / flux_e
            scores[name] = Efficiency(float(needed[0]), float(needed[1] - needed[2]) / 2, choice)
        return scores

    def timed(self, scores: dict[str, Efficiency], flux_e: float, read_noise_e: float) -> Table:
        """Time the chosen settings of all candidates in one cell."""
        images = self._score.noisy(flux_e, read_noise_e, 12)[:_TIMED]
        seconds = interleaved({name: partial(score.choice.measure, images) for name, score in scores.items()})
        rows = []
        for name in scores:
            of_tv = ratio(seconds, name, "tv", ("of TV", "median"))
            values = {"us per sub-aperture": 1e6 * best(seconds, name) / len(images), **of_tv.values}
            rows.append(Row(name, values, spread={} if name == "tv" else of_tv.spread, better="lower"))
        return Table("yardstick_times", f"Times at {flux_e:g} e-, {read_noise_e:g} e-", rows)


def run(families: Any = tuple(FAMILIES), cells: Any = CELLS, steps: int = _STEPS) -> list[Table]:
    """Judge all candidates on the spots of all origins."""
    notes = [f"{name} is not installed: left out" for name in ("skimage", "bm3d") if not find_spec(name)]
    scores: dict[str, Efficiencies] = {}
    times: list[Table] = []
    with pinned():
        for family in families:
            if reason := _unavailable(family):
                notes.append(f"spots of {family} are left out: {reason}")
                continue
            judge = Judge(family, steps)
            notes.append(judge.note)
            scores[family] = {cell: judge.cell(*cell) for cell in cells}
            if not times:
                cell = cells[len(cells) // 2]
                times.append(judge.timed(scores[family][cell], *cell))
    return [_means(scores, notes), *(_cells(*item) for item in scores.items()), *times]


def _unavailable(family: str) -> str:
    """Return why there are no spots of an origin, or nothing."""
    if family == "real":
        return "" if BENCH.exists() else f"no {BENCH.name}"
    module = {"HCIPy": "hcipy", "OOPAO": "OOPAO"}.get(family, "numpy")
    return "" if find_spec(module) else f"{module} is not installed"


def _means(scores: dict[str, Efficiencies], notes: list[str]) -> Table:
    """Return geometric means over the cells of each origin."""
    rows = []
    for name in next(iter(next(iter(scores.values())).values())):
        values, spreads = {}, {}
        for family, cells in scores.items():
            found = [cell[name] for cell in cells.values() if name in cell]
            if found:
                relative = np.array([score.error / score.value for score in found])
                values[family] = float(np.exp(np.mean([np.log(score.value) for score in found])))
                spreads[family] = float(np.sqrt(np.square(relative).sum()) / len(found))
        errors = {f"± {family}": values[family] * spreads[family] for family in values}
        rows.append(Row(name, values | errors, spread=spreads, better="higher"))
    return Table("yardstick", "Photon efficiency, geometric mean over the cells", rows, notes)


def _cells(family: str, cells: Efficiencies) -> Table:
    titles = {cell: f"{cell[0]:g} e-, {cell[1]:g} e-" for cell in cells}
    rows = []
    for name in next(iter(cells.values())):
        values = {titles[cell]: found[name].value for cell, found in cells.items()}
        spreads = {titles[cell]: found[name].error / found[name].value for cell, found in cells.items()}
        rows.append(Row(name, values, spread=spreads, better="higher"))
    notes = [
        f"{titles[cell]}, {name}: {score.choice.settings}"
        for cell, found in cells.items()
        for name, score in found.items()
        if score.choice.settings
    ]
    return Table(
        f"yardstick_{family}", f"Photon efficiency by flux and read noise; spots: {family}", rows, notes
    )
