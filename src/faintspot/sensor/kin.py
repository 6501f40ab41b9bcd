"""Tell a lattice from its kin: finer and coarser ones whose nodes are partly the same.

Structured spots have strong peaks at high spatial frequencies, which may pass for those of a finer lattice
(pitches 25.6 and 7.1 px, say). The image of one cell decides: averaged over the cells of the true lattice it
keeps the spots' structure, averaged over those of a finer one it is a blur.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from faintspot.sensor.lattice import RATIOS, Lattice, with_origin

_LARGEST_NORM = 25  # most cells of one lattice in a cell of its kin
_MOST_PIXELS = 60_000  # a random sample of so many gives a share within 0.001
# The lattice is the finest of its kin that explains this part of what the best of them explains. Where they
# all explain less than the smallest share of the variance, the frame is too faint to tell.
_PART, _SMALLEST = 0.75, 0.02


def best_kin(spots: NDArray[np.float64], lattice: Lattice, pitch_range_px: tuple[float, float]) -> Lattice:
    """Return the finest lattice, of this one and its kin, that explains a map of spots.

    Parameters
    ----------
    spots : array (ny, nx)
        A map without background.
    lattice : Lattice
    pitch_range_px : tuple of float
        The smallest and the largest pitch to try.
    """
    sample = np.random.default_rng(0).integers(0, spots.size, min(spots.size, _MOST_PIXELS))
    y, x = np.divmod(sample, spots.shape[1])
    values = spots.ravel()[sample]
    values = (values - values.mean()) / max(float(values.std()), 1e-300)
    # Several cells each way, else one spot decides.
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
    # The spots may lie at any node of the finer of the two.
    return with_origin(spots - spots.mean(), lattice.geometry, finest.wave)


def _factors(geometry: str) -> list[complex]:
    """Return the steps of kin, in those of a lattice: the nodes of one sector, 1 left out."""
    ratio = RATIOS[geometry]
    steps = [a + b * ratio for a in range(1, 6) for b in range(6)]
    return [step for step in steps if 1.5 < abs(step) ** 2 < _LARGEST_NORM + 0.5]


def _explained(values: NDArray[np.float64], at: NDArray[np.complex128], lattice: Lattice) -> float:
    """Return the share of the variance that the mean image of a cell explains.

    It is the covariance of the mean images of even and odd cells: noise, and spots that only every second
    cell has, add nothing to it.
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
