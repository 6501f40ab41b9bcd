"""The slow, obvious oracle of the estimators: one image at a time, plain NumPy, float64.

Written from the formulas, not from the kernels. Positions are px from the image's centre, and a `Task` holds
everything else that an estimator may know.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from tests import naive
from tests.naive_spots import Floats, Spot, phase_margins, pixel_centres, window

FWHM_PER_STD = 2 * math.sqrt(2 * math.log(2))
START_STD_PER_FWHM = 0.73
LEAST_VARIANCE, LEAST_FLUX = 1e-4, 1e-2
MOST_MODEL_ERROR_E = 300.0
LEAST_FRACTION = 0.05
PRIOR_REACH = 4.0


@dataclass(frozen=True)
class Task:
    """What an estimator knows about one sub-aperture; electrons and px."""

    spot: Spot | None = None
    fwhm: tuple[float, float] = (2.0, 2.0)
    variance: Any = 0.01
    """Read noise and the noise of the background that is taken off, of a pixel or of each, (ny, nx)."""
    excess: float = 1.0
    weight_floor: float = 1e-3
    model_error: float = 0.0
    search_range: float = math.inf
    """It never leaves the window."""
    reach: int = 0
    """Of the taps of the start's smoothing, px."""
    steps: int = 0
    error_scale: float = 1.0
    whole_electrons: Any = False
    """Whether pixels are rounded, one answer or one for each."""
    background: bool = False
    """Whether a constant is a fourth parameter of the fit."""
    prior: tuple[float, float] = (0.0, 0.0)
    prior_std: float = math.inf
    weight_fwhm: float = 2.0
    spot_fwhm: float = 2.0
    axis_ratio: float = 1.0
    """Width along y over that along x, of spot and weight."""

    rounding: np.random.Generator | None = None
    """Where given, sums of the posterior are off by a unit of float32 rounding of what is summed."""

    def rounded_sum(self, values: Floats) -> float:
        """Sum the values."""
        total = float(np.sum(values))
        if self.rounding is None:
            return total
        return total + float(np.finfo(np.float32).eps * np.abs(values).sum() * self.rounding.uniform(-1, 1))

    def counted(self, g: ArrayLike) -> Floats:
        """The image with the pixels of low noise rounded."""
        return np.where(self.whole_electrons, np.rint(g), np.asarray(g, np.float64))

    def limits(self, shape: tuple[int, int]) -> list[tuple[float, float]]:
        """Lowest and highest x, and y."""
        ends = (min(self.search_range, shape[1] / 2), min(self.search_range, shape[0] / 2))
        return [(-end, end) for end in ends]


@dataclass
class Estimate:
    x: float
    y: float
    flux: float = math.nan
    error_x: float = math.inf
    error_y: float = math.inf
    margin: float = math.inf
    """How near a decision was to another one: below 1e-3 rounding to float32 may turn it."""
    moves: tuple[float, ...] = (1.0, 0.0)
    """How far each step went, the larger of x and y."""
    covariance: float = math.nan
    """Of the errors along x and y, where the method states it: at most their product."""

    @property
    def is_moving(self) -> bool:
        """Whether the next steps would go several standard errors, were they a geometric series."""
        before, move = self.moves[-2:]
        error = max(self.error_x, self.error_y)
        return move > error and (move >= before or move**2 / (before - move) > 2 * error)


# Start ------------------------------------------------------------------------------------------------


def smoothed(g: ArrayLike, std_x: float, std_y: float, reach: int) -> Floats:
    """Gaussian smoothing with taps of sum 1; outside the image there is nothing."""
    result: Any = np.asarray(g, np.float64)
    for axis, std in ((0, std_y), (1, std_x)):
        taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / std) ** 2)
        taps /= taps.sum()
        padded = np.pad(result, [(reach, reach) if a == axis else (0, 0) for a in (0, 1)])
        n = result.shape[axis]
        result = sum(tap * np.take(padded, np.arange(k, k + n), axis=axis) for k, tap in enumerate(taps))
    return np.asarray(result)


