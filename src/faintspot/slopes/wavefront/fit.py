"""Wavefronts from slopes: Zernike modes fitted by least squares to valid sub-apertures, and their units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none, number_between
from faintspot.base.errors import InputError, drawn
from faintspot.base.flags import SubapertureFlag, are_valid, leave_out
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.sensor.pupil import Pupil, inside_pupil, lenslet_outlines, lit_outlines, pupil_of
from faintspot.slopes.wavefront.zernike import mean_gradients, zernike

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NM = "nm"
"""Unit of wavefronts where the layout tells the angle of a pixel and the size of the pupil."""
_POINTS = 201  # of a map along the diameter of the pupil
_NM_PER_ARCSEC_M = 1e9 * np.pi / (180 * 3600)
LARGEST_CONDITION = 100.0
"""Largest condition number of the modes' gradients, each scaled to 1: the noise amplification allowed."""
_HIGHEST_ORDER, _USUAL_CONDITION = 8, 20.0  # defaults; higher orders are rarely needed
_TILTS = 2
_SURELY = 3.0  # standard errors of the squares of the residuals
_FEWEST_SUBAPERTURES = 3  # two show no surface
_ROUNDING = 1e-9  # of lengths in radii
_LEAST_SHARE = 0.1  # of a sub-aperture's area in the pupil, below which its slope tells too little


