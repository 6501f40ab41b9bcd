"""Slope discrepancy: the part of slopes that no wavefront can cause, a check of noise and calibration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout

_NEGLIGIBLE = 1e-9  # of the largest singular value


@dataclass(frozen=True)
class Discrepancy:
    """Part of the slopes that is not the gradient of any wavefront."""

    rms_px: Floats
    """Rms per slope that can be compared, (n_frames,): equals the noise's rms if there is only noise."""
    expected_px: Floats
    """Rms expected from the slopes' standard errors, (n_frames,); NaN if they are not known."""
    degrees_of_freedom: int
    """Number of combinations of slopes that no wavefront causes."""

    @property
    def ratio(self) -> float:
        """Measured over expected, as mean squares over all frames; 1 for noise alone."""
        return float(np.sqrt(np.mean(self.rms_px**2) / np.mean(self.expected_px**2)))


def slope_discrepancy(slopes: Slopes, layout: Layout) -> Discrepancy:
    """Return the part of the slopes that is not a gradient, frame by frame.

    The wavefront is modelled by a phase at the corners of the sub-apertures (Fried 1977, JOSA 67, 370), for
    which the sum of slopes around a closed path is 0. The remainder is noise, or an error of the slopes:
    centroid gains that differ between x and y or between sub-apertures (above all in quad cells), wrong
    references, a rotation of the lenslets against the detector, scintillation.

    Parameters
    ----------
    slopes : Slopes
        Slopes of one frame or several, relative to their reference.
    layout : Layout
        Layout with square geometry.

    Raises
    ------
    InputError
        When slopes and layout do not fit together, or every combination of slopes is that of a wavefront.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import slope_discrepancy
    >>> rng = np.random.default_rng(1)
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 200, position_range_px=0.0, rng=rng
    ... )
    >>> settings = fs.Settings("window", flux_e=100.0, spot_fwhm_px=1.8)
    >>> slopes = fs.SlopePipeline(layout, settings, fs.Calibration(read_noise_e=0.1))(frames)
    >>> discrepancy = slope_discrepancy(slopes, layout)
    >>> print(f"{discrepancy.ratio:.1f} times what noise leaves")
    1.0 times what noise leaves
    """
    if layout.geometry != "square":
        raise InputError(f"layout.geometry: expected 'square' for a discrepancy, got {layout.geometry!r}")
    vector, valid = np.atleast_2d(slopes.vector).astype(np.float64), np.atleast_2d(slopes.measured)
    if vector.shape[1] != 2 * len(layout):
        n = vector.shape[1] // 2
        raise InputError(f"slopes: expected {len(layout)} sub-apertures, as in the layout, got {n}")
    used = np.tile(valid.all(axis=0), 2)
    basis = not_gradients(layout.cells, used)
    if not basis.shape[1]:
        raise InputError("slopes: expected more valid sub-apertures; these cannot show a discrepancy")
    errors = np.concatenate(
        [np.atleast_2d(getattr(slopes, f"standard_error_{axis}")) for axis in "xy"], axis=1
    )[:, used].astype(np.float64)
    covariance = np.atleast_2d(slopes.covariance_xy)[:, used[: len(used) // 2]].astype(np.float64)
    degrees = basis.shape[1]
    with np.errstate(invalid="ignore"):
        squares = (errors**2) @ (basis**2).sum(axis=1)
        x, y = np.split(basis, 2)
        squares += 2 * covariance @ (x * y).sum(axis=1)
        expected = np.sqrt(squares / degrees)
    parts = vector[:, used] @ basis
    rms = np.sqrt((parts**2).sum(axis=1) / degrees)
    return Discrepancy(rms, np.where(np.isfinite(expected), expected, np.nan), degrees)


def not_gradients(cells: NDArray[np.int64], used: NDArray[np.bool_]) -> Floats:
    """Return an orthonormal basis (slopes used, k) of the slopes that no phase at the corners causes.

    Parameters
    ----------
    cells : (n, 2) array of int
        Row and column of each sub-aperture in the lenslet array.
    used : (2 n,) array of bool
        Slopes, all x, then all y, that are compared.
    """
    gradients = _corner_gradients(cells)[used]
    if not len(gradients):
        return np.zeros((0, 0))
    vectors, size, _ = np.linalg.svd(gradients, full_matrices=True)
    rank = int(np.count_nonzero(size > _NEGLIGIBLE * size[0]))
    basis: Floats = vectors[:, rank:]
    return basis


def _corner_gradients(cells: NDArray[np.int64]) -> Floats:
    """Return the slopes (2 n, corners) of a phase of 1 at each corner of the illuminated sub-apertures."""
    rows, columns = cells.T
    cell_corners = np.stack([[rows + down, columns + right] for down in (0, 1) for right in (0, 1)])
    corners, index = np.unique(cell_corners.transpose(0, 2, 1).reshape(-1, 2), axis=0, return_inverse=True)
    top_left, top_right, bottom_left, bottom_right = index.reshape(4, -1)
    n = len(cells)
    gradients = np.zeros((2 * n, len(corners)))
    indices = np.arange(n)
    for corner, x, y in (
        (top_left, -0.5, -0.5),
        (top_right, 0.5, -0.5),
        (bottom_left, -0.5, 0.5),
        (bottom_right, 0.5, 0.5),
    ):
        gradients[indices, corner] += x
        gradients[n + indices, corner] += y
    return gradients