def start(g: ArrayLike, task: Task) -> Estimate:
    """The largest pixel of the smoothed image within the search range, and the flux that explains it.

    With a background unknown, image and spot are taken as what exceeds their mean. Pixels noisier than the
    mean count less, by the ratio of the variances.
    """
    g = np.array(g, np.float64)
    g -= g.mean() if task.background else 0.0
    if np.ndim(task.variance):
        mean = max(float(np.mean(task.variance)), LEAST_VARIANCE)
        g *= np.minimum(mean / np.maximum(task.variance, LEAST_VARIANCE), 1.0)
    std_x, std_y = (START_STD_PER_FWHM * width for width in task.fwhm)
    blurred = smoothed(g, std_x, std_y, task.reach)
    (low_x, high_x), (low_y, high_y) = task.limits(g.shape)
    found: list[tuple[float, float, float]] = []
    for j, y in enumerate(pixel_centres(g.shape[0])):
        for i, x in enumerate(pixel_centres(g.shape[1])):
            if low_x - 0.5 <= x <= high_x + 0.5 and low_y - 0.5 <= y <= high_y + 0.5:
                found.append((blurred[j, i], x, y))
    if not found:
        return Estimate(0.0, 0.0, flux=1.0)
    best = max(found, key=lambda item: item[0])
    others = [item[0] for item in found if item is not best]
    assert task.spot is not None
    peak = smoothed_peak(task.spot, std_x, std_y, task.reach, (g.shape[0], g.shape[1]), task.background)
    flux = max(best[0] / peak, 1.0)
    distance = best[0] - max(others, default=-math.inf)
    x, y = clamp(best[1], low_x, high_x), clamp(best[2], low_y, high_y)
    return Estimate(x, y, flux, margin=100 * distance / max(np.abs(blurred).max(), 1e-30))


@cache
def smoothed_peak(
    spot: Spot, std_x: float, std_y: float, reach: int, shape: tuple[int, int], background: bool
) -> float:
    """The smoothed image's middle pixel for a spot of 1 e-, the mean over places of the spot in it."""
    j, i = shape[0] // 2, shape[1] // 2
    found = []
    for x in (-1 / 3, 0.0, 1 / 3):
        for y in (-1 / 3, 0.0, 1 / 3):
            g = spot.images(x + pixel_centres(shape[1])[i], y + pixel_centres(shape[0])[j], shape)[0]
            found.append(smoothed(g - g.mean() if background else g, std_x, std_y, reach)[j, i])
    return max(float(np.mean(found)), 1e-5)


# Likelihood -------------------------------------------------------------------------------------------


