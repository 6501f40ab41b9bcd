"""Zonal maps: wavefronts of any shape over pupils of any shape, as cubic B-splines."""

from __future__ import annotations

from dataclasses import dataclass
from math import comb
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu
from scipy.spatial import KDTree

from faintspot.base.errors import InputError
from faintspot.base.flags import are_valid, leave_out
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import Pupil, lenslet_outlines, lenslet_pitch, lit_outlines, pupil_of
from faintspot.slopes.wavefront.fit import FEWEST_SUBAPERTURES, POINTS, OfLength, Wavefront, too_few, unit_of
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


_SMOOTHNESS = 1e-3  # weight of third derivatives against slopes, both per pitch
_CONNECTED = 1.25  # pitches between centres: sub-apertures that have an edge in common
_LEAST_SHARE = 0.1  # of a sub-aperture's area in the pupil, below which its slope tells too little
_MOST = 5000  # sub-apertures: matrices of 2 x 5000^2 numbers
_AT_ONCE = 1000


@dataclass(frozen=True)
class ZonalMap(OfLength):
    """Mean wavefront as a smooth surface through the slopes, without modes.

    It increases in the direction of the spots' displacement. Slopes do not show steps between parts of the
    pupil that are not connected: the mean of each part is 0.
    """

    values: Floats
    """Value at the centre of each sub-aperture, (n,); NaN where there is none."""
    standard_errors: Floats
    """Standard error of each value relative to the mean of its part, (n,); NaN if unknown."""
    parts: NDArray[np.int64]
    """Number of the connected part, (n,), from 0, the largest first; -1 where there is none."""
    residual_px: float
    """Rms of the slopes about those of the map, px per axis."""
    sheet: Floats
    """Map, (points, points), NaN between the sub-apertures; rows along y, columns along x."""
    nearest: NDArray[np.int64]
    """Sub-aperture at each point of the map; -1 where there is none."""
    reach: float
    """Distance of the map's outermost points from the pupil's centre, in its radii."""

    _amounts: ClassVar[tuple[str, ...]] = "values", "standard_errors", "sheet"

    def centred(self, sheet: Floats, *, tilt: bool = True) -> Floats:
        """Return a map of this shape minus its mean over each part, with or without the tilt of all parts."""
        known = np.isfinite(sheet) & (self.nearest >= 0)
        part = self.parts[self.nearest[known]]
        counts = np.maximum(np.bincount(part), 1)

        def minus_means(values: Floats) -> Floats:
            return np.asarray(values - (np.bincount(part, values) / counts)[part])

        values = minus_means(sheet[known])
        if not tilt:
            planes = np.stack([minus_means(place.astype(np.float64)) for place in np.nonzero(known)], axis=1)
            values = values - planes @ np.linalg.lstsq(planes, values, rcond=None)[0]
        centred = np.full(sheet.shape, np.nan)
        centred[known] = values
        return centred


def compared(zonal: ZonalMap, wavefront: Wavefront, *, tilt: bool = True) -> dict[str, Floats]:
    """Return maps by name: zonal, that of the fitted modes at the same points, and zonal minus modes.

    The mean of each part is subtracted. Maps of modes are NaN outside of their disk.
    """
    modes = wavefront.sheet(reach=zonal.reach)
    sheets = {"zonal map": zonal.sheet, "modes, in their disk": modes}
    sheets["zonal map minus modes"] = zonal.sheet - modes
    return {name: zonal.centred(sheet, tilt=tilt) for name, sheet in sheets.items()}


