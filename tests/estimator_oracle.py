"""The oracle of the estimators applied to a case, and what it means that slopes equal it.

The kernels compute in float32. How far that can take an iteration from the oracle's float64 depends on the
spot (a faint one at the window's edge amplifies rounding, a bright one does not), so each case is measured by
itself: the oracle is run again with every pixel, and every value of the PSF, changed at random by one unit of
float32 rounding. ROUNDING times the largest change is the tolerance, with a floor for positions themselves.
Cases near a decision that rounding may turn (two pixels that tie for the start, two phases of the tables, a
singular matrix) have a margin below MARGIN and are not compared.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc
from tests import naive
from tests import naive_estimators as oracle
from tests.estimator_cases import Case, assert_sane
from tests.naive_estimators import Estimate, Task
from tests.naive_spots import Floats, Spot, spots_of

import faintspot as fs
from faintspot.slopes.estimators.spot_tables import posterior_grid
from faintspot.slopes.spots.psf import PSF

EPS = float(np.finfo(np.float32).eps)
ROUNDING = 30.0
FLOOR_PX = 1e-5
MARGIN = 1e-3
REPEATS = 2


class ShakenSpot(Spot):
    """A spot whose values are off by one unit of float32 rounding."""

    def __init__(self, spot: Spot, rng: np.random.Generator) -> None:
        vars(self).update(vars(spot))
        self.rng = rng

    def images(self, x: float, y: float, shape: tuple[int, int]) -> tuple[Floats, Floats, Floats]:
        first, second, third = super().images(x, y, shape)
        return self._shaken(first), self._shaken(second), self._shaken(third)

    def _shaken(self, values: Floats) -> Floats:
        return values * (1 + EPS * self.rng.standard_normal(values.shape))


def electrons(case: Case) -> NDArray[np.float64]:
    """Calibrated images with bad pixels filled."""
    calibrated = naive.calibrate(case.images.reshape(-1, case.images.shape[2]), case.calibration)
    return np.stack([naive.fill_bad_pixels(image) for image in calibrated.reshape(case.images.shape)])


def tasks(case: Case) -> list[Task]:
    """What the oracle's estimators may know about each image."""
    n, ny, nx = case.images.shape
    calibration, settings = case.calibration, case.settings
    own = {
        name: _each(case, name) for name in ("weight_floor", "model_error", "prior_std_px", "weight_fwhm_px")
    }
    noises = pixel_noises(case)
    excess = 2.0 if calibration.em_gain > 1 else 1.0
    search = np.nan_to_num(case.each("search_range_px"), nan=max(nx, ny) / 2)
    made = []
    for s in range(n):
        made.append(
            Task(
                variance=noises[s] ** 2 + excess * calibration.background_e,
                excess=excess,
                weight_floor=own["weight_floor"][s],
                model_error=own["model_error"][s],
                search_range=search[s],
                steps=settings.steps if "steps" in settings.declared() else 0,
                error_scale=case.each("error_scale")[s],
                prior=(0.0, 0.0) if case.prior is None else tuple(case.prior[s]),
                prior_std=own["prior_std_px"][s],
                weight_fwhm=own["weight_fwhm_px"][s],
                spot_fwhm=math.sqrt(case.each("spot_fwhm_px")[s] * case.each("spot_fwhm_y_px")[s]),
                axis_ratio=case.each("spot_fwhm_y_px")[s] / case.each("spot_fwhm_px")[s],
            )
        )
    return made


def pixel_noises(case: Case) -> list[NDArray[np.float64]]:
    """Read noise of each image, one number or one of each pixel; bad ones have the mean variance."""
    noise = case.calibration.read_noise_e
    if not isinstance(noise, np.ndarray):
        return [np.asarray((noise or 0.0) / case.calibration.em_gain)] * len(case.images)
    noise = noise.reshape(case.images.shape) / case.calibration.em_gain
    usual = np.nanmean(noise**2)
    found = []
    for own in noise:
        mean = usual if np.isnan(own).all() else np.nanmean(own**2)
        found.append(np.sqrt(np.where(np.isnan(own), mean, own**2)))
    return found


