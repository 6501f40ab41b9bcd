"""Certificate of a mean wavefront (PV, rms, vergence, Strehl ratio, 95 % intervals); drift of its modes.

Noise adds to PV and rms. Both are sizes f of the wavefront: the true one is taken as g times the measured
one, and each draw e of the errors gives the g for which f(g measured + e) is what was measured. Quantiles of
these g limit the interval: a test is inverted by parametric draws (Efron and Tibshirani 1993, An Introduction
to the Bootstrap).
"""

from dataclasses import dataclass

import numpy as np
import scipy

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.statistics import SEED, UNKNOWN, Estimate
from faintspot.slopes.wavefront.fit import NM, Wavefront
from faintspot.slopes.wavefront.zernike import zernike

_POINTS, _COARSE = 200, 70  # along the diameter, for the rms and for PV
_AROUND = 256  # points on the edge of the disk
_ALONG = np.linspace(0.0, 1.0, 5)  # points on a side of a sub-aperture at the edge of the lit pupil
_DRAWS, _PV_EVERY = 10_000, 10
_STEPS = 8  # of Newton's method; PV is piecewise linear in g, 4 are enough nearly always
_AS_NORMAL = 1e6  # degrees of freedom
_CLOSE = 1e-4  # relative difference of PV at which a step is the last
_LOW, _HIGH = 0.025, 0.975
_DEFOCUS = 2  # index of Z4


@dataclass(frozen=True, kw_only=True)
class Certificate:
    """PV, rms, vergence and Strehl ratio of a mean wavefront over the lit pupil, each with its 95 % interval.

    The numbers are those of the fitted modes alone. Without tilt means about the best plane, without focus
    about the best paraboloid, both over the lit pupil. Intervals hold if the errors of the modes are normal.
    A number that is not known is NaN.
    """

    pv: Estimate
    """Largest minus smallest value, in the unit of the wavefront; median over draws of the errors."""
    pv_without_tilt: Estimate
    pv_without_focus: Estimate
    rms: Estimate
    """Rms about the mean, in the unit of the wavefront, from which the noise power was subtracted."""
    rms_without_tilt: Estimate
    rms_without_focus: Estimate
    vergence_per_m: Estimate
    """Curvature 4 sqrt(3) Z4 / radius^2 [1/m], positive where spots are displaced outwards."""
    radius_of_curvature_m: Estimate
    """Inverse of the vergence [m]; NaN unless its interval excludes 0."""
    strehl: Estimate
    """exp(-(2 pi rms / wavelength)^2) without tilt (Mahajan 1983, JOSA 73, 860), good from about 0.3."""
    strehl_without_focus: Estimate
    """The same at the best focus."""
    wavelength_nm: float | None


def certify(wavefront: Wavefront, *, wavelength_nm: float | None = None, draws: int = _DRAWS) -> Certificate:
    """Return the numbers of a certificate of the mean wavefront.

    The errors are those of `Wavefront.mean_covariance`, including those of a reference.

    Parameters
    ----------
    wavefront : Wavefront
        Fit of one frame, or of several of a wavefront that does not move.
    wavelength_nm : float, optional
        Wavelength of the Strehl ratio.
    draws : int
        Draws of the errors; PV takes one in ten.

    Raises
    ------
    InputError
        If the wavelength is below 1 nm, or there are fewer than 100 draws.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import certify
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, pixel_scale_arcsec=0.5, subaperture_m=0.6)
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 5, flux_e=1000.0,
    ...     positions=np.tile([0.3, 0.0], (len(layout), 1)), rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> found = certify(fs.fit_wavefront(slopes, layout, modes=5), wavelength_nm=633.0)
    >>> print(f"rms {found.rms.value:.0f} nm, from {found.rms.low:.0f} to {found.rms.high:.0f} nm")
    rms 749 nm, from 744 to 755 nm
    """
    if wavelength_nm is not None:
        number_between("wavelength_nm", wavelength_nm, 1.0)
    errors = _errors(wavefront, int(number_between("draws", draws, 100, integer=True)))
    numbers = [1, *wavefront.modes.tolist()]
    numbers += [4] if len(numbers) < 4 else []
    points = _lit_points(wavefront, _COARSE, with_edge=True), _lit_points(wavefront, _POINTS)
    coarse, fine = (np.stack([zernike(j, *xy.T) for j in numbers], axis=-1) for xy in points)
    products, used = fine.T @ fine / len(fine), slice(1, 1 + len(wavefront.modes))
    sizes: dict[str, Estimate] = {}
    for name, removed in {"": 1, "_without_tilt": 3, "_without_focus": 4}.items():
        share = np.linalg.solve(products[:removed, :removed], products[:removed])
        left = (products - products[:, :removed] @ share)[used, used]
        sizes[f"rms{name}"] = _rms(left, wavefront, errors)
        modes = (coarse - coarse[:, :removed] @ share)[:, used]
        sizes[f"pv{name}"] = _pv(modes, wavefront, errors[::_PV_EVERY])
    strehl = {
        f"strehl{name}": _strehl(sizes[f"rms_without_{part}"], wavelength_nm, wavefront.unit)
        for name, part in {"": "tilt", "_without_focus": "focus"}.items()
    }
    vergence = _vergence(wavefront)
    return Certificate(
        **sizes,
        **strehl,
        vergence_per_m=vergence,
        radius_of_curvature_m=_inverse(vergence),
        wavelength_nm=wavelength_nm,
    )