def clamp(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


def largest_move(fwhm_x: float, fwhm_y: float) -> float:
    """How far one step may go, px."""
    return max(1.0, 0.25 * min(fwhm_x, fwhm_y))


def weights(m: Floats, task: Task, first_flux: float) -> Floats:
    """Inverse of the variance that the likelihood ascribes to every pixel."""
    flux = np.maximum(m, 0.0)  # a spline may dip below zero
    floor: Any = np.maximum(task.variance + task.weight_floor * first_flux, LEAST_VARIANCE)
    model_error_squared = min(task.model_error**2, MOST_MODEL_ERROR_E / first_flux)
    return np.asarray(1.0 / (floor + task.excess * flux + model_error_squared * flux**2))


def information(m: Floats, dm: list[Floats], w: Floats, task: Task, name: str) -> tuple[Floats, Floats]:
    """I = sum w dm dm and J = sum w^2 T dm dm, with the prior; T is the true variance."""
    true = task.variance + task.excess * np.maximum(m, 0.0)
    i = np.array([[np.sum(w * a * b) for a in dm] for b in dm])
    j = np.array([[np.sum(w**2 * true * a * b) for a in dm] for b in dm])
    if name == "map":
        for matrix in (i, j):
            matrix[0, 0] += task.prior_std**-2
            matrix[1, 1] += task.prior_std**-2
    return i, j


def fisher(g: ArrayLike, task: Task, name: str, begin: Estimate) -> Estimate:
    """Fisher scoring in x, y, flux and, where it is unknown, background; errors as before the last step.

    A move that is cut short leaves the others to what they then should be: along a limit the other axis is
    solved for again, flux and background last. Without information on the place it stays.
    """
    assert task.spot is not None
    g = task.counted(g)
    limits, margin = task.limits(g.shape), begin.margin
    x, y, flux = clamp(begin.x, *limits[0]), clamp(begin.y, *limits[1]), begin.flux
    level, most = 0.0, largest_move(*task.fwhm)
    moves: tuple[float, ...] = (most,)
    stated = (math.inf, math.inf, math.nan)
    for _ in range(task.steps):
        f, fx, fy = task.spot.images(x, y, g.shape)
        m, dm = flux * f, [flux * fx, flux * fy, f] + [np.ones_like(f)] * task.background
        w = weights(m, task, begin.flux)
        score = np.array([np.sum((g - m - level) * w * d) for d in dm])
        if name == "map":
            score[:2] += (np.array(task.prior) - (x, y)) / task.prior_std**2
        i, j = information(m, dm, w, task, name)
        margin = min(margin, soundness(i) - 1e-3, *phase_margins(x, y, g.shape))
        whole = np.linalg.solve(i, score) if soundness(i) > 1e-5 else np.zeros(len(score))
        growth = max(1.0, whole[2] / flux)
        move = np.clip(whole[:2] / growth, -most, most)
        moves += (float(np.abs(move).max()),)
        room = [(low - at, high - at) for at, (low, high) in zip((x, y), limits, strict=True)]
        for axis, other in ((0, 1), (1, 0)):
            margin = min(margin, *(1e3 * abs(move[axis] - bound) for bound in room[axis] if move.any()))
            if not room[axis][0] <= move[axis] <= room[axis][1]:
                move[axis] = clamp(move[axis], *room[axis])
                rest = [k for k in range(len(score)) if k != axis]
                left = np.linalg.solve(i[np.ix_(rest, rest)], score[rest] - i[rest, axis] * move[axis])[0]
                move[other] = clamp(left / growth, -most, most)
        move = np.array([clamp(step, *within) for step, within in zip(move, room, strict=True)])
        stated = sandwich(i, j) if soundness(i) > 1e-5 else (math.inf, math.inf, math.nan)
        x, y = x + move[0], y + move[1]
        others = np.linalg.solve(i[2:, 2:], score[2:] - i[2:, :2] @ move)
        flux = max(clamp(flux + others[0], flux / 2, flux * 2), LEAST_FLUX)
        level += others[1] if task.background else 0.0
    error_x, error_y = (task.error_scale * error for error in stated[:2])
    return Estimate(x, y, flux, error_x, error_y, margin, moves, task.error_scale**2 * stated[2])


def soundness(i: Floats) -> float:
    """Determinant of the information on x and y, the rest unknown, in units of its diagonal's product."""
    if not np.linalg.det(i[2:, 2:]) > 0:
        return 0.0
    a = i[:2, :2] - i[:2, 2:] @ np.linalg.solve(i[2:, 2:], i[2:, :2])
    diagonal = a[0, 0] * a[1, 1]
    return float((diagonal - a[0, 1] ** 2) / diagonal) if min(a[0, 0], a[1, 1]) > 0 else 0.0


def sandwich(i: Floats, j: Floats) -> tuple[float, float, float]:
    """Errors along x and y from I^-1 J I^-1, and their covariance."""
    inverse = np.linalg.inv(i)
    covariance = inverse @ j @ inverse
    return math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1]), float(covariance[0, 1])


def grid_posterior(g: ArrayLike, task: Task, flux: float, xs: Floats, ys: Floats, cell: float) -> Estimate:
    """Mean and standard deviation of the posterior on a grid of positions, the flux known.

    The likelihood is the Poisson distribution's of (g + v / e) / e with mean (m + v / e) / e. Positions
    count with what of their cell of the grid is within the limits; those more than PRIOR_REACH standard
    deviations from the prior on an axis do not count. Where none is left, the prior is all there is.
    """
    assert task.spot is not None
    g = np.asarray(g, np.float64)
    v, e = task.variance, task.excess
    (low_x, high_x), (low_y, high_y) = task.limits(g.shape)
    logarithm = np.full((len(ys), len(xs)), -np.inf)
    for j, y in enumerate(ys):
        for i, x in enumerate(xs):
            share = max(min(x + cell / 2, high_x) - max(x - cell / 2, low_x), 0.0)
            share *= max(min(y + cell / 2, high_y) - max(y - cell / 2, low_y), 0.0)
            away = max(abs(x - task.prior[0]), abs(y - task.prior[1]))
            share *= away <= PRIOR_REACH * task.prior_std
            if not share > 0:
                continue
            m = np.maximum(flux * task.spot.images(x, y, g.shape)[0], 0.0)
            q = (g + v / e) / e * np.log(1.0 + e * m / v) - m / e
            distance = ((x - task.prior[0]) ** 2 + (y - task.prior[1]) ** 2) / task.prior_std**2
            logarithm[j, i] = task.rounded_sum(q) - distance / 2 + math.log(share)
    if np.isneginf(logarithm).all():
        return Estimate(*task.prior, flux, 0.0, 0.0)
    p = np.exp(logarithm - logarithm.max())
    p /= p.sum()
    mean_x, mean_y = float(np.sum(p * xs)), float(np.sum(p * ys[:, None]))
    error_x = math.sqrt(np.sum(p * (xs - mean_x) ** 2))
    error_y = math.sqrt(np.sum(p * (ys[:, None] - mean_y) ** 2))
    covariance = task.error_scale**2 * float(np.sum(p * (xs - mean_x) * (ys[:, None] - mean_y)))
    errors = task.error_scale * error_x, task.error_scale * error_y
    return Estimate(mean_x, mean_y, flux, *errors, covariance=covariance)