def _each(case: Case, name: str) -> NDArray[np.float64]:
    """Values of an option for all images; NaN where the estimator has no such option."""
    if name in case.settings.declared():
        return case.each(name)
    return np.full(len(case.images), np.nan)


def spot_tasks(case: Case) -> list[Task]:
    """Those of the estimators that know the PSF."""
    assert case.psf is not None
    n, ny, nx = case.images.shape
    spots, index = spots_of(case.psf, tabulated=True), case.psf.index_of(n)
    width = case.psf.fwhm_px
    reach = start_reach(width.max(), (ny, nx))
    counts = case.calibration.em_gain == 1 and case.calibration.background_e == 0
    background = case.settings.local_background == "on"
    counts = counts and not background
    made = []
    for task, kind, noise in zip(tasks(case), index, pixel_noises(case), strict=True):
        task = replace(task, background=background)
        whole = counts & (noise < 0.25)
        # What rounding leaves: one electron more or less where the noise is beyond a half.
        variance = np.where(whole, erfc(0.5 / (np.maximum(noise, 1e-9) * math.sqrt(2))), task.variance)
        fwhm = (width[kind, 0], width[kind, 1])
        known = replace(task, spot=spots[kind], fwhm=fwhm, reach=reach, variance=variance)
        made.append(replace(known, whole_electrons=whole))
    return made


def start_reach(fwhm: float, window: tuple[int, int]) -> int:
    """Reach of the start's smoothing, that of the widest spot for all."""
    return min(math.ceil(2.5 * oracle.START_STD_PER_FWHM * fwhm), max(window) - 1)


@cache
def gaussian_spot(fwhm_x: float, fwhm_y: float) -> Spot:
    low, high = sorted([fwhm_x, fwhm_y])
    angle = 0.0 if fwhm_x >= fwhm_y else 90.0
    shape = {"size": low / 2, "elongation": high / low, "angle_deg": angle}
    return spots_of(PSF.analytic("gaussian", radius_px=10, **shape))[0]


def begin(case: Case, s: int, g: Floats, task: Task) -> Estimate:
    """The start is found with the PSF itself, not with tables."""
    if case.psf is None:
        fwhm = (case.each("spot_fwhm_px")[s], case.each("spot_fwhm_y_px")[s])
        spot = gaussian_spot(*fwhm)
        widest = max(case.each(name).max() for name in ("spot_fwhm_px", "spot_fwhm_y_px"))
        reach = start_reach(widest, (g.shape[0], g.shape[1]))
        return oracle.start(g, replace(task, spot=spot, fwhm=fwhm, reach=reach))
    spot = exact_spots(case.psf)[case.psf.index_of(len(case.images))[s]]
    return oracle.start(task.counted(g), replace(task, spot=spot))


@cache
def exact_spots(psf: PSF) -> list[Spot]:
    return spots_of(psf)


def by_fit(case: Case, s: int, g: Floats, task: Task) -> Estimate:
    return oracle.fisher(g, task, case.settings.estimator.name, begin(case, s, g, task))


