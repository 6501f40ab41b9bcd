"""Distinguish a lattice from finer and coarser ones that share some of its nodes.

Structured spots have strong peaks at high spatial frequencies, which resemble those of a finer lattice (for
example of pitch 7.1 px instead of 25.6 px). The mean image of a cell decides: averaged over the cells of
the true lattice it keeps the structure of the spots; averaged over those of a finer one it is blurred.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.sensor.detection.lattice import RATIOS, Lattice, with_origin

_LARGEST_NORM = 25  # maximum number of cells of one lattice in a cell of the other
_MOST_PIXELS = 60_000  # random sample, which gives a share within 0.001
# Choose the finest lattice that explains this fraction of the variance explained by the best one. If all
# explain less than the smallest share of the variance, the frame is too faint to decide.
_PART, _SMALLEST = 0.75, 0.02


def best_kin(spots: NDArray[np.float64], lattice: Lattice, pitch_range_px: tuple[float, float]) -> Lattice:
    """Return the finest of this and the related lattices that explains a map of spots.

    Parameters
    ----------
    spots : array (ny, nx)
        Map without background.
    lattice : Lattice
    pitch_range_px : tuple of float
        Smallest and largest pitch to try.
    """
    sample = np.random.default_rng(0).integers(0, spots.size, min(spots.size, _MOST_PIXELS))
    y, x = np.divmod(sample, spots.shape[1])
    values = spots.ravel()[sample]
    values = (values - values.mean()) / max(float(values.std()), 1e-300)
    # Use several cells along each axis; otherwise a single spot decides.
    largest = min(pitch_range_px[1], min(spots.shape) / 3)
    factors = [power for factor in _factors(lattice.geometry) for power in (factor, 1 / factor)]
    kin = [replace(lattice, step=lattice.step * factor) for factor in factors]
    kin = [one for one in kin if pitch_range_px[0] <= one.pitch_px <= largest]
    shares = [_explained(values, x + 1j * y, one) for one in [lattice, *kin]]
    most = max(shares)
    if most < _SMALLEST or not kin:
        return lattice
    able = [one for one, share in zip([lattice, *kin], shares, strict=True) if share >= _PART * most]
    finest = min(able, key=lambda one: one.pitch_px)
    if finest.pitch_px > 0.99 * lattice.pitch_px and lattice in able:
        return lattice
    # The spots may be at any node of the finer of the two lattices.
    return with_origin(spots - spots.mean(), lattice.geometry, finest.wave)


def _factors(geometry: str) -> list[complex]:
    """Return the steps of related lattices in units of that of a lattice: nodes of one sector without 1."""
    ratio = RATIOS[geometry]
    steps = [a + b * ratio for a in range(1, 6) for b in range(6)]
    return [step for step in steps if 1.5 < abs(step) ** 2 < _LARGEST_NORM + 0.5]


def _explained(values: NDArray[np.float64], at: NDArray[np.complex128], lattice: Lattice) -> float:
    """Return the fraction of the variance that the mean image of a cell explains.

    It is the covariance of the mean images of even and odd cells, to which noise, and spots in every second
    cell only, do not contribute.
    """
    offset = (at - lattice.origin) / lattice.step
    row = offset.imag / lattice.ratio.imag
    column = offset.real - row * lattice.ratio.real
    side = int(np.clip(round(lattice.pitch_px / 2), 4, 24))
    whole = np.floor(row), np.floor(column)
    place_y, place_x = (
        np.minimum((part - floor) * side, side - 1).astype(np.int64)
        for part, floor in zip((row, column), whole, strict=True)
    )
    odd = ((whole[0] + whole[1]) % 2).astype(np.int64)
    index = (odd * side + place_y) * side + place_x
    count = np.bincount(index, minlength=2 * side**2)
    total = np.bincount(index, values, minlength=2 * side**2)
    even, uneven = (total / np.maximum(count, 1)).reshape(2, -1)
    return float(np.mean((even - even.mean()) * (uneven - uneven.mean())))