# Centres of gravity -----------------------------------------------------------------------------------


def weighted(g: ArrayLike, task: Task, begin: Estimate) -> Estimate:
    """Centre of gravity under a Gaussian window that follows it; error of the last step alone.

    Less flux under the window than LEAST_FRACTION of the start's counts as that much.
    """
    g = np.asarray(g, np.float64)
    limits, margin = task.limits(g.shape), begin.margin
    x, y = clamp(begin.x, *limits[0]), clamp(begin.y, *limits[1])
    gain = 1.0 + (task.spot_fwhm / task.weight_fwhm) ** 2  # both as geometric means of the axes
    std_x = task.weight_fwhm / FWHM_PER_STD / math.sqrt(task.axis_ratio)
    std_y = task.weight_fwhm / FWHM_PER_STD * math.sqrt(task.axis_ratio)
    u, v = pixel_centres(g.shape[1])[None, :], pixel_centres(g.shape[0])[:, None]
    floor = LEAST_FRACTION * begin.flux
    w, total = np.ones_like(g), floor
    most = largest_move(*(task.spot_fwhm * task.axis_ratio**power for power in (-0.5, 0.5)))
    moves: tuple[float, ...] = (most,)
    for _ in range(task.steps):
        margin = min(margin, *phase_margins(x, y, g.shape))
        w = np.outer(window(g.shape[0], y, std_y), window(g.shape[1], x, std_x))
        total = max(float(np.sum(w * g)), floor)
        move_x, move_y = (gain * np.sum(w * g * away) / total for away in (u - x, v - y))
        move_x, move_y = clamp(move_x, -most, most), clamp(move_y, -most, most)
        moves += (max(abs(move_x), abs(move_y)),)
        x, y = clamp(x + move_x, *limits[0]), clamp(y + move_y, *limits[1])
    noise = w**2 * (task.variance + task.excess * g)
    least = w**2 * np.maximum(task.variance, LEAST_VARIANCE)  # whatever noise has made of the flux
    errors = [
        math.sqrt(max(np.sum(noise * away**2), np.sum(least * away**2))) / total for away in (u - x, v - y)
    ]
    error_x, error_y = (
        (task.error_scale * gain * e for e in errors) if total > floor else (math.inf, math.inf)
    )
    covariance = (task.error_scale * gain / total) ** 2 * float(np.sum(noise * (u - x) * (v - y)))
    return Estimate(x, y, total, error_x, error_y, margin, moves, covariance)