def zonal_map(slopes: Slopes, layout: Layout) -> ZonalMap:
    """Reconstruct the mean wavefront as a smooth surface, by least squares over the valid sub-apertures.

    The surface has a cubic B-spline for each corner of the array. Its mean gradient over each lenslet is
    compared with the mean slope, as in the geometry of Fried (1977, JOSA 67, 370), but without its error for
    curved wavefronts. A weak penalty of third derivatives chooses among surfaces that slopes do not tell
    apart, such as waffle, and changes polynomials of second order not at all. Sub-apertures that have an edge
    in common belong to one part of the pupil; each part is reconstructed by itself.

    Slopes are weighted by the inverse of the square of their standard errors, where these are known.
    Sub-apertures that are valid in less than half of the frames are left out.

    Parameters
    ----------
    slopes : Slopes
        Slopes of one frame or several, relative to their reference.
    layout : Layout
        With `pixel_scale_arcsec`, and `subaperture_m` or `diameter_m`, the wavefront is in nm.

    Raises
    ------
    InputError
        When slopes and layout do not fit together, no slope is valid, or there are more than 5000
        sub-apertures.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import zonal_map
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, pixel_scale_arcsec=0.5, subaperture_m=0.6)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 5, flux_e=1000.0,
    ...     positions=np.tile([0.3, 0.0], (len(layout), 1)), rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> found = zonal_map(slopes, layout)
    >>> print(f"{np.ptp(found.values):.0f} nm between the outermost of 7 sub-apertures")
    2685 nm between the outermost of 7 sub-apertures
    """
    flags = np.atleast_2d(slopes.flags)
    if flags.ndim != 2 or flags.shape[1] != len(layout):
        n = flags.shape[-1]
        raise InputError(f"slopes: expected {len(layout)} sub-apertures, as in the layout, got {n}")
    pupil, outlines, share = pupil_of(layout, flags), lenslet_outlines(layout), np.ones(len(layout))
    if pupil.stated:
        outlines, share = lit_outlines(layout, pupil)
    often = are_valid(flags, slopes.keep).mean(axis=0)
    causes = {
        "outside the pupil": share < _LEAST_SHARE,
        "valid in less than half of the frames": (often > 0) & (often < 0.5 * often.max()),
    }
    valid, left_out = leave_out(flags, slopes.keep, causes)
    lit = np.asarray(valid.any(axis=0))
    if np.count_nonzero(lit) < FEWEST_SUBAPERTURES:
        raise too_few(lit, left_out)
    if np.count_nonzero(lit) > _MOST:
        raise InputError(f"slopes: expected at most {_MOST} valid sub-apertures, got {np.count_nonzero(lit)}")
    measured = _measured(slopes, valid, share)
    parts = _connected_parts(layout, lit)
    nearest, points, reach = _places(layout, outlines, pupil, lit)
    unit, scale = unit_of(layout, pupil)
    scale /= pupil.radius_subapertures
    values, errors, squares = (np.full(len(layout), np.nan) for _ in range(3))
    sheet = np.full(nearest.shape, np.nan)
    for number in range(parts.max() + 1):
        used = np.flatnonzero(parts == number)
        inside = np.isin(nearest, used)
        centres = layout.centres[used]
        grid = SplineGrid.around(outlines[used], centres[0], layout.angle_deg, lenslet_pitch(layout))
        part = measured.of_subapertures(used)
        surface, squares[used], errors[used] = _reconstruct(grid, outlines[used], centres, part)
        values[used] = grid.values(centres) @ surface
        sheet[inside] = grid.values(points[inside]) @ surface
    residual = float(np.sqrt(np.nanmean(squares)))
    return ZonalMap(
        scale * values,
        scale * errors,
        parts,
        residual,
        scale * sheet,
        nearest,
        reach,
        unit=unit,
        pupil=pupil,
        errors_from=measured.source,
        left_out=left_out,
    )


