"""The presets measure slopes as good as the converged denoising, with few iterations.

At the full noise as strength, where few iterations do worst.
"""

from typing import Any

import numpy as np
import pytest
from tests.patience import mostly_slow

from faintspot import Settings
from faintspot.base.statistics import slope_error
from faintspot.experiments import Cell
from faintspot.experiments.study.cell import realisations
from faintspot.slopes.pipeline.images import measure_images

CONVERGED: dict[str, Any] = {"tolerance": 1e-4, "max_iterations": 500}
ENOUGH, TOLERANCE = 0.01, 0.03
"""What "fast" is for: 1 %. Of 8,000 images the excess has a standard error of 0.1 to 1 % (the spot that is
nearly lost): 1 % and two of these."""


def excess(cell: Cell, keep: int, strength: float, **settings: Any) -> float:
    """Return (R - converged R) / converged R."""
    blocks = list(realisations(cell, 8000, np.random.default_rng(7)))
    images, truth = (np.concatenate(parts) for parts in zip(*blocks, strict=True))
    usual: dict[str, Any] = {"noise_std": strength * cell.pixel_noise_e, "keep_brightest": keep}
    converged = measure_images(images, Settings(**usual, **CONVERGED))
    slopes = measure_images(images, Settings(**usual, **settings))
    ours, theirs = (slope_error(each.x, each.y, truth).value for each in (slopes, converged))
    return ours / theirs - 1


def cell(read_noise_e: float, flux_e: float, profile: str = "diffraction", size: float = 1.0) -> Cell:
    return Cell(flux_e, read_noise_e, profile, size, 1.0, 16, 1.0, 0.0, 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "keep"),
    mostly_slow(1, [(cell(3.0, 80), 12), (cell(0.1, 30), 11), (cell(0.1, 30, "gaussian"), 16)]),
    ids=["nearly infeasible", "diffraction spot", "Gaussian spot"],
)
def test_fast_is_as_good_as_converged(case: Cell, keep: int) -> None:
    assert excess(case, keep, 1.0, preset="fast") < TOLERANCE


@pytest.mark.slow
def test_accurate_is_as_good_as_converged_with_many_pixels_kept_and_fewer_iterations_are_not() -> None:
    """Where a wide, shallow residue is left: a large Gaussian spot, 100 of 256 pixels."""
    case = cell(0.1, 80, "gaussian", 2.0)
    assert excess(case, 100, 0.7) < ENOUGH
    assert excess(case, 220, 0.7, preset="fast") > ENOUGH