def fixed_window(
    g: ArrayLike, task: Task, window_fwhm: float, region: float, divisor: float | None, gain: float | None
) -> Estimate:
    """Sum pixels under a Gaussian at the reference, over the expected flux, or the frame's own where None.

    The gain, where not given, is the slope of the response to the spot at +-0.25 px; at the reference a spot
    is at 0. Weights below 1e-4 of the middle's, and outside the region, are 0.
    """
    assert task.spot is not None
    g = np.asarray(g, np.float64)
    ny, nx = g.shape
    std_x = window_fwhm / FWHM_PER_STD / math.sqrt(task.axis_ratio)
    std_y = window_fwhm / FWHM_PER_STD * math.sqrt(task.axis_ratio)
    spot = task.spot.images(0.0, 0.0, g.shape)[0]
    weights = np.zeros((3, ny, nx))
    for j, v in enumerate(pixel_centres(ny)):
        for i, u in enumerate(pixel_centres(nx)):
            w = math.exp(-0.5 * ((u / std_x) ** 2 + (v / std_y) ** 2))
            if w >= 1e-4 and max(abs(u), abs(v)) < region / 2:
                weights[:, j, i] = w * u, w * v, w
    for axis, (x, y) in enumerate(((0.25, 0.0), (0.0, 0.25))):
        ahead, behind = (task.spot.images(sign * x, sign * y, g.shape)[0] for sign in (1, -1))
        seen = float(np.sum(weights[axis] * (ahead - behind))) / 0.5
        weights[axis] /= max(seen, 0.02) if gain is None else gain
    weights[2] /= max(float(np.sum(weights[2] * spot)), 0.02)
    flux = float(np.sum(weights[2] * g))
    divisor = flux if divisor is None else divisor
    found, errors = [], []
    pixels = (task.error_scale / divisor) ** 2 * (
        task.variance + task.excess * divisor * np.maximum(spot, 0.0)
    )
    for axis in range(2):
        found.append(float(np.sum(weights[axis] * g)) / divisor - float(np.sum(weights[axis] * spot)))
        errors.append(math.sqrt(max(float(np.sum(weights[axis] ** 2 * pixels)), 0.0)))
    covariance = float(np.sum(weights[0] * weights[1] * pixels))
    return Estimate(found[0], found[1], flux, errors[0], errors[1], covariance=covariance)


def gravity_error(
    left: ArrayLike,
    g: ArrayLike,
    variance: ArrayLike,
    excess: float = 1.0,
    every_pixel: bool = False,
    spread: float = 1.0,
    std_px: float = 0.0,
    reach: int = 0,
) -> tuple[float, float, float]:
    """Standard errors of the centre of gravity of an image left by a background subtraction, and a margin.

    var_x = sum over kept pixels of ((u - x)^2 + 1/12) var / (sum of the kept)^2, `g` being the calibrated
    image, the kept pixels those above zero in `left`, or every one, and var = v + e g, or left^2 times the
    number of pixels with the same noise, `spread`, where that is less. They are infinite where (sum of the
    kept)^2 is less than 6.25 times the sum of var; the margin is the relative distance from that. In an image
    smoothed by a Gaussian, a pixel of `g` counts as the sum, by the taps, of what the pixels around it count;
    there, left^2 stands for three times as much, and v + e g is of the smoothed image.
    """
    left, g = np.asarray(left, np.float64), np.asarray(g, np.float64)
    v = np.broadcast_to(variance, g.shape)
    x, y = naive.centre_of_gravity(left)
    u, w = np.meshgrid(pixel_centres(g.shape[1]), pixel_centres(g.shape[0]))
    kept = np.full(g.shape, True) if every_pixel else left > 0
    full, total = v + excess * g, float(left.sum())
    if std_px > 0:
        point = np.zeros((2 * reach + 1, 2 * reach + 1))
        point[reach, reach] = 1.0
        spread = 1 / float((smoothed(point, std_px, std_px, reach) ** 2).sum())
    var = full if every_pixel else np.minimum(full, left**2 * spread)
    var = np.where(kept & ((full > 0) | every_pixel), var, np.where(kept, full, 0.0))
    if total <= 0:
        return math.inf, math.inf, math.inf
    ratio = total**2 / (6.25 * max(float(var.sum()), 1e-300))
    if ratio <= 1:
        return math.inf, math.inf, abs(ratio - 1)
    moments = [float((var * ((place - at) ** 2 + 1 / 12)).sum()) for place, at in ((u, x), (w, y))]
    if std_px > 0:
        smooth = np.maximum(v + excess * smoothed(g, std_px, std_px, reach), 1e-30)
        weight = np.sqrt(np.minimum(3 * spread * left**2 / smooth, 1.0))
        moments = [
            float((full * smoothed(weight * (place - at), std_px, std_px, reach) ** 2).sum())
            for place, at in ((u, x), (w, y))
        ]
    error_x, error_y = (math.sqrt(max(moment, 0.0)) / total for moment in moments)
    return error_x, error_y, abs(ratio - 1)
