"""A cell of a study against the straightforward version of the same loop, on one processor.

Both simulate spots of 60 e- on 16 x 16 pixels with 1 e- of read noise, measure them without denoising and
with five strengths, and return R for every number of kept pixels, 1 to 255. The straightforward version is
what one writes first: one realisation after the other, scikit-image's `denoise_tv_chambolle` with its default
settings, and for every k a threshold from the sorted pixels and a centre of gravity in NumPy. It is handed
the weights that faintspot's solutions have, since it solves no constrained problem; the time to find them is
not counted against it. Both are first shown to give the same R.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from benchmarks.measuring import Row, Table, best, interleaved, pinned, ratio
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.gravity import KeepingBrightest
from faintspot.estimators.total_variation import TotalVariation
from faintspot.experiments.cell import measure_cell, realisations
from faintspot.experiments.cell_arms import Block, error_sums
from faintspot.experiments.specification import StudySpecification
from faintspot.experiments.sweep import Sweep

STRENGTHS = (0.3, 0.5, 0.7, 0.85, 1.0)
SPECIFICATION = StudySpecification("benchmark", [Sweep("a", flux_e=60, read_noise_e=1)], realisations=2000)
CELL = SPECIFICATION.cells()[0]
ARMS: dict[str, list[KeepingBrightest]] = {
    "plain": [BrightestPixels()],
    "tv": [TotalVariation(noise_std=factor * CELL.pixel_noise_e) for factor in STRENGTHS],
}
RIVAL_REALISATIONS = 2  # takes one after the other: so many tell the time of one
SAME_PLAIN_PX = 1e-5  # R of the same images; single precision in one of the two
SAME_TV_PX = 0.02  # slow to converge near the largest feasible strength, where scikit-image stops earlier
TARGET = 100.0

Floats = NDArray[np.float64]


def ours(count: int) -> dict[str, Floats]:
    """Return R of both arms, (candidates, k)."""
    return mean_errors(realisations(CELL, count, np.random.default_rng(1)))


def mean_errors(blocks: Iterable[Block]) -> dict[str, Floats]:
    """Return R of both arms of some images, (candidates, k)."""
    count, sums = 0, dict.fromkeys(ARMS, np.zeros(()))
    for images, truth in blocks:
        count += len(images)
        sums = {arm: sums[arm] + error_sums(each, images, truth) for arm, each in ARMS.items()}
    return {arm: total / count for arm, total in sums.items()}


def errors_of_every_k(image: Floats, truth: Floats) -> Floats:
    """Return (|dx| + |dy|) / 2 for k = 1 to 255: threshold and centre of gravity, k after k."""
    axis = np.arange(image.shape[0]) - (image.shape[0] - 1) / 2
    ranked = np.sort(image, axis=None)[::-1]
    errors = np.empty(image.size - 1)
    for k in range(1, image.size):
        left = np.maximum(image - ranked[k], 0.0)
        total = left.sum()
        x, y = ((left.sum(axis=0) @ axis, left.sum(axis=1) @ axis) / total) if total > 0 else (0.0, 0.0)
        errors[k - 1] = (abs(x - truth[0]) + abs(y - truth[1])) / 2
    return errors


def straightforward(images: NDArray[np.float32], truth: Floats, weights: Floats) -> dict[str, Floats]:
    """Return R of both arms by the straightforward loop; weights (images, strengths)."""
    from skimage.restoration import denoise_tv_chambolle

    plain, tv = [], []
    for image, position, chosen in zip(images, truth, weights, strict=True):
        plain.append([errors_of_every_k(image.astype(float), position)])
        denoised = [denoise_tv_chambolle(image, weight=weight) for weight in chosen]
        tv.append([errors_of_every_k(result.astype(float), position) for result in denoised])
    return {"plain": np.mean(plain, axis=0), "tv": np.mean(tv, axis=0)}


def simulate_one_by_one(count: int, rng: np.random.Generator) -> tuple[Any, Floats]:
    """Return noisy images and positions, one realisation after the other."""
    truth = rng.uniform(-1.0, 1.0, (count, 2))
    whole = CELL.flux_e / fs.simulate.spots([[0.0, 0.0]]).sum()
    images = []
    for position in truth:
        mean = fs.simulate.spots(position[None], flux_e=whole)[0]
        images.append(rng.poisson(mean) + rng.normal(0.0, CELL.read_noise_e, mean.shape))
    return np.array(images, np.float32), truth


def weights_of(images: NDArray[np.float32]) -> Floats:
    """Return the weights of faintspot's solutions, (images, strengths); infinite ones become large."""
    solved = [fs.tv_denoise(images, f * CELL.pixel_noise_e, full_output=True).multiplier for f in STRENGTHS]
    return np.minimum(np.stack(solved, axis=1), 1e3)


def differences(count: int = 30) -> tuple[float, float]:
    """Return the largest differences of R of the same images: plain at any k, TV at k = 5 to 40."""
    ((images, truth),) = realisations(CELL, count, np.random.default_rng(2))
    fast = mean_errors([(images, truth)])
    slow = straightforward(images, truth, weights_of(images))
    tv = np.abs(fast["tv"] - slow["tv"])[:, 4:40]
    return float(np.abs(fast["plain"] - slow["plain"]).max()), float(tv.max())


def run() -> list[Table]:
    """Compare realisations per second."""
    title = "Realisations per second of a 16 x 16 cell, every k, one thread"
    if importlib.util.find_spec("skimage") is None:
        return [Table("study", title, [], ["not installed: skimage"])]
    plain, tv = differences()
    if plain > SAME_PLAIN_PX or tv > SAME_TV_PX:
        raise AssertionError(f"R differs by {plain:g} px without and {tv:g} px with denoising")
    images, _ = simulate_one_by_one(RIVAL_REALISATIONS, np.random.default_rng(3))
    weights = weights_of(images)
    count = SPECIFICATION.realisations

    def rival() -> None:
        simulated, truth = simulate_one_by_one(RIVAL_REALISATIONS, np.random.default_rng(3))
        straightforward(simulated, truth, weights)

    with pinned():
        times = interleaved(
            {
                "faintspot": lambda: ours(count),
                "all": lambda: measure_cell(CELL, SPECIFICATION),
                "rival": rival,
            },
            seconds=15.0,
        )
    times["rival"] *= count / RIVAL_REALISATIONS
    found = ratio(times, "rival", "faintspot")
    values = {
        "faintspot 1/s": count / best(times, "faintspot"),
        "rival 1/s": count / best(times, "rival"),
        **found.values,
        "plain differs px": plain,
        "TV differs px": tv,
    }
    return [
        Table(
            "study",
            title,
            [
                Row(
                    "plain and TV: NumPy, scikit-image",
                    values,
                    f">= {TARGET:g}",
                    found.smaller >= TARGET,
                    found.spread,
                ),
                Row("a whole cell, four arms", {"faintspot 1/s": count / best(times, "all")}),
            ],
            ["simulation included; a target is met when both ratios meet it"],
        )
    ]
