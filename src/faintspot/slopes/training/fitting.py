"""The passes of a trained score, each a ridge regression of the error that the passes before it left."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.spots.score import table_sums
from faintspot.slopes.training.splines import STEPS_PER_PX, SplineTables

Floats = NDArray[np.float64]

RIDGE = 1e-4
"""Weight of the ridge, in units of the features' mean square."""
CLEAR_LOSS = 1.005
"""Factor on the error by which a pass must raise it to be left out."""
_BLOCK_IMAGES = 2048  # images whose features are made at a time: bounds the memory


@dataclass(frozen=True)
class Sample:
    """Images to train on or to measure the error with."""

    images: NDArray[np.floating[Any]]
    """(n, ny, nx), in units of the expected flux."""
    truth: Floats
    """(n, 2) positions, px; noise in them that is independent of the images only wants more of them."""
    start: Floats
    """(n, 2) where the first pass starts, px."""
    low: Floats
    """(n, 2) smallest positions allowed."""
    high: Floats
    covariance: NDArray[np.floating[Any]] | None = None
    """(n, 2, ny, nx) images of what the noise of `truth` and of `images` have in common, if anything: summed
    over a table like the images they give what that adds to the product of feature and truth."""

    @classmethod
    def together(cls, parts: list[Sample]) -> Sample:
        """Join several samples."""
        names = [field.name for field in fields(cls) if getattr(parts[0], field.name) is not None]
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def part(self, selection: slice) -> Sample:
        """Return some of the images."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return Sample(**{name: value[selection] for name, value in values.items() if value is not None})

    def rms_errors(self, tables: NDArray[np.float32]) -> tuple[Floats, Floats]:
        """Return where the last pass puts its table (n, 2), and the rms error after each pass (passes, 2)."""
        positions = rounded = self.start
        errors = []
        for table in tables:
            rounded = _rounded(positions)
            moved = [
                table_sums(self.images[block], rounded[block], table, STEPS_PER_PX)
                for block in _blocks(len(positions))
            ]
            positions = np.clip(rounded + np.concatenate(moved), self.low, self.high)
            errors.append(np.sqrt(np.mean((positions - self.truth) ** 2, axis=0)))
        return rounded, np.stack(errors)


def fit_passes(sample: Sample, basis: SplineTables, passes: int) -> NDArray[np.float32]:
    """Train the passes of a score one after the other.

    Parameters
    ----------
    sample : Sample
    basis : SplineTables
    passes : int

    Returns
    -------
    (passes, 2, rows, columns) array
        Tables as in `TrainedScore`.
    """
    positions = sample.start
    trained = []
    for _ in range(passes):
        weights_x, weights_y = _regression(sample, positions, basis)
        positions = _moved(sample, positions, basis, weights_x, weights_y)
        trained.append(basis.tables(weights_x, weights_y))
    return np.stack(trained)


def best_passes(held_out: Sample, tables: NDArray[np.float32]) -> tuple[NDArray[np.float32], Floats]:
    """Leave out the passes that raise the error on a sample that they were not trained on.

    At low flux a further pass adds noise: it forgets what the one before it made of the start. Elsewhere
    it helps spots that are farther away than those of the training, so that only a clear loss counts. In the
    place of those left out come as many without effect, before the others.

    Returns
    -------
    (passes, 2, rows, columns) array
        The tables.
    (2,) array
        Their rms error in x and y, px.
    """
    _, errors = held_out.rms_errors(tables)
    both_axes = np.hypot(*errors.T)
    last = int(np.flatnonzero(both_axes <= CLEAR_LOSS * both_axes.min())[-1])
    idle = np.zeros_like(tables[last + 1 :])
    return np.concatenate([idle, tables[: last + 1]]), errors[last]


def _rounded(positions: Floats) -> Floats:
    rounded: Floats = np.rint(positions * STEPS_PER_PX) / STEPS_PER_PX
    return rounded


def _blocks(n: int) -> list[slice]:
    return [slice(first, first + _BLOCK_IMAGES) for first in range(0, n, _BLOCK_IMAGES)]


def _regression(sample: Sample, positions: Floats, basis: SplineTables) -> tuple[Floats, Floats]:
    """Weights of the features that best predict the remaining error in x and in y."""
    products = np.zeros((2, basis.n_features, basis.n_features))
    moments = np.zeros((2, basis.n_features))
    for block in _blocks(len(sample.images)):
        rounded = _rounded(positions[block])
        remaining = sample.truth[block] - rounded
        for axis, features in enumerate(basis.features(sample.images[block], rounded)):
            products[axis] += features.T @ features
            moments[axis] += features.T @ remaining[:, axis]
            if sample.covariance is not None:
                moments[axis] -= basis.features(sample.covariance[block, axis], rounded)[axis].sum(axis=0)
    if basis.symmetry == "round":
        products, moments = (np.broadcast_to(part.sum(axis=0), part.shape) for part in (products, moments))
    ridge = RIDGE * np.trace(products, axis1=1, axis2=2) / basis.n_features
    regular = products + ridge[:, None, None] * np.eye(basis.n_features)
    weights_x, weights_y = np.linalg.solve(regular, moments[..., None])[..., 0]
    return weights_x, weights_y


def _moved(
    sample: Sample, positions: Floats, basis: SplineTables, weights_x: Floats, weights_y: Floats
) -> Floats:
    """Positions after a pass."""
    moved = np.empty_like(positions)
    for block in _blocks(len(positions)):
        rounded = _rounded(positions[block])
        x, y = basis.features(sample.images[block], rounded)
        moved[block] = rounded + np.stack([x @ weights_x, y @ weights_y], axis=1)
    return np.clip(moved, sample.low, sample.high)


def stacked_tables(kinds: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Stack tables (..., side, side) of several kinds, the smaller ones in a border of zeros."""
    side = max(tables.shape[-1] for tables in kinds)
    borders = [(side - tables.shape[-1]) // 2 for tables in kinds]
    return np.stack(
        [
            np.pad(tables, [(0, 0)] * (tables.ndim - 2) + [(border, border)] * 2)
            for tables, border in zip(kinds, borders, strict=True)
        ]
    )
