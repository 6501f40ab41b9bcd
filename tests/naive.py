"""The slow, obvious oracle: every step of the pipeline in plain NumPy, float64, one image at a time.

Written from the definitions, not from the kernels, so that a mistake in one does not hide in the other.
"""

from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

import faintspot as fs

Floats = NDArray[np.float64]
Flag = fs.SubapertureFlag


# Total variation ------------------------------------------------------------------------------------


def gradient(u: Floats) -> tuple[Floats, Floats]:
    """Forward differences along x and y; zero across the far edges (Neumann)."""
    gx, gy = np.zeros_like(u), np.zeros_like(u)
    gx[:, :-1] = u[:, 1:] - u[:, :-1]
    gy[:-1, :] = u[1:, :] - u[:-1, :]
    return gx, gy


def divergence(px: Floats, py: Floats) -> Floats:
    """Minus the adjoint of `gradient`: sum(gradient(u) * p) == -sum(u * divergence(p)).

    The last column of px and the last row of py meet a zero gradient and do not count.
    """
    d = np.zeros_like(px)
    d[:, :-1] += px[:, :-1]
    d[:, 1:] -= px[:, :-1]
    d[:-1, :] += py[:-1, :]
    d[1:, :] -= py[:-1, :]
    return d


def total_variation(u: Floats) -> float:
    gx, gy = gradient(np.asarray(u, np.float64))
    return float(np.sum(np.sqrt(gx**2 + gy**2)))


@dataclass
class Denoised:
    image: Floats
    iterations: int = 0
    multiplier: float = 0.0
    converged: bool = True
    infeasible: bool = False
    dual: tuple[Floats, Floats] | None = None
    margin: float = np.inf
    """How near a decision (feasible, converged) came to the other one: the smallest |left / right - 1|."""


def tv_denoise(
    g: ArrayLike,
    noise_std: float,
    algorithm: str = "fgp",
    tolerance: float = 2.5e-3,
    max_iterations: int = 480,
    lower: bool = False,
) -> Denoised:
    """Constrained TV of one image: minimise TV(u) subject to ||u - g||^2 = N noise_std^2.

    `lower`: a strength above 0.9 of the image's rms becomes 0.6 of that.
    """
    g = np.asarray(g, np.float64)
    mean = g.mean()
    scale = np.max(np.abs(g - mean))  # only against overflow and underflow of squares
    if noise_std == 0.0:
        return Denoised(g.copy())
    if g.min() == g.max():
        return Denoised(g.copy(), multiplier=np.inf, infeasible=True)
    gc = (g - mean) / scale
    strength = noise_std / scale
    rms = np.sqrt(np.mean(gc**2))
    margin = abs(strength / (0.9 * rms if lower else rms) - 1.0)
    lowered = lower and strength > 0.9 * rms
    if lowered:
        strength = 0.6 * rms
    elif rms <= strength:
        return Denoised(np.full_like(g, mean), multiplier=np.inf, infeasible=True, margin=margin)
    radius = np.sqrt(g.size) * strength
    p, multiplier = flat_field(gc, strength)
    previous, then = p, divergence(*p)
    age, momentum, converged = 4.0, 0.0, False
    for iteration in range(1, max_iterations + 1):
        if algorithm == "fgp":
            q = (p[0] + momentum * (p[0] - previous[0]), p[1] + momentum * (p[1] - previous[1]))
        else:
            q = p
        d = divergence(*q)
        gx, gy = gradient(d - gc / multiplier)
        if algorithm == "fgp":
            new = (q[0] + gx / 8, q[1] + gy / 8)
            shrink = np.maximum(1.0, np.hypot(*new))
        else:
            new = (q[0] + gx / 4, q[1] + gy / 4)
            shrink = 1.0 + np.hypot(gx, gy) / 4
        previous, p = p, (new[0] / shrink, new[1] / shrink)
        if algorithm == "chambolle":  # with an old norm the multiplier would oscillate
            d = divergence(*p)
        next_age = (1.0 + np.sqrt(1.0 + 4.0 * age**2)) / 2
        momentum, age = (age - 1.0) / next_age, next_age
        if np.linalg.norm(d) > 0:
            multiplier = radius / np.linalg.norm(d)
        if iteration % 24 == 0:
            d = divergence(*p)
            change = np.linalg.norm(d - then)
            then = d
            bound = tolerance * np.linalg.norm(d - gc / multiplier)
            if bound > 0:
                margin = min(margin, abs(change / bound - 1.0))
            if tolerance > 0 and change <= bound:
                converged = True
                break
    d = divergence(*p)
    multiplier = radius / np.linalg.norm(d)
    image = mean + scale * (gc - multiplier * d)
    return Denoised(image, iteration, multiplier * scale, converged, lowered, p, margin)