@dataclass(frozen=True, kw_only=True, repr=False)
class Wavefront:
    """Zernike coefficients of the wavefront in one frame or several.

    The wavefront is the optical path difference minus its mean; it increases in the direction of the spots'
    displacement. All values refer to the whole disk of the pupil: a central obscuration has no modes of its
    own.
    """

    modes: NDArray[np.int64]
    """Noll indices, (k,), from 2."""
    coefficients: Floats
    """Coefficients, (n_frames, k): rms over the disk, as each mode has mean square 1; NaN if not `fitted`."""
    standard_errors: Floats
    """Standard errors of the coefficients from the slopes' noise, (n_frames, k); NaN if unknown."""
    residual_px: Floats
    """Rms of the slopes about the fitted modes, px per axis, (n_frames,)."""
    condition: float
    """Condition number of the fit with every sub-aperture that is ever valid."""
    noise_covariance: Floats
    """Covariance of one frame's coefficients from the slopes' noise, (k, k), mean over the frames; NaN if
    unknown."""
    misfit_covariance: Floats
    """Covariance of the mean coefficients from what the fitted modes leave beyond the noise, (k, k)."""
    freedom: float
    """Degrees of freedom of one frame's standard errors; infinite for those of the slopes."""
    outlines: Floats
    """Corners of the sub-apertures with valid slopes, (m, corners, 2), in radii from the pupil's centre."""
    subtracted: Wavefront | None = None
    """Wavefront of the reference, whose errors count as well."""
    unit: str
    """Unit: "nm", or "px × sub-aperture" (slopes in pixels, lengths in sub-apertures)."""
    pupil: Pupil
    left_out: str = ""
    """Line about the slopes that were left out; empty if there are none."""

    def __repr__(self) -> str:
        """Return the numbers of modes and frames, and the rms of the mean."""
        frames, fitted = len(self.coefficients), int(np.count_nonzero(self.fitted))
        rms = float(np.sqrt(np.square(self.mean).sum())) if fitted else float("nan")
        left_out = f", {self.left_out}" if self.left_out else ""
        return (
            f"Wavefront({len(self.modes)} modes from Z{self.modes[0]}, {fitted} of {frames} frames fitted, "
            f"rms of the mean {rms:.4g} {self.unit}, {len(self.outlines)} sub-apertures{left_out})"
        )

    def plot(self, axes: Axes | None = None, *, tilt: bool = True) -> Axes:
        """Draw the mean wavefront over the pupil, as `faintspot wavefront` does.

        Parameters
        ----------
        axes : matplotlib Axes, optional
            Default: new ones.
        tilt : bool
            Whether tip and tilt are shown.

        Returns
        -------
        Axes

        Raises
        ------
        MissingExtraError
            If matplotlib is not installed.
        """
        axes = drawn("slopes.wavefront.figure:plot_wavefront", self, axes, tilt=tilt)
        return axes

    @property
    def errors_from(self) -> str:
        """Source of the standard errors: "slopes", or "residuals", which hold what is not fitted, too."""
        return "slopes" if np.isinf(self.freedom) else "residuals"

    @property
    def fitted(self) -> NDArray[np.bool_]:
        """Whether enough sub-apertures were valid to separate the modes, (n_frames,)."""
        return np.asarray(np.isfinite(self.coefficients).all(axis=1))

    @property
    def mean(self) -> Floats:
        """Coefficients of the mean wavefront, (k,)."""
        mean: Floats = self.coefficients[self.fitted].mean(axis=0)
        return mean

    @property
    def mean_standard_error(self) -> Floats:
        """Standard error of the mean, (k,), from the scatter over frames (of one: its noise), and misfit."""
        error: Floats = np.sqrt(np.diag(self.mean_covariance))
        return error

    @property
    def mean_covariance(self) -> Floats:
        """Covariance of the mean's errors, (k, k), including those of the reference, and of the misfit.

        For several frames, variances are those of their scatter. Correlations are those of the scatter and,
        with the weight of k frames, those of the slopes' noise: few frames do not determine them.
        """
        own = self._own_covariance + self.misfit_covariance
        return own if self.subtracted is None else own + self.subtracted._own_covariance

    @property
    def _own_covariance(self) -> Floats:
        kept, noise = self.coefficients[self.fitted], self.noise_covariance
        frames, k = kept.shape
        if frames == 1:
            return noise
        scatter = np.cov(kept, rowvar=False)
        deviation = np.sqrt(np.diag(scatter) / frames)
        by_noise = _correlations(noise if np.isfinite(noise).all() else scatter)
        weight = k / (k + frames - 1)
        correlations = weight * by_noise + (1 - weight) * _correlations(scatter)
        covariance: Floats = correlations * np.outer(deviation, deviation)
        return covariance

    @property
    def degrees_of_freedom(self) -> Floats:
        """Degrees of freedom of `mean_standard_error`, (k,), by Welch (1947).

        The variances that weigh both parts are at least those of the slopes' noise: where a scatter of few
        frames is small by chance, it would count as better known than it is.
        """
        squares = np.sum([part**2 / freedom for part, freedom in self._parts], axis=0)
        both = self.variances**2
        return np.asarray(np.divide(both, squares, out=np.full(len(both), np.inf), where=squares > 0))

    @property
    def variances(self) -> Floats:
        """Variances of the mean, (k,), for degrees of freedom: not below those of the slopes' noise."""
        return np.asarray(np.sum([part for part, _ in self._parts], axis=0))

    @property
    def _parts(self) -> list[tuple[Floats, float]]:
        """Independent parts of `variances` with their degrees of freedom."""
        parts = [(np.diag(self.misfit_covariance), max(2.0 * len(self.outlines) - len(self.modes), 1.0))]
        for one in (self, *([] if self.subtracted is None else [self.subtracted])):
            frames = int(np.count_nonzero(one.fitted))
            noise = np.diag(one.noise_covariance) / frames
            own = np.fmax(np.diag(one._own_covariance), noise)
            parts.append((np.asarray(own), frames - 1.0 if frames > 1 else one.freedom))
        return parts

    @property
    def mean_half_width(self) -> Floats:
        """Half width of the 95 % interval of the mean, (k,), by Student's distribution."""
        width: Floats = scipy.special.stdtrit(self.degrees_of_freedom, 0.975) * self.mean_standard_error
        return width

    def is_lit(self, x: Floats, y: Floats) -> NDArray[np.bool_]:
        """Return which points (p,), in radii, lie within the disk and a sub-aperture with valid slopes."""
        points = np.stack([x, y], axis=-1)
        nearest = self.outlines[scipy.spatial.cKDTree(self.outlines.mean(axis=1)).query(points)[1]]
        edges, away = np.roll(nearest, -1, axis=1) - nearest, points[:, None] - nearest
        left = edges[..., 0] * away[..., 1] - edges[..., 1] * away[..., 0]
        return np.asarray((left >= -_ROUNDING).all(axis=1) & (np.hypot(x, y) <= 1 + _ROUNDING))

    @property
    def rms_of_frames(self) -> Floats:
        """Root mean square of each coefficient over the frames, (k,)."""
        rms: Floats = np.sqrt(np.mean(self.coefficients[self.fitted] ** 2, axis=0))
        return rms

    def rms(self, *, tilt: bool = True) -> Floats:
        """Return the rms of each frame's wavefront over the disk, (n_frames,)."""
        return total(self.coefficients, tilt=tilt)

    def sheet(self, *, points: int = _POINTS, tilt: bool = True) -> Floats:
        """Return the mean wavefront as a map over the lit pupil, (points, points), NaN outside.

        Parameters
        ----------
        points : int
            Points along the map; rows go along y, columns along x.
        tilt : bool
            Whether to include tip and tilt.
        """
        line = np.linspace(-1.0, 1.0, points)
        y, x = np.meshgrid(line, line, indexing="ij")
        inside = self.is_lit(x.ravel(), y.ravel()).reshape(x.shape)
        sheet = np.full((points, points), np.nan)
        sheet[inside] = 0.0
        start = 0 if tilt else _TILTS
        for j, value in zip(self.modes[start:], self.mean[start:], strict=True):
            sheet[inside] += value * zernike(int(j), x[inside], y[inside])
        return sheet