def by_posterior(case: Case, s: int, g: Floats, task: Task) -> Estimate:
    """The posterior's mean where it is broader than half the grid, else the fit that begins there.

    It begins at the smoothed image's peak where the posterior is narrow, the peak within a step of the grid.
    """
    assert case.psf is not None
    ny, nx = g.shape
    g = task.counted(g)
    search = case.each("search_range_px")
    reach = float(np.where(np.isnan(search), np.inf, search).max())
    grid, spacing = posterior_grid(reach, float(case.psf.fwhm_px.min()), (ny, nx))
    flux = max(case.each("flux_e")[s], 1.0)
    g = g - (g.sum() - flux) / g.size if task.background else g
    spot = exact_spots(case.psf)[case.psf.index_of(len(case.images))[s]]
    variance = np.maximum(task.variance + task.weight_floor * flux, oracle.LEAST_VARIANCE)
    known = replace(task, spot=spot, variance=variance)
    broad = oracle.grid_posterior(g, known, flux, np.unique(grid[:, 0]), np.unique(grid[:, 1]), spacing)
    broad = replace(
        broad,
        x=oracle.clamp(broad.x, *task.limits((ny, nx))[0]),
        y=oracle.clamp(broad.y, *task.limits((ny, nx))[1]),
    )
    peak = begin(case, s, g, task)
    away = max(abs(peak.x - broad.x), abs(peak.y - broad.y)) / spacing
    spread = max(broad.error_x, broad.error_y) / task.error_scale / (0.5 * spacing)
    at_peak = spread <= 1 and away <= 1
    first = Estimate(peak.x, peak.y, peak.flux) if at_peak else replace(broad, flux=flux)
    fitted = oracle.fisher(g, task, "map", first)
    margin, replaced = min(fitted.margin, abs(away - 1), peak.margin if at_peak else math.inf), 0
    for axis in "xy":
        spread = getattr(broad, f"error_{axis}") / task.error_scale / (0.5 * spacing)
        margin = min(margin, abs(spread - 1))
        names = (axis, f"error_{axis}")
        if spread > 1 or math.isinf(getattr(fitted, names[1])):
            covariance = fitted.covariance * getattr(broad, names[1]) / getattr(fitted, names[1])
            fitted = replace(fitted, covariance=covariance, **{name: getattr(broad, name) for name in names})
            replaced += 1
    return replace(fitted, margin=margin, covariance=(broad if replaced == 2 else fitted).covariance)


def by_weight(case: Case, s: int, g: Floats, task: Task) -> Estimate:
    return oracle.weighted(g, task, begin(case, s, g, task))


def by_window(case: Case, s: int, g: Floats, task: Task) -> Estimate:
    """Not limited to the window, as it is linear; slopes only to the search range."""
    fwhm = (case.each("spot_fwhm_px")[s], case.each("spot_fwhm_y_px")[s])
    how, gain = case.settings.normalisation, case.each("centroid_gain")[s]
    divisor = float(case.each("flux_e")[s]) if how == "mean" else None
    found = oracle.fixed_window(
        g,
        replace(task, spot=gaussian_spot(*fwhm)),
        float(case.each("window_fwhm_px")[s]),
        float(case.each("region_px")[s]),
        divisor,
        None if math.isnan(gain) else float(gain),
    )
    reach = np.nan_to_num(case.each("search_range_px"), nan=math.inf)[s]
    return replace(found, x=oracle.clamp(found.x, -reach, reach), y=oracle.clamp(found.y, -reach, reach))


def by_gravity(case: Case, s: int, g: Floats, task: Task) -> Estimate:
    """Without denoising."""
    name, image, smoothing = case.settings.estimator.name, g, dict[str, Any]()
    if name == "centroid":
        left = g
    elif name == "thresholded":
        left = np.maximum(g - case.each("threshold_e")[s], 0.0)
    else:
        if name == "smoothed":
            std = case.each("smoothing_px")
            reach = min(math.ceil(2.5 * std.max()), max(g.shape) - 1)
            image = oracle.smoothed(g, std[s], std[s], reach)
            smoothing = {"std_px": float(std[s]), "reach": reach}
        left = naive.brightest_pixels(image, int(case.each("keep_brightest")[s]))
    x, y = naive.centre_of_gravity(left)
    error_x, error_y, margin = oracle.gravity_error(
        left, g, task.variance, task.excess, every_pixel=name == "centroid", **smoothing
    )
    (low_x, high_x), (low_y, high_y) = task.limits(g.shape)
    return Estimate(
        oracle.clamp(x, low_x, high_x),
        oracle.clamp(y, low_y, high_y),
        float(left.sum()),
        task.error_scale * error_x,
        task.error_scale * error_y,
        margin=margin,
    )