def _errors(wavefront: Wavefront, draws: int) -> Floats:
    """Draw normal errors of the mean, (draws, k); NaN if unknown."""
    covariance = wavefront.mean_covariance
    if not np.isfinite(covariance).all():
        return np.full((draws, len(covariance)), np.nan)
    values, vectors = np.linalg.eigh(covariance)
    normal = np.random.default_rng(SEED).standard_normal((draws, len(values)))
    errors: Floats = normal * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
    return errors


def _with_tails(errors: Floats, direction: Floats, wavefront: Wavefront) -> Floats:
    """Return errors (draws, k) with the tails of Student's distribution in a direction of the coefficients.

    Its degrees of freedom are those of a sum of the modes' errors (Welch 1947, Biometrika 34, 28).
    """
    parts = direction**2 * wavefront.variances
    squares = np.sum(parts**2 / wavefront.degrees_of_freedom)
    freedom = parts.sum() ** 2 / squares if squares > 0 else np.inf
    if not freedom < _AS_NORMAL:
        return errors
    chi_square = np.random.default_rng(SEED + 1).chisquare(freedom, (len(errors), 1))
    scaled: Floats = errors * np.sqrt(freedom / chi_square)
    return scaled


def _lit_points(wavefront: Wavefront, count: int, *, with_edge: bool = False) -> Floats:
    """Return points (p, 2) of a grid over the lit pupil, and perhaps of its edge."""
    line = (np.arange(count) + 0.5) * 2 / count - 1  # an edge on points would count too much
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    if with_edge:
        angle = np.linspace(0.0, 2 * np.pi, _AROUND, endpoint=False)
        begin = wavefront.outlines
        side = np.roll(begin, -1, axis=1) - begin
        beyond = begin + 0.5 * side + 0.01 * side[..., ::-1] * (1.0, -1.0)
        free = ~wavefront.is_lit(*beyond.reshape(-1, 2).T).reshape(begin.shape[:2])
        along = begin[free] + _ALONG[:, None, None] * side[free]
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        points = np.concatenate([points, circle, along.reshape(-1, 2)])
    lit: Floats = points[wavefront.is_lit(*points.T)]
    return lit


def _rms(products: Floats, wavefront: Wavefront, errors: Floats) -> Estimate:
    """Return the rms of the true coefficients c, root of c @ products @ c, from their measured mean."""
    mean, covariance = wavefront.mean, wavefront.mean_covariance
    square = float(mean @ products @ mean)
    errors = _with_tails(errors, products @ mean, wavefront)
    noise = errors @ products
    of_noise, along = np.sum(noise * errors, axis=1), noise @ mean / np.sqrt(max(square, 1e-300))
    value = np.sqrt(max(square - float(np.trace(products @ covariance)), 0.0))
    # Below the noise, an interval could be empty: then the limit is that of a typical measurement.
    root = along**2 - of_noise + max(square, float(np.median(of_noise)))
    sizes = np.where(root > 0, np.sqrt(np.maximum(root, 0.0)) - along, 0.0)
    return _estimate(np.maximum(sizes, 0.0), float(value))


def _pv(modes: Floats, wavefront: Wavefront, errors: Floats) -> Estimate:
    """Return the PV of modes @ c for the true coefficients c, by Newton's method from above."""
    surface = (modes @ wavefront.mean).astype(np.float32)
    direction = modes[surface.argmax()] - modes[surface.argmin()]
    noise = (_with_tails(errors, direction, wavefront) @ modes.T).astype(np.float32)
    measured = float(np.ptp(surface))
    if not (measured > 0 and np.isfinite(noise).all()):
        return Estimate(measured)
    rows, factor = np.arange(len(noise)), np.full(len(noise), 2.0)
    found = max(measured, float(np.median(np.ptp(noise, axis=1))))
    for _ in range(_STEPS):
        drawn = np.multiply.outer(factor.astype(np.float32), surface)
        drawn += noise
        high, low = drawn.argmax(axis=1), drawn.argmin(axis=1)
        excess = drawn[rows, high] - drawn[rows, low] - found
        solved = np.abs(excess) < _CLOSE * found
        if solved.all():
            break
        slope = surface[high] - surface[low]
        factor = np.where(slope > 0, factor - excess / np.where(slope > 0, slope, 1.0), 0.0)
    sizes = measured * np.where(solved, np.maximum(factor, 0.0), 0.0)
    return _estimate(sizes, float(np.median(sizes)))


def _estimate(sizes: Floats, value: float) -> Estimate:
    if not np.isfinite(sizes).all():
        return Estimate(value)
    low, high = np.quantile(sizes, [_LOW, _HIGH])
    return Estimate(value, float(sizes.std()), float(low), float(high))