def second_difference(n: int) -> Any:
    """The divergence of the gradient along one axis."""
    middle = np.full(n, -2.0)
    middle[0] += 1.0
    middle[-1] += 1.0
    return sparse.diags([np.ones(n - 1), middle, np.ones(n - 1)], [-1, 0, 1])


def flat_field(g: Floats, strength: float) -> tuple[tuple[Floats, Floats], float]:
    """The dual field that a solution without structure has, cut to length 1, and its multiplier."""
    along_y, along_x = (second_difference(n) for n in g.shape)
    laplacian = sparse.kronsum(along_x, along_y, format="csc")
    potential = np.zeros(g.size)  # up to a constant, so that of one pixel is chosen
    potential[1:] = spsolve(laplacian[1:, 1:], g.ravel()[1:])
    field = gradient(potential.reshape(g.shape))
    radius = np.sqrt(g.size) * strength

    def cut(multiplier: float) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        px, py = field[0] / multiplier, field[1] / multiplier
        length = np.maximum(1.0, np.hypot(px, py))
        return px / length, py / length, length == 1.0

    # Newton's step for f = ||div p|| - radius / lambda = 0 in the inverse multiplier.
    inverse = 1.0 / (1.6 * strength)
    px, py, free = cut(1.0 / inverse)
    d = divergence(px, py)
    norm = np.linalg.norm(d)
    slope = np.sum(d * divergence(px * free, py * free)) / (norm * inverse)
    step = (norm - radius * inverse) / max(radius - slope, 0.3 * radius)
    inverse = float(np.clip(inverse + step, inverse / 4, inverse * 4))
    return cut(1.0 / inverse)[:2], 1.0 / inverse


# Background and centroid ----------------------------------------------------------------------------


def brightest_pixels(g: ArrayLike, keep: int, rule: str = "subtract_next") -> NDArray[Any]:
    """Keep the brightest pixels of one image, in its own dtype."""
    g = np.asarray(g)
    descending = np.sort(g.ravel())[::-1]
    if rule == "subtract_next":
        return np.asarray(np.maximum(g - descending[keep], g.dtype.type(0)))
    kth = descending[keep - 1]
    if rule == "threshold":
        return np.asarray(np.where(g >= kth, g, g.dtype.type(0)))
    return np.asarray(np.maximum(g - kth, g.dtype.type(0)))


def centre_of_gravity(g: ArrayLike) -> tuple[float, float]:
    g = np.asarray(g, np.float64)
    ny, nx = g.shape
    total = g.sum()
    if not total > 0:
        return 0.0, 0.0
    x = np.sum(g * (np.arange(nx) - (nx - 1) / 2)) / total
    y = np.sum(g * (np.arange(ny) - (ny - 1) / 2)[:, None]) / total
    return float(x), float(y)


# Sensor ---------------------------------------------------------------------------------------------


def calibrate(frame: ArrayLike, calibration: fs.Calibration) -> Floats:
    """From ADU to electrons; NaN where a pixel is bad."""
    raw = np.asarray(frame).astype(np.float64)
    electrons = np.full(raw.shape, np.nan)
    for i, j in np.ndindex(raw.shape):
        level = np.asarray(0.0 if calibration.dark is None else calibration.dark)
        dark = level[i, j] if level.ndim else level
        flat = 1.0 if calibration.flat is None else calibration.flat[i, j]
        noise = calibration.read_noise_e
        if isinstance(noise, np.ndarray) and np.isnan(noise[i, j]):
            continue
        if not (np.isfinite(raw[i, j]) and np.isfinite(dark) and np.isfinite(flat) and flat > 0):
            continue
        value = (raw[i, j] - dark) * calibration.gain_e_per_adu / (calibration.em_gain * flat)
        if abs(value) <= 1e30:
            electrons[i, j] = value
    bad = calibration.bad_pixels
    if bad is not None and bad.dtype == bool:
        electrons[bad] = np.nan
    elif bad is not None:
        for i, j in bad.tolist():
            electrons[i, j] = np.nan
    return electrons


