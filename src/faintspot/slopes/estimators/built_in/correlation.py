"""Correlation with a reference image of each sub-aperture, in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.options import option
from faintspot.base.sizes import check_size
from faintspot.slopes.estimators.base import Estimator, Need, Style
from faintspot.slopes.estimators.sensor import Sensor

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Correlation(Estimator):
    """Maximum of the normalised correlation with a reference image, between steps by a quadratic function.

    The reference is the PSF of each sub-aperture, which may be an extended source. Like `matched`
    it weighs all pixels equally, but it is slower and states no errors. It is therefore not among the
    estimators with a name; use it as ``fs.Settings(Correlation())``.
    """

    step_px: float = option(
        1.0,
        "Distance of the positions at which the correlation is computed.",
        unit="px",
        low=0.05,
        high=1.0,
        per_subaperture=False,
    )
    local_background: str = option(
        "off",
        "Ignore a constant in every sub-aperture: an unknown background, or a source larger than the window.",
        choices=("off", "on"),
        per_subaperture=False,
    )

    name = "correlation"
    label = "correlation"
    method = "maximum of the correlation with the PSF, quadratic between steps"
    needs = frozenset({Need.PSF})
    style = Style("#999933", "-.", "X")

    def locate(self, images: NDArray[np.float32], sensor: Sensor, prior: Floats) -> object:
        """See `Estimator`."""
        step = float(self.step_px)
        references, (rows, columns) = _references(sensor, step, self.local_background == "on")
        values = (references @ images.reshape(len(images), -1, 1)).reshape(-1, rows, columns)
        inner = values[:, 1:-1, 1:-1].reshape(len(images), -1)
        row, column = np.unravel_index(inner.argmax(axis=1), (rows - 2, columns - 2))
        nine = values[
            np.arange(len(images))[:, None, None],
            row[:, None, None] + np.arange(3)[:, None],
            column[:, None, None] + np.arange(3),
        ]
        nearest = np.stack([column - (columns - 3) // 2, row - (rows - 3) // 2], axis=1)
        return sensor.zero + step * (nearest + _maximum(nine.astype(np.float64)))


def _maximum(nine: Floats) -> Floats:
    """Return where the quadratic function through values (n, 3, 3) around 0 is largest, at most 1 away."""
    middle, left, right = nine[:, 1, 1], nine[:, 1, 0], nine[:, 1, 2]
    above, below = nine[:, 0, 1], nine[:, 2, 1]
    slope_x, slope_y = 0.5 * (right - left), 0.5 * (below - above)
    xx, yy = left - 2.0 * middle + right, above - 2.0 * middle + below
    xy = 0.25 * (nine[:, 0, 0] - nine[:, 0, 2] - nine[:, 2, 0] + nine[:, 2, 2])
    determinant = xx * yy - xy * xy
    peaked = (xx < 0) & (determinant > 1e-6 * xx * yy)
    safe = np.where(peaked, determinant, 1.0)
    moved = np.stack([xy * slope_y - yy * slope_x, xy * slope_x - xx * slope_y], axis=1) / safe[:, None]
    found: Floats = np.where(peaked[:, None], np.clip(moved, -1.0, 1.0), 0.0)
    return found


@lru_cache(maxsize=2)
def _references(sensor: Sensor, step: float, background: bool) -> tuple[NDArray[np.float32], tuple[int, int]]:
    """Return images of every spot of norm 1 at the positions of a grid around its reference position.

    Returns
    -------
    references : (n, positions, pixels) float32
    side : (int, int)
        Rows and columns of the grid; the outermost only serve the interpolation.
    """
    assert sensor.psf is not None
    ny, nx = sensor.window
    reach = float(np.max(np.minimum(sensor.search_range_px, 0.5 * max(ny, nx))))
    line = np.arange(-np.ceil(reach / step) - 1, np.ceil(reach / step) + 2) * step
    x, y = np.meshgrid(line, line)
    grid = np.column_stack([x.ravel(), y.ravel()])
    shape = (sensor.n, len(grid), ny * nx)
    check_size("references", shape, hint="give search_range_px or a larger step_px")
    references = np.empty(shape, np.float32)
    for s, plane in enumerate(sensor.psf.index_of(sensor.n)):
        images = sensor.psf.images(sensor.zero[s] + grid, (ny, nx), which=plane)
        flat = images.reshape(len(grid), -1)
        flat -= flat.mean(axis=1, keepdims=True) if background else 0.0
        references[s] = flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-6)
    return references, (len(line), len(line))
