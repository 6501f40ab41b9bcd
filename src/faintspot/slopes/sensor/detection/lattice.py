"""Regular lattice of lenslets.

A lattice is stored as complex numbers: the node in row r and column c is at origin + step * (c + r *
ratio), with real part x and imaginary part y in frame pixels; ratio is 1j for a square lattice and exp(1j *
pi / 3) for a hexagonal one. In all positions, pixel i is centred at i.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.statistics import MAD_TO_STD
from faintspot.slopes.sensor.region import neighbours_of

RATIOS = {"square": 1j, "hexagonal": complex(np.exp(1j * np.pi / 3))}
SMALLEST_PITCH_PX = 5.0


@dataclass(frozen=True)
class Lattice:
    """Regular lattice of nodes, with positions as defined in the module docstring.

    Parameters
    ----------
    geometry : str
        Geometry, "square" or "hexagonal".
    origin : complex
        Position of one node, x + 1j * y, px.
    step : complex
        Vector from a node to the next one in its row [px].
    """

    geometry: str
    origin: complex
    step: complex

    @property
    def ratio(self) -> complex:
        """Ratio of the second lattice vector to the first."""
        return RATIOS[self.geometry]

    @property
    def pitch_px(self) -> float:
        """Distance between neighbouring nodes [px]."""
        return abs(self.step)

    @property
    def angle_deg(self) -> float:
        """Angle of the step from +x towards +y [degrees]."""
        return float(np.degrees(np.angle(self.step)))

    def positions(self, cells: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Return the positions of the nodes in the given (n, 2) rows and columns."""
        return self.origin + self.step * (cells[:, 1] + cells[:, 0] * self.ratio)

    def cells_inside(self, shape: tuple[int, ...], margin_px: float) -> NDArray[np.int64]:
        """Return (n, 2) rows and columns of the nodes at least `margin_px` inside a frame of this shape."""
        height, width = shape
        low = margin_px - 0.5
        corners = np.array([0, width - 1, 1j * (height - 1), width - 1 + 1j * (height - 1)])
        offset = (corners - self.origin) / self.step
        rows = offset.imag / self.ratio.imag
        columns = offset.real - rows * self.ratio.real
        row, column = (
            np.arange(int(np.floor(axis.min())) - 1, int(np.ceil(axis.max())) + 2) for axis in (rows, columns)
        )
        at = self.origin + self.step * (column + row[:, None] * self.ratio)
        inside = (
            (at.real >= low) & (at.real <= width - 1 - low) & (at.imag >= low) & (at.imag <= height - 1 - low)
        )
        return np.asarray(np.argwhere(inside) + np.array([row[0], column[0]]))

    def canonical(self, shape: tuple[int, ...]) -> Lattice:
        """Return the same lattice with angle in [-45, 45) or [-30, 30) and origin near the frame centre."""
        turn = 90.0 if self.geometry == "square" else 60.0
        angle = (self.angle_deg + turn / 2) % turn - turn / 2
        step = self.pitch_px * complex(np.exp(1j * np.radians(angle)))
        middle = complex(shape[1] / 2, shape[0] / 2)
        offset = (middle - self.origin) / step
        row = np.rint(offset.imag / self.ratio.imag)
        column = np.rint(offset.real - row * self.ratio.real)
        return replace(self, step=step, origin=self.origin + step * complex(column + row * self.ratio))

    def fitted(self, cells: NDArray[np.int64], positions: NDArray[np.complex128]) -> Lattice:
        """Return the least-squares fit of the lattice to spots (n,) x + 1j * y, with outliers removed."""
        nodes = cells[:, 1] + cells[:, 0] * self.ratio
        used = np.ones(len(nodes), dtype=bool)
        for _ in range(3):
            columns = np.column_stack([np.ones(used.sum()), nodes[used]])
            (origin, step), *_ = np.linalg.lstsq(columns, positions[used], rcond=None)
            distance = np.abs(positions - origin - step * nodes)
            # 1.1774 sigma is the median distance of a two-dimensional normal distribution.
            used = distance <= max(3.5 * float(np.median(distance)) / 1.1774, 0.5)
        return replace(self, origin=complex(origin), step=complex(step))

    def neighbours(self, cells: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the (n, 4 or 6) indices of the neighbours of each cell, n where there is none."""
        return neighbours_of(cells, self.geometry)

    def distance_px(self, y: NDArray[np.int64], x: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the distance of every pixel (y, x) from the node of its cell."""
        offset = (x + 1j * y[:, None] - self.origin) / self.step
        offset -= np.rint(offset.imag / self.ratio.imag) * self.ratio
        return np.asarray(np.abs(offset - np.rint(offset.real)) * self.pitch_px)


def robust_std(values: NDArray[Any]) -> float:
    """Return the standard deviation from the median absolute deviation; the ordinary one if that is 0."""
    deviation = MAD_TO_STD * float(np.median(np.abs(values - np.median(values))))
    return deviation if deviation > 1e-9 * float(np.ptp(values)) else float(values.std())