Method = Callable[[Case, int, Floats, Task], Estimate]
METHODS: dict[str, tuple[Callable[[Case], list[Task]], Method]] = {
    "brightest": (tasks, by_gravity),
    "tv": (tasks, by_gravity),
    "centroid": (tasks, by_gravity),
    "thresholded": (tasks, by_gravity),
    "smoothed": (tasks, by_gravity),
    "window": (tasks, by_window),
    "weighted": (tasks, by_weight),
    "ml": (spot_tasks, by_fit),
    "map": (spot_tasks, by_posterior),
}


def estimates(case: Case) -> Iterator[list[Estimate]]:
    """For every image the oracle's estimate, and those of images and spots off by rounding."""
    rng = np.random.default_rng(0)
    tasks_of, method = METHODS[case.settings.estimator.name]
    for s, (g, task) in enumerate(zip(electrons(case), tasks_of(case), strict=True)):
        found = [method(case, s, g, task)]
        size = EPS * np.abs(g).max()
        for _ in range(REPEATS):
            spot = None if task.spot is None else ShakenSpot(task.spot, rng)
            noise = size * rng.uniform(-1.0, 1.0, g.shape)
            found.append(method(case, s, g + noise, replace(task, spot=spot, rounding=rng)))
        yield found


def assert_equals_oracle(case: Case, slopes: fs.Slopes) -> int:
    """Compare what is valid and not near a decision; return how many slopes that were."""
    assert_sane(slopes)
    compared = 0
    fwhm = np.column_stack([case.each("spot_fwhm_px"), case.each("spot_fwhm_y_px")])
    cut = naive.doubtful(slopes, case.layout, fwhm)
    for s, (expected, *shaken) in enumerate(estimates(case)):
        margins = [expected.margin, *(other.margin for other in shaken)]
        if not slopes.measured[s] or min(margins) < MARGIN:
            continue
        compared += 1
        for name, relative in (("x", 0.0), ("y", 0.0), ("error_x", 1e-4), ("error_y", 1e-4)):
            value = getattr(expected, name)
            if math.isinf(value):
                assert getattr(slopes, name.replace("error", "standard_error"))[s] == value
                continue
            change = max(abs(getattr(other, name) - value) for other in shaken)
            bound = FLOOR_PX + relative * value + ROUNDING * change
            result = getattr(slopes, name.replace("error", "standard_error"))[s]
            assert abs(result - value) <= bound, (s, name, float(result), value, bound)
        assert_covariance_is(expected, shaken, float(slopes.covariance_xy[s]))
        if not cut[s]:
            assert_search_limit_flagged(case, s, [expected, *shaken], slopes)
        assert slopes.flags[s] & cut[s] == cut[s]
        moving = {each.is_moving for each in (expected, *shaken)}
        if "steps" in case.settings.declared() and len(moving) == 1:
            assert bool(slopes.flags[s] & fs.SubapertureFlag.NOT_CONVERGED) == moving.pop(), (s, expected)
    return compared


def assert_covariance_is(expected: Estimate, shaken: list[Estimate], found: float) -> None:
    """A covariance is compared where it is known, in units of the errors' product."""
    largest = expected.error_x * expected.error_y
    if math.isfinite(largest + expected.covariance):
        value, *others = (np.clip(each.covariance, -largest, largest) for each in (expected, *shaken))
        change = max(abs(other - value) for other in others)
        allowed = 1e-3 * largest + FLOOR_PX * (expected.error_x + expected.error_y) + ROUNDING * change
        assert abs(found - value) <= allowed, (expected, found)


def assert_search_limit_flagged(case: Case, s: int, found: list[Estimate], slopes: fs.Slopes) -> None:
    """Slopes at the search range have their flag, others have not; where rounding decides, either."""
    reach = float(case.each("search_range_px")[s])
    at_limit = [max(abs(each.x), abs(each.y)) >= reach - FLOOR_PX for each in found]
    flagged = bool(slopes.flags[s] & fs.SubapertureFlag.AT_SEARCH_LIMIT)
    if all(at_limit) or not any(at_limit):
        assert flagged == at_limit[0], (s, found[0], reach)
