"""Smooth surfaces over an array of lenslets, by their values at the array's corners: cubic B-splines."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from faintspot.slopes.wavefront.zernike import edge_points

Floats = NDArray[np.float64]

_EDGE_POINTS = 4
_CURVATURE = 1e-4  # of the penalty: for parts so small that slopes do not tell their curvature


@dataclass(frozen=True)
class SplineGrid:
    """Square grid of cubic B-splines around lenslets; its nodes lie at corners of a square array."""

    origin: Floats
    """Position of node (0, 0), x and y [px]."""
    axes: Floats
    """Directions of the grid, (2, 2): x, y of the rows' direction, then of the columns'."""
    pitch_px: float
    shape: tuple[int, int]
    """Number of rows and columns of nodes."""

    @classmethod
    def around(cls, outlines: Floats, centre: Floats, angle_deg: float, pitch_px: float) -> SplineGrid:
        """Return the grid that contains lenslets (n, corners, 2), aligned with the one at the centre."""
        angle = np.deg2rad(angle_deg)
        axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        corner = axes @ centre / pitch_px - 0.5
        reached = outlines.reshape(-1, 2) @ axes.T / pitch_px - corner
        low, high = np.floor(reached.min(axis=0)) - 2, np.ceil(reached.max(axis=0)) + 2
        columns, rows = (high - low).astype(int) + 1
        return cls((corner + low) * pitch_px @ axes, axes, pitch_px, (int(rows), int(columns)))

    def values(self, points: Floats) -> sparse.csr_matrix:
        """Return the sparse matrix from nodes to the surface at points (n, 2) in frame pixels."""
        at = (points - self.origin) @ self.axes.T / self.pitch_px
        first = np.floor(at).astype(np.int64)
        along_x, along_y = np.moveaxis(_weights(at - first), 1, 0)
        column, row = (first - 1).T[..., None] + np.arange(4)
        node = row[:, :, None] * self.shape[1] + column[:, None, :]
        weights = along_y[:, :, None] * along_x[:, None, :]
        rows = np.repeat(np.arange(len(points)), 16)
        size = len(points), self.shape[0] * self.shape[1]
        return sparse.csr_matrix((weights.ravel(), (rows, node.ravel())), shape=size)

    def gradients(self, outlines: Floats) -> sparse.csr_matrix:
        """Return the sparse matrix from nodes to mean gradients over polygons, (2 n, nodes), per pitch."""
        points, weights, normals, areas = edge_points(outlines, _EDGE_POINTS)
        n, size = len(outlines), points[0].size // 2
        rows, columns = np.repeat(np.arange(n), size), np.arange(n * size)
        surface = self.values(points.reshape(-1, 2))
        parts = (self.pitch_px * normal[..., None] * weights / areas[:, None, None] for normal in normals)
        means = [sparse.csr_matrix((part.ravel(), (rows, columns)), shape=(n, n * size)) for part in parts]
        return sparse.vstack([mean @ surface for mean in means], format="csr")

    def roughness(self) -> sparse.csr_matrix:
        """Return the sparse matrix whose quadratic form is the mean square of third derivatives.

        A small part of it is that of second derivatives.
        """
        form: object = 0
        for order, share in ((3, 1.0), (2, _CURVATURE)):
            for along in range(order + 1):
                matrix = sparse.kron(_steps(self.shape[0], order - along), _steps(self.shape[1], along))
                form = form + share * comb(order, along) * (matrix.T @ matrix)
        return form


def _weights(position: Floats) -> Floats:
    """Return the values (..., 4) of the four splines around positions from 0 to 1 between two nodes."""
    t = position
    four = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3
    return np.stack(four, axis=-1) / 6


def _steps(n: int, order: int) -> sparse.csr_matrix:
    """Return the sparse matrix of differences of an order between n values."""
    matrix = sparse.identity(n, format="csr")
    for _ in range(order):
        matrix = matrix[1:] - matrix[:-1]
    return matrix