def fill_bad_pixels(image: Floats) -> Floats:
    """NaN becomes the mean of the good ones of its 8 neighbours, else of all good pixels, else 0."""
    filled = image.copy()
    for i, j in np.argwhere(np.isnan(image)):
        near = image[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
        near = near[~np.isnan(near)]
        every = image[~np.isnan(image)]
        filled[i, j] = near.mean() if near.size else every.mean() if every.size else 0.0
    return filled


@dataclass
class Slope:
    x: float
    y: float
    flux: float
    flags: int
    iterations: int
    bad_pixels: int
    denoised: Denoised


def slopes(
    frame: ArrayLike,
    layout: fs.Layout,
    settings: fs.Settings,
    calibration: fs.Calibration | None = None,
    reference: ArrayLike | None = None,
) -> list[Slope]:
    """The whole pipeline for one frame (h, w); reference is (n, 2)."""
    calibration = fs.Calibration() if calibration is None else calibration
    frame = np.asarray(frame)
    electrons = calibrate(frame, calibration)
    level = calibration.saturation_adu
    if level is None and frame.dtype.kind in "iu":
        level = float(np.iinfo(frame.dtype).max)
    n, (ny, nx) = len(layout), layout.window
    results = []
    for s in range(n):
        row, column = layout.corners[s]
        window = (slice(row, row + ny), slice(column, column + nx))
        value = {
            name: settings.values(name, n, ny * nx)[s]
            for name in ("keep_brightest", "rule", "flux_floor", "max_bad_fraction")
        }
        image = electrons[window]
        bad = int(np.isnan(image).sum())
        flags = 0
        if level is not None and np.any(frame[window] >= level):
            flags |= Flag.SATURATED
        if bad > value["max_bad_fraction"] * ny * nx:
            flags |= Flag.TOO_MANY_BAD_PIXELS
        denoised = _denoised(fill_bad_pixels(image), settings, s, n)
        if denoised.infeasible:
            flags |= Flag.INFEASIBLE_STRENGTH
        if not denoised.converged:
            flags |= Flag.NOT_CONVERGED
        results.append(_spot_fits(denoised, value, flags, bad, layout.centres[s], layout.corners[s]))
        if reference is not None and results[-1].flags & (Flag.NO_FLUX | Flag.TOO_MANY_BAD_PIXELS) == 0:
            results[-1].x -= float(np.asarray(reference)[s, 0])
            results[-1].y -= float(np.asarray(reference)[s, 1])
    return results


@dataclass
class Light:
    """Which sub-apertures of a frame are dark, and of which rounding may decide."""

    dark: NDArray[np.bool_]
    unsure: NDArray[np.bool_]


def light(
    frame: ArrayLike,
    layout: fs.Layout,
    calibration: fs.Calibration,
    fwhm: float,
    flux: ArrayLike,
    measured: ArrayLike,
) -> Light:
    """Judge the windows of one frame; `flux` and `measured` (n,) are those of its slopes."""
    n, (ny, nx) = len(layout), layout.window
    flux, none = np.asarray(flux, np.float64), np.zeros(n, bool)
    box = box_of(layout.window, fwhm)
    sampled = [i * n // min(n, 32) for i in range(min(n, 32))]
    bright = sorted((s for s in sampled if np.asarray(measured)[s] and flux[s] > 0), key=lambda s: -flux[s])
    typical = bright[len(sampled) // 16 :][:3]
    if box == 0 or not typical:
        return Light(none, none)
    electrons = calibrate(frame, calibration)
    windows = np.stack([electrons[y : y + ny, x : x + nx] for y, x in layout.corners])
    several = [(2 * i + 1) * n // (2 * min(n, 16)) for i in range(min(n, 16))]
    several = [s for s in several if np.asarray(measured)[s]]
    rows = np.abs(windows[several][:, [0, ny - 2]] - windows[several][:, [1, ny - 1]])
    known = [np.nanmean(each) for each in rows if not np.isnan(each).all()]
    noise = 0.5 * np.sqrt(np.pi) * np.median(known) if known else 0.0
    if noise == 0:
        return Light(none, none)
    unit = noise * np.sqrt(box**2 + 0.2982 * box**4 / ((ny + nx) / 2))
    peaks = np.array([peak_in_box(window, box) for window in windows])
    needed = max(50 * unit, 100)
    trials = ny * nx * min(8 / box**2, 1)
    limit = NormalDist().inv_cdf(0.999 ** (1 / trials)) * unit
    suspect = (flux < 0.5 * flux[typical[len(typical) // 2]]) & np.asarray(measured)
    many = 2 * np.count_nonzero(peaks[typical] >= needed) > len(typical)
    near = np.any(np.abs(peaks[typical] / needed - 1) < 0.01)
    return Light(suspect & many & (peaks < limit), suspect & (near | (np.abs(peaks / limit - 1) < 0.01)))


def box_of(window: tuple[int, int], fwhm: float) -> int:
    """The odd side of a box that holds most of a spot and fits twice into the window."""
    if min(window) < 4:
        return 0
    return min(range(1, min(window) // 2 + 1, 2), key=lambda side: abs(side - max(1.25 * fwhm, 3.0)))


def peak_in_box(window: Floats, box: int) -> float:
    """The largest sum over a box of pixels above the border; infinite if a side has no good pixel."""
    sides = window[0], window[-1], window[:, 0], window[:, -1]
    if any(np.isnan(side).all() for side in sides):
        return np.inf
    above = np.nan_to_num(window - np.median([np.nanmean(side) for side in sides]))
    ny, nx = window.shape
    boxes = [above[y : y + box, x : x + box] for y in range(ny - box + 1) for x in range(nx - box + 1)]
    return float(max(each.sum() for each in boxes))


def doubtful(
    measured: fs.Slopes, layout: fs.Layout, fwhm: ArrayLike, reference: ArrayLike | float = 0.0
) -> NDArray[np.int64]:
    """Flags of the spots of one frame that their window cuts, or that are unlike all their neighbours.

    fwhm and reference are (n, 2).
    """
    n, half = len(layout), np.array(layout.window[::-1]) / 2
    slopes = np.column_stack([measured.x, measured.y]).astype(np.float64)
    places = slopes + layout.offsets + np.asarray(reference, np.float64)
    pitch = layout.pitch_px or 0.0
    usual, least = np.full(n, np.nan), np.full(n, np.nan)
    for s in np.flatnonzero(measured.measured).tolist():
        away = [
            (slopes[s] - weight * slopes[a] - (1 - weight) * slopes[b], 1 + weight**2 + (1 - weight) ** 2)
            for a, b, weight in in_line(layout, s)
            if measured.measured[a] and measured.measured[b]
        ]
        if away:
            usual[s] = np.sqrt(min((x**2 + y**2) / variance for (x, y), variance in away))
            least[s] = min(np.hypot(*each) for each, _ in away)
    several = np.sort(usual[~np.isnan(usual)])
    typical = float(several[(len(several) - 1) // 2]) if several.size else 0.0
    flags, second = np.zeros(n, np.int64), np.zeros(n, bool)
    least_px = min(0.1 * pitch, 0.3)
    for s in np.flatnonzero(measured.measured).tolist():
        beside = {i for *pair, _ in in_line(layout, s) for i in pair if measured.measured[i]}
        brightest = float(max((measured.flux[i] for i in beside), default=0.0))
        excess, both = float(measured.flux[s]) - brightest, float(measured.flux[s]) + brightest
        quarter = float(min((measured.flux[i] for i in beside), default=0.0)) / 4
        lack, photons = quarter - float(measured.flux[s]), quarter / 4 + float(measured.flux[s])
        saturated = int(measured.flags[s]) & int(Flag.SATURATED)
        second[s] = not saturated and 0 < brightest < measured.flux[s] / 1.25 and excess > 4 * both**0.5
        apart = 4 * quarter - float(measured.flux[s]) > brightest - 4 * quarter
        second[s] |= not saturated and apart and lack > 4 * max(photons, 0.0) ** 0.5  # a ghost
        whole = half - np.broadcast_to(fwhm, (n, 2))[s] / 2
        if np.any((np.abs(places[s]) > whole) & (whole > half / 2)):
            flags[s] |= int(Flag.AT_SEARCH_LIMIT)
        if pitch and least[s] > least_px and usual[s] > (1.5 if second[s] else 4.5) * typical:
            flags[s] |= int(Flag.UNLIKE_NEIGHBOURS)
    valid = measured.measured & (flags == 0)
    for s in np.flatnonzero((flags & int(Flag.UNLIKE_NEIGHBOURS) != 0) & ~second).tolist():
        deviations = [
            float(np.hypot(*(slopes[s] - 2 * slopes[a] + slopes[b])))
            for a, b in continued(layout, s)
            if valid[a] and valid[b]
        ]
        agree = np.count_nonzero(np.array(deviations) <= max(least_px, 2.0 * 6**0.5 * typical))
        if deviations and 2 * agree >= len(deviations):
            flags[s] &= ~int(Flag.UNLIKE_NEIGHBOURS)
    return flags


def _steps(layout: fs.Layout, s: int) -> list[Floats]:
    """Steps to the neighbours of s."""
    away = layout.centres - layout.centres[s]
    return [step for step in away if 0 < np.hypot(*step) < 1.6 * (layout.pitch_px or 0.0)]


def _at(layout: fs.Layout, s: int, step: Floats) -> int | None:
    """Sub-aperture at a step from s."""
    away = np.hypot(*(layout.centres - layout.centres[s] - step).T)
    return int(away.argmin()) if away.min() < 0.3 * (layout.pitch_px or 0.0) else None


def continued(layout: fs.Layout, s: int) -> list[tuple[int, int]]:
    """Neighbours of s, each with the one behind it."""
    pairs = [(_at(layout, s, step), _at(layout, s, 2 * step)) for step in _steps(layout, s)]
    return [(a, b) for a, b in pairs if a is not None and b is not None]


def in_line(layout: fs.Layout, s: int) -> list[tuple[int, int, float]]:
    """Two sub-apertures in line with s, and the weight of the first of them: both sides, else one."""
    opposite = {frozenset((_at(layout, s, step), _at(layout, s, -step))) for step in _steps(layout, s)}
    opposite -= {None}
    both = [tuple(pair) for pair in opposite if None not in pair]
    found: list[Any] = [(a, b, 0.5) for a, b in both]
    if len(both) < 2:
        found += [(a, b, 2.0) for a, b in continued(layout, s)]
    return found


def _denoised(image: Floats, settings: fs.Settings, s: int, n: int) -> Denoised:
    """The image of sub-aperture `s` of `n` as the estimator denoises it, if it does."""
    if settings.estimator.name == "brightest":
        return tv_denoise(image, 0.0, "fgp", 0.0, 1)
    strength, tolerance, limit = (
        settings.values(name, n, image.size)[s] for name in ("noise_std", "tolerance", "max_iterations")
    )
    denoised = tv_denoise(
        image, float(strength), settings.algorithm, float(tolerance), int(limit), lower=True
    )
    return replace(denoised, converged=denoised.converged or tolerance == 0)


def _spot_fits(denoised: Denoised, value: Any, flags: int, bad: int, centre: Floats, corner: Any) -> Slope:
    """Background, centroid and validity of one denoised sub-aperture; position from its centre."""
    ny, nx = denoised.image.shape
    spot = brightest_pixels(denoised.image, int(value["keep_brightest"]), str(value["rule"]))
    flux = float(spot.sum())
    x, y = centre_of_gravity(spot)
    illuminated = flux > value["flux_floor"] * np.max(np.abs(denoised.image))
    if not illuminated or abs(x) > nx / 2 or abs(y) > ny / 2:
        flags |= Flag.NO_FLUX
    if flags & Flag.TOO_MANY_BAD_PIXELS:  # no other reason is given
        flags &= Flag.TOO_MANY_BAD_PIXELS | Flag.SATURATED
    if flags & (Flag.NO_FLUX | Flag.TOO_MANY_BAD_PIXELS):
        x = y = 0.0
    else:
        x += corner[1] + (nx - 1) / 2 - centre[0]
        y += corner[0] + (ny - 1) / 2 - centre[1]
    return Slope(x, y, flux, int(flags), denoised.iterations, bad, denoised)
