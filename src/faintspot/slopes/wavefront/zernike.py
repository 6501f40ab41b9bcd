"""Zernike polynomials in Noll's order, and their mean gradients over sub-apertures.

Noll (1976), JOSA 66, 207: mode j has mean square 1 over the unit disk, and even j have the cosine.
"""

import numpy as np
import scipy
from numpy.typing import ArrayLike

from faintspot.base.arrays import Floats

_FOILS = "astigmatism", "trefoil", "tetrafoil", "pentafoil", "hexafoil", "heptafoil", "octafoil"
_RANKS = "", "secondary ", "tertiary ", "quaternary "
_HIGHEST_NAMED = 8


def noll_to_nm(j: int) -> tuple[int, int]:
    """Return radial order n and azimuthal order m of mode j = 1, 2 ...; m < 0 means the sine."""
    n = 0
    while (n + 1) * (n + 2) // 2 < j:
        n += 1
    index = j - 1 - n * (n + 1) // 2
    m = 2 * (index // 2) + 1 if n % 2 else 2 * ((index + 1) // 2)
    return n, m if j % 2 == 0 else -m


def osa_index(j: int) -> int:
    """Return the index of mode j of Noll in the standard of OSA and ANSI (Z80.28): (n (n + 2) + m) / 2.

    Both standards norm modes to a mean square of 1, so that coefficients are the same.
    """
    n, m = noll_to_nm(j)
    return (n * (n + 2) + m) // 2


def mode_name(j: int) -> str:
    """Return the name of a mode up to radial order 8, otherwise its orders."""
    n, m = noll_to_nm(j)
    if n < 2:
        return ("piston", "tilt along x", "tilt along y")[j - 1]
    if n > _HIGHEST_NAMED:
        return f"n = {n}, m = {m}"
    rank = (n - abs(m)) // 2
    if m == 0:
        return "defocus" if n == 2 else f"{_RANKS[rank - 2]}spherical"
    if abs(m) == 1:
        return f"{_RANKS[rank - 1]}coma along {'y' if m < 0 else 'x'}"
    cosine, sine = ("0°", "45°") if abs(m) == 2 else ("cosine", "sine")
    return f"{_RANKS[rank]}{_FOILS[abs(m) - 2]}, {sine if m < 0 else cosine}"


def zernike(j: int, x: ArrayLike, y: ArrayLike) -> Floats:
    """Return mode j at points in units of the disk's radius; being a polynomial, also outside the disk.

    The radial part is the Jacobi polynomial (-1)^k r^m P_k^(m,0)(1 - 2 r^2) with k = (n - m) / 2.
    """
    n, signed = noll_to_nm(j)
    m = abs(signed)
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    around = (x + 1j * y) ** m  # r^m with cosine and sine of m times the angle
    k = (n - m) // 2
    radial = (-1) ** k * scipy.special.eval_jacobi(k, m, 0, 1 - 2 * (x**2 + y**2))
    norm = np.sqrt((n + 1) * (1 if m == 0 else 2))
    mode: Floats = norm * radial * (around.real if signed >= 0 else around.imag)
    return mode


def mean_gradients(modes: ArrayLike, outlines: Floats) -> Floats:
    """Return the mean gradient of modes over polygons, exactly.

    The integral of a gradient over an area equals that of the mode times the outward normal along its edge.
    Along a straight edge the mode is a polynomial of order n, which (n + 2) // 2 Gauss-Legendre points
    integrate exactly.

    Parameters
    ----------
    modes : (k,) array of int
        Noll indices j.
    outlines : (n, corners, 2) array
        x, y of each polygon's corners, going round from +x towards +y, in units of the disk's radius.

    Returns
    -------
    (2, n, k) array
        Gradients along x and along y, per unit of radius.
    """
    numbers = [int(j) for j in np.asarray(modes)]
    highest = max(noll_to_nm(j)[0] for j in numbers)
    points, weights, normals, areas = edge_points(outlines, (highest + 2) // 2)
    gradients = np.empty((2, len(outlines), len(numbers)))
    for column, j in enumerate(numbers):
        along_edges = zernike(j, points[..., 0], points[..., 1]) @ weights
        gradients[..., column] = (normals * along_edges).sum(axis=-1) / areas
    return gradients


def edge_points(outlines: Floats, count: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return points at which to integrate over the edges of polygons (n, corners, 2), by Gauss-Legendre.

    Returns
    -------
    points : (n, corners, count, 2) array
        Points along the edges.
    weights : (count,) array
        Weights of the points of an edge; their sum is 1.
    normals : (2, n, corners) array
        Outward normals x and y, as long as the edges.
    areas : (n,) array
        Areas of the polygons.
    """
    nodes, weights = np.polynomial.legendre.leggauss(count)
    edges = np.roll(outlines, -1, axis=1) - outlines
    points = outlines[:, :, None] + edges[:, :, None] * (0.5 * (nodes + 1))[:, None]
    normals = np.stack([edges[..., 1], -edges[..., 0]])
    cross = outlines[..., 0] * edges[..., 1] - outlines[..., 1] * edges[..., 0]
    return points, 0.5 * weights, normals, 0.5 * cross.sum(axis=1)