def _correlations(covariance: Floats) -> Floats:
    """Return the correlations of a covariance (k, k); those of constant coefficients are 0."""
    deviation = np.sqrt(np.diag(covariance))
    scale = np.outer(deviation, deviation)
    return np.asarray(np.divide(covariance, scale, out=np.eye(len(scale)), where=scale > 0))


def total(coefficients: Floats, *, tilt: bool = True) -> Floats:
    """Return the rms of wavefronts over the disk: the root sum of squares along the last axis."""
    rms: Floats = np.sqrt(np.sum(coefficients[..., 0 if tilt else _TILTS :] ** 2, axis=-1))
    return rms


def fit_wavefront(slopes: Slopes, layout: Layout, *, modes: int | None = None) -> Wavefront:
    """Fit Zernike modes to slopes, each frame by weighted least squares over its valid sub-apertures.

    The model of a slope is the mean gradient of a mode over the lenslet's square or hexagon, integrated
    exactly. Where the layout has `subaperture_m` and `diameter_m`, the pupil's edge is known: a sub-aperture
    that it cuts counts with the part inside, and by the area of that part. Otherwise each one whose centre is
    within the disk around all counts as whole.

    A slope's weight is the inverse of its variance: that of its mean standard error over the frames, and of
    the scatter that modes which are not fitted leave.

    Parameters
    ----------
    slopes : Slopes
        Slopes of one frame or several; relative to a reference, the wavefront is, too.
    layout : Layout
        With `pixel_scale_arcsec`, and `subaperture_m` or `diameter_m`, the wavefront is in nm.
    modes : int, optional
        Number of modes, from tip and tilt on. Default: all up to the highest radial order (at most 8) with no
        more than three modes for four sub-apertures whose estimates converged, and a good condition number.
        Orders that are not fitted leak into the two highest fitted ones.

    Raises
    ------
    InputError
        When slopes and layout do not fit together, no slope is valid, or the valid sub-apertures cannot
        separate so many modes.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, pixel_scale_arcsec=0.5, subaperture_m=0.6)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 5, flux_e=1000.0,
    ...     positions=np.tile([0.3, 0.0], (len(layout), 1)), rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> wavefront = fs.fit_wavefront(slopes, layout, modes=5)
    >>> tip, *others = wavefront.mean
    >>> print(f"tip {tip:.0f} nm, no other mode more than {np.abs(others).max():.0f} nm")
    tip 774 nm, no other mode more than 5 nm
    """
    x, y, flags = (np.atleast_2d(getattr(slopes, name)) for name in ("x", "y", "flags"))
    if x.ndim != 2 or x.shape[1] != len(layout):
        raise InputError(f"slopes: expected {len(layout)} sub-apertures, as in the layout, got {x.shape[-1]}")
    pupil = pupil_of(layout, flags, slopes.flux)
    outlines, share = _in_pupil(layout, pupil)
    errors = np.concatenate(
        [np.atleast_2d(getattr(slopes, f"standard_error_{axis}")) for axis in "xy"], axis=1
    )
    # Of slopes of which most have standard errors, the others are not significant.
    unsure = are_valid(flags, slopes.keep) & ~np.isfinite(errors).reshape(len(flags), 2, -1).all(axis=1)
    unsure &= 2 * np.count_nonzero(unsure) < np.count_nonzero(are_valid(flags, slopes.keep))
    others = {"outside the pupil": share < _LEAST_SHARE, "not significant": unsure}
    valid, left_out = leave_out(flags, slopes.keep, others)
    illuminated = np.asarray(valid.any(axis=0))
    if np.count_nonzero(illuminated) < _FEWEST_SUBAPERTURES:
        raise _too_few(illuminated, left_out)
    settled = (valid & (flags & int(SubapertureFlag.NOT_CONVERGED) == 0)).any(axis=0)
    gradients, condition = _chosen_gradients(modes, outlines, illuminated, int(np.count_nonzero(settled)))
    unit, scale = _unit_of(layout, pupil)
    used = np.tile(valid, 2)
    has_errors = bool(np.isfinite(errors[used]).all())
    noise = np.square(errors, dtype=np.float64), np.atleast_2d(slopes.covariance_xy).astype(np.float64)
    measured = np.concatenate([x, y], axis=1).astype(np.float64)
    coefficients, standard_errors, residual, covariance, misfit = _fit(
        measured, used, gradients, share, noise if has_errors else None
    )
    return Wavefront(
        modes=np.arange(2, 2 + gradients.shape[1]),
        coefficients=scale * coefficients,
        standard_errors=scale * standard_errors,
        residual_px=residual,
        condition=condition,
        noise_covariance=scale**2 * covariance,
        misfit_covariance=scale**2 * misfit,
        freedom=np.inf if has_errors else 2.0 * np.count_nonzero(illuminated) - gradients.shape[1],
        outlines=(lenslet_outlines(layout)[illuminated] - pupil.centre_px) / pupil.radius_px,
        unit=unit,
        pupil=pupil,
        left_out=left_out,
    )