def _strehl(rms: Estimate, wavelength_nm: float | None, unit: str) -> Estimate:
    """Return the Strehl ratio of an rms; not known without its wavelength, or where the rms is not in nm."""
    if wavelength_nm is None or unit != NM:
        return UNKNOWN
    phase = 2 * np.pi / wavelength_nm * np.array([rms.value, rms.high, rms.low])
    value, low, high = np.exp(-(phase**2)).tolist()
    return Estimate(
        value, float(2 * phase[0] * value * 2 * np.pi / wavelength_nm * rms.standard_error), low, high
    )


def _vergence(wavefront: Wavefront) -> Estimate:
    radius = wavefront.pupil.radius_m
    if wavefront.unit != NM or radius is None or len(wavefront.modes) <= _DEFOCUS:
        return UNKNOWN
    scale = 4 * np.sqrt(3) * 1e-9 / radius**2
    widths = wavefront.mean, wavefront.mean_standard_error, wavefront.mean_half_width
    value, error, half = (float(scale * values[_DEFOCUS]) for values in widths)
    return Estimate(value, error, value - half, value + half)


def _inverse(vergence: Estimate) -> Estimate:
    """Return the radius of curvature of a vergence whose interval excludes 0."""
    if not vergence.low * vergence.high > 0:
        return UNKNOWN
    value = 1 / vergence.value
    return Estimate(value, value**2 * vergence.standard_error, 1 / vergence.high, 1 / vergence.low)


_FEWEST_BINS, _S_PER_H = 3, 3600.0


@dataclass(frozen=True)
class Drift:
    """Modes of a recording against time."""

    time: Floats
    """Middle of each bin, (bins,), in hours or frames after the first."""
    mean: Floats
    """Mean coefficients of each bin, (bins, k)."""
    standard_error: Floats
    """Their standard errors, (bins, k), from the scatter of the frames of the bin."""
    rate: Floats
    """Linear drift of each mode per hour or frame, (k,)."""
    rate_standard_error: Floats
    """Its standard error, (k,), from the scatter of the bins about the line."""
    rate_half_width: Floats
    """Half width of its 95 % interval, (k,), by Student's distribution."""
    time_unit: str
    """Unit of time: "h" or "frame"."""


def fit_drift(wavefront: Wavefront, bins: int, *, frame_rate_hz: float | None = None) -> Drift:
    """Average modes over bins of successive frames, and fit a line to the means.

    Frames need not be independent within a bin for the error of the line, as it comes from the scatter of the
    bins; that of a bin's mean takes them as independent.

    Parameters
    ----------
    wavefront : Wavefront
        Fit of the frames of a recording.
    bins : int
        Number of bins, 3 or more, with at least two fitted frames each.
    frame_rate_hz : float, optional
        Frame rate; without it, time is counted in frames.

    Raises
    ------
    InputError
        If there are too few frames, or a value is out of range.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.wavefront import fit_drift
    >>> layout = fs.Layout.grid((7, 7), pixels=8, outer_radius=3.5, pixel_scale_arcsec=0.5, subaperture_m=0.6)
    >>> along_x = np.linspace(0.0, 0.5, 40)[:, None, None] * [1.0, 0.0]
    >>> frames, _ = fs.slopes.simulate.sensor_frames(
    ...     layout, 40, flux_e=1000.0, positions=along_x * np.ones((len(layout), 1)),
    ...     rng=np.random.default_rng(1),
    ... )
    >>> slopes = fs.SlopePipeline(layout, fs.Settings("brightest", keep_brightest=30))(frames)
    >>> drift = fit_drift(fs.fit_wavefront(slopes, layout, modes=5), 8)
    >>> print(f"tip {drift.rate[0]:.0f} nm per {drift.time_unit}")
    tip 32 nm per frame
    """
    fitted = np.flatnonzero(wavefront.fitted)
    if len(fitted) < 2 * _FEWEST_BINS:
        raise InputError(f"slopes: expected at least {2 * _FEWEST_BINS} fitted frames, got {len(fitted)}")
    bins = int(number_between("bins", bins, _FEWEST_BINS, len(fitted) // 2, integer=True))
    unit, per_frame = "frame", 1.0
    if frame_rate_hz is not None:
        unit, per_frame = "h", 1 / (_S_PER_H * number_between("frame_rate_hz", frame_rate_hz, 1e-6))
    groups = np.array_split(fitted, bins)
    kept = [wavefront.coefficients[group] for group in groups]
    time = per_frame * np.array([group.mean() for group in groups])
    mean = np.stack([values.mean(axis=0) for values in kept])
    error = np.stack([values.std(axis=0, ddof=1) / np.sqrt(len(values)) for values in kept])
    since = time - time.mean()
    rate = since @ mean / (since @ since)
    residual = mean - mean.mean(axis=0) - np.outer(since, rate)
    rate_error = np.sqrt(np.sum(residual**2, axis=0) / (bins - 2) / (since @ since))
    half_width = scipy.special.stdtrit(bins - 2, 0.975) * rate_error
    return Drift(time, mean, error, rate, rate_error, half_width, unit)