@dataclass(frozen=True)
class _Measured:
    """Mean slopes, all x, then all y, with what is known of their noise."""

    mean: Floats
    weights: Floats
    deviations: Floats
    """Contribution of each frame to the error of the mean, (n_frames, 2 n); for one frame, none."""
    variances: Floats
    covariances: Floats
    """Variances and covariances of x and y of a single frame, from its standard errors."""
    source: str

    def of_subapertures(self, used: NDArray[np.int64]) -> _Measured:
        """Return those of some sub-apertures."""
        both = np.concatenate([used, used + len(self.mean) // 2])
        parts = self.mean[both], self.weights[both], self.deviations[:, both], self.variances[both]
        return _Measured(*parts, self.covariances[used], self.source)

    def errors(self, inverse: Floats, residuals: Floats, freedom: float) -> Floats:
        """Return the standard errors of what a matrix makes of the slopes.

        `residuals` are those of the slopes, and `freedom` their degrees of freedom.
        """
        if self.source == "frames":
            variance = ((inverse @ self.deviations.T) ** 2).sum(axis=1)
        elif self.source == "slopes":
            along, across = np.split(inverse, 2, axis=1)
            variance = inverse**2 @ self.variances + 2 * (along * across) @ self.covariances
        elif freedom >= 1:
            variance = inverse**2 @ (1 / self.weights) * (self.weights @ residuals**2) / freedom
        else:
            variance = np.full(len(inverse), np.nan)
        return np.asarray(np.sqrt(variance))


def _measured(slopes: Slopes, valid: NDArray[np.bool_], share: Floats) -> _Measured:
    """Return the mean of the valid slopes; weights are 0 where there are none."""
    frames, used = len(valid), np.tile(valid, 2)
    count = np.maximum(used.sum(axis=0), 1)
    vector = np.where(used, np.atleast_2d(slopes.vector), 0.0).astype(np.float64)
    errors = [np.atleast_2d(getattr(slopes, f"standard_error_{axis}")) for axis in "xy"]
    variances = np.concatenate(errors, axis=1).astype(np.float64) ** 2
    known = bool(np.isfinite(variances[used]).all())
    mean = vector.sum(axis=0) / count
    noise = np.where(used, variances, 0.0).sum(axis=0) / count**2
    lit = used.any(axis=0)
    weights = np.tile(share, 2) * lit
    if known:
        typical = float(np.median(noise[lit]))
        weights[lit] *= typical / np.maximum(noise[lit], 1e-6 * typical) if typical > 0 else 1.0
    deviations = np.zeros((0, len(mean)))
    if frames > 1:
        deviations = np.where(used, vector - mean, 0.0) / count * np.sqrt(frames / (frames - 1))
    source = "frames" if frames > 1 else "slopes" if known else "residuals"
    covariances = np.where(valid[0], np.atleast_2d(slopes.covariance_xy)[0], 0.0).astype(np.float64)
    return _Measured(mean, weights, deviations, noise, covariances, source)


def _connected_parts(layout: Layout, lit: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the number of the part of each lit sub-aperture, the largest first; -1 for the others."""
    places = np.flatnonzero(lit)
    pairs = KDTree(layout.centres[lit]).query_pairs(_CONNECTED * lenslet_pitch(layout), output_type="ndarray")
    size = len(places), len(places)
    graph = sparse.coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=size)
    _, labels = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(labels), kind="stable")
    parts = np.full(len(lit), -1)
    parts[places] = np.argsort(order)[labels]
    return parts


def _places(
    layout: Layout, outlines: Floats, pupil: Pupil, lit: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], Floats, float]:
    """Return the lit sub-aperture at each point of a map (-1: none), the points in px, and their reach."""
    away = np.abs(outlines[lit] - pupil.centre_px).max() / pupil.radius_px
    reach = 1.0 if pupil.stated else max(1.0, float(away))
    line = np.linspace(-reach, reach, POINTS) * pupil.radius_px
    offsets = np.stack(np.meshgrid(line, line), axis=-1)
    points = offsets + pupil.centre_px
    _, nearest = KDTree(layout.centres).query(points)
    whole = lenslet_outlines(layout)[0]
    normals = 0.5 * (whole + np.roll(whole, -1, axis=0)) - layout.centres[0]  # as long as the inner radius
    normals /= np.square(normals).sum(axis=1, keepdims=True)
    within = ((points - layout.centres[nearest]) @ normals.T).max(axis=-1) <= 1 + 1e-9
    if pupil.stated:
        within &= np.hypot(*np.moveaxis(offsets, -1, 0)) <= pupil.radius_px
    return np.where(within & lit[nearest], nearest, -1), points, reach


def _reconstruct(
    grid: SplineGrid, outlines: Floats, centres: Floats, measured: _Measured
) -> tuple[Floats, Floats, Floats]:
    """Return the nodes of a connected part, mean squares of its residuals, and errors at the centres.

    Values are in px times pitches, and their mean over the centres is 0.
    """
    gradients = grid.gradients(outlines)
    weighted = (gradients.T @ sparse.diags(measured.weights)).tocsc()
    normal = (weighted @ gradients + _SMOOTHNESS * grid.roughness()).tolil()
    normal[0, 0] += 1.0  # piston, which nothing else tells
    solver = splu(normal.tocsc())
    centre_values = grid.values(centres)
    slopes = len(measured.mean)
    inverse, freedom = np.empty((len(centres), slopes)), float(slopes)
    for start in range(0, slopes, _AT_ONCE):
        some = slice(start, start + _AT_ONCE)
        nodes = solver.solve(weighted[:, some].toarray())
        inverse[:, some] = centre_values @ nodes
        freedom -= float(gradients[some].multiply(nodes.T).sum())
    inverse -= inverse.mean(axis=0)
    nodes = solver.solve(weighted @ measured.mean)
    nodes -= (centre_values @ nodes).mean()  # splines sum to 1
    residuals = measured.mean - gradients @ nodes
    squares = np.square(residuals).reshape(2, -1).mean(axis=0)
    return nodes, squares, measured.errors(inverse, residuals, freedom)