def _unit_of(layout: Layout, pupil: Pupil) -> tuple[str, float]:
    """Return the unit of coefficients, and its value for one pixel times the disk's radius."""
    if layout.pixel_scale_arcsec is None or pupil.radius_m is None:
        return "px × sub-aperture", pupil.radius_subapertures
    return NM, layout.pixel_scale_arcsec * pupil.radius_m * _NM_PER_ARCSEC_M


def _too_few(valid: NDArray[np.bool_], left_out: str) -> InputError:
    """Return the error of slopes with too few valid sub-apertures for a wavefront."""
    return InputError(
        f"slopes: expected at least {_FEWEST_SUBAPERTURES} valid sub-apertures for a wavefront, got "
        f"{np.count_nonzero(valid)} of {len(valid)}{f' ({left_out})' if left_out else ''}"
    )


def _in_pupil(layout: Layout, pupil: Pupil) -> tuple[Floats, Floats]:
    """Return the outlines of the sub-apertures, in radii from the pupil's centre, and their shares in it."""
    if pupil.cuts:
        outlines, share = lit_outlines(layout, pupil)
    else:
        outlines, share = lenslet_outlines(layout), inside_pupil(layout, pupil).astype(np.float64)
    return (outlines - pupil.centre_px) / pupil.radius_px, share


