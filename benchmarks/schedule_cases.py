"""The cases on which schedules are compared with the converged solution, and how."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.compare.statistics import Estimate, absolute_errors
from faintspot.study.sweep import Cell

SEED = 2604
ENOUGH = 0.01
"""The excess that counts as none."""

Floats = NDArray[np.float64]
Images = NDArray[np.float32]


@dataclass(frozen=True)
class Case:
    """What is simulated, and the strength that suits it best, as a fraction of a mean pixel's noise.

    Without a best strength the case is not one of the studies' reference cases.
    """

    name: str
    cell: Cell
    best: float | None = None

    @property
    def pixel_noise_e(self) -> float:
        """Noise of a mean pixel, electrons."""
        return self.cell.pixel_noise_e

    @property
    def is_reference(self) -> bool:
        """Whether it is one of the 24 reference cases of the studies."""
        return self.best is not None


def case_of(
    name: str,
    read_noise_e: float,
    flux_e: float,
    best: float | None = None,
    *,
    profile: str = "diffraction",
    size: float = 1.0,
    elongation: float = 1.0,
    pixels: int = 16,
    reach_px: float = 1.0,
) -> Case:
    """Return a case of round numbers; sizes and elongation as in studies."""
    return Case(name, Cell(flux_e, read_noise_e, profile, size, elongation, pixels, reach_px, 0.0, 1.0), best)


CASES = (
    case_of("rn0.1_f10", 0.1, 10, 0.7),
    case_of("rn0.1_f30", 0.1, 30, 0.7),
    case_of("rn0.1_f200", 0.1, 200, 0.5),
    case_of("rn1_f80", 1, 80, 0.85),
    case_of("rn3_f200", 3, 200, 1.0),
    case_of("rn5_f200", 5, 200, 1.0),
    case_of("rn10_f800", 10, 800, 0.85),
    case_of("rn16_f1000", 16, 1000, 0.85),
    case_of("rn0.1_f80_size1.5", 0.1, 80, 0.5, size=1.5),
    case_of("rn0.1_f200_size2", 0.1, 200, 0.5, size=2),
    case_of("rn16_f800_size1.5", 16, 800, 1.0, size=1.5),
    case_of("rn16_f2500_size2", 16, 2500, 0.85, size=2),
    case_of("rn0.1_f30_gauss", 0.1, 30, 0.3, profile="gaussian"),
    case_of("rn0.1_f80_gauss_size2", 0.1, 80, 0.3, profile="gaussian", size=2),
    case_of("rn3_f200_gauss", 3, 200, 0.85, profile="gaussian"),
    case_of("rn0.1_f30_8px", 0.1, 30, 0.3, pixels=8),
    case_of("rn0.1_f80_8px", 0.1, 80, 0.5, pixels=8),
    case_of("rn0.1_f30_12px", 0.1, 30, 0.5, pixels=12),
    case_of("rn0.1_f30_range3", 0.1, 30, 0.7, reach_px=3),
    case_of("rn0.1_f80_range4", 0.1, 80, 0.5, reach_px=4),
    case_of("rn0.1_f200_long3", 0.1, 200, 0.3, elongation=3),
    case_of("rn1_f80_long3", 1, 80, 0.85, elongation=3),
    case_of("rn3_f300_long3", 3, 300, 0.85, elongation=3),
    case_of("rn10_f1000_long3", 10, 1000, 0.85, elongation=3),
    case_of("rn1_f30", 1, 30),
    case_of("rn3_f50", 3, 50),
    case_of("rn3_f80", 3, 80),
    case_of("rn5_f120", 5, 120),
    case_of("rn10_f300", 10, 300),
    case_of("rn2_f60_10px", 2, 60, pixels=10),
    case_of("rn0.5_f100_6px", 0.5, 100, pixels=6),
    case_of("rn2_f150_24px", 2, 150, pixels=24),
    case_of("rn5_f400_32px", 5, 400, pixels=32),
    case_of("rn0.5_f40_20px_range2", 0.5, 40, pixels=20, reach_px=2),
    case_of("rn2_f120_size1.3_long2", 2, 120, size=1.3, elongation=2),
    case_of("rn0.3_f1000_gauss_size1.5", 0.3, 1000, profile="gaussian", size=1.5),
    case_of("rn7_f600_size0.8", 7, 600, size=0.8),
)
"""Reference cases, those near the limit of detection, others; by read noise and flux in electrons."""


@dataclass(frozen=True)
class Compared:
    """A schedule against the converged solution, on the same images."""

    excess: Estimate
    """(R - converged R) / converged R."""
    error_px: float = 0.0
    """R."""
    distance: float = 0.0
    """Mean change of the position per axis, over the converged R."""
    iterations: float = 0.0

    @property
    def is_too_far(self) -> bool:
        """Whether R is more than 1 % above the converged one."""
        return self.excess.value > ENOUGH

    @property
    def is_surely_too_far(self) -> bool:
        """Whether that is so by more than two standard errors."""
        return self.excess.value - 2 * self.excess.standard_error > ENOUGH


def sample(case: Case, realisations: int, *words: int) -> tuple[Images, Floats]:
    """Return images of a case, and where the spots are; the words choose the random numbers."""
    cell = case.cell
    return fs.simulate.subapertures(
        realisations,
        shape=(cell.pixels, cell.pixels),
        flux_e=cell.flux_e,
        profile=cell.profile,
        size=cell.size,
        elongation=cell.elongation,
        position_range_px=cell.position_range_px,
        detector=fs.simulate.Detector(read_noise_e=cell.read_noise_e),
        rng=np.random.default_rng([SEED, *words]),
    )


def psf_of(case: Case) -> fs.PSF:
    """Return the point-spread function of a case's spots."""
    cell = case.cell
    radius = cell.pixels / 2 + cell.position_range_px + 2
    return fs.PSF.analytic(cell.profile, size=cell.size, elongation=cell.elongation, radius_px=radius)


def differences(slopes: fs.Slopes, converged: fs.Slopes, truth: Floats) -> Floats:
    """Return errors, converged errors, distances and iterations of a measurement, (4, n)."""
    theirs = np.stack([converged.x, converged.y], axis=-1)
    return np.stack(
        [
            absolute_errors(slopes.x, slopes.y, truth),
            absolute_errors(converged.x, converged.y, truth),
            absolute_errors(slopes.x, slopes.y, theirs),
            slopes.iterations.astype(np.float64),
        ]
    )


def compared(found: Floats) -> Compared:
    """Compare a measurement with the converged one, from their `differences`."""
    ours, theirs, moved, iterations = found
    error = float(theirs.mean())
    excess = float(ours.mean()) / error - 1.0
    influence = (ours - (1.0 + excess) * theirs) / error  # of each image on the ratio of the means
    spread = Estimate.of_mean(influence).standard_error
    return Compared(
        Estimate(excess, spread), float(ours.mean()), float(moved.mean()) / error, float(iterations.mean())
    )