def _chosen_gradients(
    modes: int | None, outlines: Floats, illuminated: NDArray[np.bool_], settled: int
) -> tuple[Floats, float]:
    """Return the mean gradients (2 n, k) of the modes to fit (all x, then all y) and their condition."""
    n = int(np.count_nonzero(illuminated))
    if modes is None:
        counts = [order * (order + 3) // 2 for order in range(_HIGHEST_ORDER, 0, -1)]
        counts, limit = [count for count in counts if count <= 0.75 * settled] or [_TILTS], _USUAL_CONDITION
    else:
        counts = [int(number_between("modes", modes, _TILTS, 2 * n, integer=True))]
        limit = LARGEST_CONDITION
    gradients = np.zeros((2, len(outlines), counts[0]))
    gradients[:, illuminated] = mean_gradients(np.arange(2, 2 + counts[0]), outlines[illuminated])
    gradients = np.concatenate(gradients)
    for count in counts:
        condition = _condition(gradients[np.tile(illuminated, 2), :count])
        if condition <= limit:
            return gradients[:, :count], condition
    raise InputError(
        f"modes = {count}: {n} valid sub-apertures cannot separate so many (condition number "
        f"{condition:.3g}, expected at most {LARGEST_CONDITION:g}); use fewer"
    )


def _condition(gradients: Floats) -> float:
    """Return the condition number of the modes' gradients (2 n, k), each scaled to length 1."""
    lengths = np.linalg.norm(gradients, axis=0)
    if len(gradients) < gradients.shape[1] or not lengths.all():
        return np.inf
    return float(np.linalg.cond(gradients / lengths))


def _fit(
    slopes: Floats,
    valid: NDArray[np.bool_],
    gradients: Floats,
    share: Floats,
    noise: tuple[Floats, Floats] | None,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return coefficients, standard errors, residuals' rms, covariances (noise, misfit) for a radius of 1 px.

    Frames with the same valid sub-apertures share one inverse. `noise` are the slopes' variances, all x, then
    all y, and the covariances of x and y; without it, it is estimated from the residuals.
    """
    weights = np.tile(share, 2)
    fit = _weighted_fit(slopes, valid, gradients, weights, noise)
    residual = fit[2]
    if noise is None or not np.isfinite(residual).any():
        return fit
    variance = np.where(valid, noise[0], 0.0).sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    seen = valid.any(axis=0)
    unfitted = max(float(np.nanmean(residual**2) - variance[seen].mean()), 0.0)
    weights[seen] /= variance[seen] + unfitted if unfitted > 0 else np.maximum(variance[seen], 1e-30)
    return _weighted_fit(slopes, valid, gradients, weights, noise)


def _weighted_fit(
    slopes: Floats,
    valid: NDArray[np.bool_],
    gradients: Floats,
    weights: Floats,
    noise: tuple[Floats, Floats] | None,
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return what `_fit` does for the given weights of the slopes, (2 n,)."""
    frames, k = len(slopes), gradients.shape[1]
    coefficients, standard_errors = np.full((frames, k), np.nan), np.full((frames, k), np.nan)
    residual, total_covariance, of_misfit = np.full(frames, np.nan), np.zeros((k, k)), np.zeros((k, k))
    left = np.full(slopes.shape, np.nan)
    patterns, of_frame = np.unique(np.packbits(valid, axis=1), axis=0, return_inverse=True)
    for number in range(len(patterns)):
        rows = np.flatnonzero(of_frame.ravel() == number)
        used = valid[rows[0]]
        few = np.count_nonzero(used) < 2 * _FEWEST_SUBAPERTURES
        if few or not _condition(gradients[used]) <= LARGEST_CONDITION:
            continue
        root = np.sqrt(weights[used] / weights[used].mean())
        inverse = np.linalg.pinv(root[:, None] * gradients[used]) * root
        measured = slopes[np.ix_(rows, used)]
        fitted = measured @ inverse.T
        residuals = measured - fitted @ gradients[used].T
        coefficients[rows], left[np.ix_(rows, used)] = fitted, residuals
        of_misfit += len(rows) * inverse @ inverse.T
        residual[rows] = np.sqrt(np.mean(residuals**2, axis=1))
        freedom = measured.shape[1] - k
        if noise is not None:
            along, across = np.split(inverse, 2, axis=1)
            variance = noise[0][np.ix_(rows, used)] @ (inverse**2).T
            covariance = noise[1][np.ix_(rows, used[: len(used) // 2])]
            variance = variance + 2 * covariance @ (along * across).T
            mixed = (along * covariance.sum(axis=0)) @ across.T
            total_covariance += (inverse * noise[0][np.ix_(rows, used)].sum(axis=0)) @ inverse.T
            total_covariance += mixed + mixed.T
        elif freedom > 0:
            of_slopes = np.sum((root * residuals) ** 2, axis=1, keepdims=True) / freedom
            variance = of_slopes * np.sum((inverse / root) ** 2, axis=1)
            total_covariance += of_slopes.sum() * (inverse / root) @ (inverse / root).T
        else:
            total_covariance += np.nan
            continue
        standard_errors[rows] = np.sqrt(variance)
    count = max(int(np.isfinite(residual).sum()), 1)
    misfit = _unexplained(left, k, None if noise is None else noise[0]) * of_misfit / count
    return coefficients, standard_errors, residual, total_covariance / count, misfit


def _unexplained(residuals: Floats, k: int, variances: Floats | None) -> float:
    """Return the variance of mean slopes about k fitted modes that their noise does not explain, px^2.

    Residuals are (n_frames, 2 n), NaN where not used. The noise is their scatter over frames; of one frame
    it is that of the slopes' variances, or unknown. 0 where it may be by chance.
    """
    seen = np.isfinite(residuals)
    counts = seen.sum(axis=0)
    used, frames = counts > 0, int(seen.any(axis=1).sum())
    freedom = np.count_nonzero(used) - k
    if freedom <= 0 or (frames == 1 and variances is None):
        return 0.0
    mean = np.nansum(residuals, axis=0) / np.maximum(counts, 1)
    if frames > 1:
        squares = np.where(seen, residuals - mean, 0.0) ** 2
        noise = squares.sum(axis=0) / np.maximum(counts - 1, 1) / np.maximum(counts, 1)
    else:
        noise = np.where(seen, not_none(variances), 0.0).sum(axis=0) * freedom / (freedom + k)
    total, expected = float(np.sum(mean[used] ** 2)), float(np.sum(noise[used]))
    by_chance = 1 + _SURELY * np.sqrt(2 / freedom * (1 if frames == 1 else frames / (frames - 1)))
    return (total - expected) / freedom if total > by_chance * expected else 0.0
