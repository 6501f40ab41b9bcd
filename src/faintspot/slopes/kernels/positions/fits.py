"""Estimators that know the spot: the own kernels of weighted, fitted and posterior estimators."""

import math

import numpy as np

from faintspot.base.arrays import Array
from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.kernels import groups
from faintspot.slopes.kernels.compiling import compiled
from faintspot.slopes.kernels.groups import (
    COMMON_ROWS,
    ERROR_SCALE,
    EXCESS,
    NO_FLUX,
    RANGE,
    TOO_MANY_BAD_PIXELS,
    VARIANCE,
    ZERO_X,
    Group,
    Scratch,
    driver_of,
)
from faintspot.slopes.kernels.positions import spot_rows
from faintspot.slopes.kernels.positions.brightest import (
    SMALLEST_VARIANCE,
    gather_taps,
    variance_of,
    without_noisy_pixels,
)
from faintspot.slopes.kernels.positions.likelihood import fit_group
from faintspot.slopes.kernels.positions.means import posterior_of_group, weigh_group
from faintspot.slopes.kernels.positions.spot_rows import (
    LEAST_FLUX_E,
    ModelTables,
    PosteriorTables,
    find_start,
    subtract_background,
)
from faintspot.slopes.kernels.simd import load, rounded, select, splat, store, width_of

# Rows of the settings' table that follow the common ones: flux that is expected; weights of a fit; prior.
FLUX, WEIGHT_FLOOR, WEIGHT_EXCESS, MODEL_ERROR, PRIOR_WEIGHT = range(COMMON_ROWS, COMMON_ROWS + 5)
# Which model and which table of the flux's; see `spot_rows`; light of likely outliers.
MODEL, KIND, START_FLUX, GAIN_X, GAIN_Y, LEAST_FLUX, LARGEST_MOVE = range(COMMON_ROWS + 5, COMMON_ROWS + 12)
SETTING_ROWS = COMMON_ROWS + 12

OUTLIER_LIKELY = int(SubapertureFlag.OUTLIER_LIKELY)
NOT_CONVERGED = int(SubapertureFlag.NOT_CONVERGED)
LEAST_SIGNIFICANCE = 1.0
"""A spot less significant than this many standard deviations counts as no flux."""
WHOLE_ELECTRONS_BELOW = 0.25
"""Read noise [e-] that rounding to whole electrons nearly removes."""
MOST_MODEL_ERROR_E = 300.0
"""Electrons: the squared model error is limited to this value over the flux. At high flux, the dark wings,
where a PSF is least known, then do not dominate the weights.
"""
_LIT_FRACTION = 0.2  # of the expected flux: what is surely less is no flux
_SURELY = 3.0  # standard deviations
_MOVING = 2.0  # standard errors that the next steps would add
_BROAD = 0.5  # standard deviation, in units of the grid's spacing, above which sums over the grid are good


@compiled
def locate_weighted(group: Group, tables: ModelTables, scratch: Scratch, stages: Array) -> None:
    """Follow the spots of a group with a weight."""
    own = scratch.own
    _begin(group, scratch)
    _begin_at_peak(group, tables.taps, scratch)
    weigh_group(group, tables, scratch.image, own)
    _finish(group, tables.steps, False, scratch)


@compiled
def locate_fitted(group: Group, tables: ModelTables, scratch: Scratch, stages: Array) -> None:
    """Fit position and flux of the spots of a group."""
    _round(group, tables.round_electrons, scratch.image)
    _begin(group, scratch)
    if tables.background:
        nothing = splat(group.lanes, 0.0)
        subtract_background(group.lanes, scratch.image, group.ny * group.nx, nothing)
    _begin_at_peak(group, tables.taps, scratch)
    _fit(group, tables, scratch)
    _finish(group, tables.steps, False, scratch)


@compiled
def locate_posterior(group: Group, tables: PosteriorTables, scratch: Scratch, stages: Array) -> None:
    """Fit the spots of a group from the posterior's mean, which stays where the posterior is broad."""
    own = scratch.own
    lanes, pixels = group.lanes, group.ny * group.nx
    width = width_of(lanes)
    _round(group, tables.fit.round_electrons, scratch.image)
    _begin(group, scratch)
    if tables.fit.background:
        subtract_background(lanes, scratch.image, pixels, splat(lanes, 0.0))
    _begin_at_peak(group, tables.fit.taps, scratch)
    for peak, found in (
        (spot_rows.PEAK_X, spot_rows.X),
        (spot_rows.PEAK_Y, spot_rows.Y),
        (spot_rows.PEAK_FLUX, spot_rows.FLUX),
    ):
        store(own.lane_values, peak * width, load(lanes, own.lane_values, found * width))
    _expect_flux(group, own.lane_values)
    if tables.fit.background:
        flux = load(lanes, own.lane_values, spot_rows.FLUX * width)
        subtract_background(lanes, scratch.image, pixels, flux)
    posterior_of_group(group, tables, scratch.image, own)
    _begin_at_mean_or_peak(width, own.lane_values)
    _fit(group, tables.fit, scratch)
    _keep_broad_posteriors(width, own.lane_values)
    _finish(group, tables.fit.steps, True, scratch)


@compiled
def _round(group: Group, round_electrons: bool, image: Array) -> None:
    """Round pixels of low noise to whole electrons, where that is asked for."""
    lanes, pixels = group.lanes, group.ny * group.nx
    width, place = width_of(lanes), group.first * pixels
    low, limit = splat(lanes, 0.0), splat(lanes, WHOLE_ELECTRONS_BELOW**2)
    if round_electrons:
        for i in range(pixels):
            value = load(lanes, image, i * width)
            countable = variance_of(lanes, group.variances, place + i * width, low) < limit
            store(image, i * width, select(countable, rounded(value), value))


@compiled
def _begin(group: Group, scratch: Scratch) -> None:
    """Copy the settings of the lanes' sub-apertures; the initial position is the predicted one."""
    width, first, settings, own = width_of(group.lanes), group.first, group.settings, scratch.own
    lane_values = own.lane_values
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        own.models[lane], own.kinds[lane] = int(settings[MODEL, s]), int(settings[KIND, s])
        for axis in range(2):
            half = 0.5 * (group.nx if axis == 0 else group.ny)
            zero, reach = settings[ZERO_X + axis, s], settings[RANGE, s]
            # The window is where a spot can be; half a pixel remains of a range that lies outside.
            # Bounds come first: NaN then becomes one.
            low = min(max(-half, zero - reach), half - 0.5)
            high = max(low, min(half, zero + reach))
            place = zero + group.predicted[axis, s]
            lane_values[(spot_rows.LOW_X + 2 * axis) * width + lane] = low
            lane_values[(spot_rows.HIGH_X + 2 * axis) * width + lane] = high
            lane_values[(spot_rows.PRIOR_X + axis) * width + lane] = place
            lane_values[(spot_rows.X + axis) * width + lane] = min(max(low, place), high)
        lane_values[spot_rows.VARIANCE * width + lane] = max(settings[VARIANCE, s], 0.0)
        lane_values[spot_rows.EXCESS * width + lane] = settings[EXCESS, s]
        lane_values[spot_rows.PRIOR_WEIGHT * width + lane] = settings[PRIOR_WEIGHT, s]
        lane_values[spot_rows.START_FLUX * width + lane] = settings[START_FLUX, s]
        lane_values[spot_rows.GAIN_X * width + lane] = settings[GAIN_X, s]
        lane_values[spot_rows.GAIN_Y * width + lane] = settings[GAIN_Y, s]
        largest = settings[LARGEST_MOVE, s]
        lane_values[spot_rows.LARGEST_MOVE * width + lane] = largest
        lane_values[spot_rows.MOVE * width + lane] = (
            largest  # before the first step, in which it is not known
        )


@compiled
def _begin_at_peak(group: Group, taps: Array, scratch: Scratch) -> None:
    """Start from the peak of the smoothed image."""
    lanes, own = group.lanes, scratch.own
    gather_taps(width_of(lanes), group.first, taps, own.taps)
    reach = taps.shape[2] - 1
    mean = load(lanes, own.lane_values, spot_rows.VARIANCE * width_of(lanes))
    pixels = group.ny * group.nx
    place = group.first * pixels
    image = without_noisy_pixels(lanes, group.variances, place, pixels, mean, scratch.image, scratch.spare)
    find_start(lanes, image, group.ny, group.nx, reach, own.taps, own.rows, own.lane_values)


@compiled
def _fit(group: Group, tables: ModelTables, scratch: Scratch) -> None:
    """Fit from the current positions; the floor of the weights is a fraction of the flux found so far."""
    width, first, settings, own = width_of(group.lanes), group.first, group.settings, scratch.own
    lane_values = own.lane_values
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        floor = settings[WEIGHT_FLOOR, s] * lane_values[spot_rows.FLUX * width + lane]
        variance = lane_values[spot_rows.VARIANCE * width + lane] + floor
        lane_values[spot_rows.WEIGHT_VARIANCE * width + lane] = max(variance, SMALLEST_VARIANCE)
        lane_values[spot_rows.WEIGHT_EXCESS * width + lane] = settings[WEIGHT_EXCESS, s]
        most = MOST_MODEL_ERROR_E / lane_values[spot_rows.FLUX * width + lane]
        lane_values[spot_rows.MODEL_ERROR * width + lane] = min(settings[MODEL_ERROR, s] ** 2, most)
    fit_group(group, tables, scratch.image, own)


@compiled
def _expect_flux(group: Group, lane_values: Array) -> None:
    """Use the expected flux as the flux."""
    width, first, settings = width_of(group.lanes), group.first, group.settings
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        lane_values[spot_rows.FLUX * width + lane] = max(settings[FLUX, s], LEAST_FLUX_E)


@compiled
def _begin_at_mean_or_peak(width: int, lane_values: Array) -> None:
    """Begin at the posterior's mean, or at the peak where the grid is too coarse for a narrow posterior.

    The likelihood of a PSF that is slightly wrong has several maxima in high flux. The peak beside the
    mean leads to the one that a fit without a prior finds.
    """
    for lane in range(width):
        spacing = lane_values[spot_rows.SPACING * width + lane]
        at_peak = True
        for axis in range(2):
            mean = lane_values[(spot_rows.MEAN_X + axis) * width + lane]
            away = abs(lane_values[(spot_rows.PEAK_X + axis) * width + lane] - mean)
            spread = lane_values[(spot_rows.SPREAD_X + axis) * width + lane]
            at_peak = at_peak and spread <= _BROAD * spacing and away <= spacing
        for axis in range(2):
            row = spot_rows.PEAK_X if at_peak else spot_rows.MEAN_X
            lane_values[(spot_rows.X + axis) * width + lane] = lane_values[(row + axis) * width + lane]
        if at_peak:
            flux = lane_values[spot_rows.PEAK_FLUX * width + lane]
            lane_values[spot_rows.FLUX * width + lane] = flux


@compiled
def _keep_broad_posteriors(width: int, lane_values: Array) -> None:
    """Along an axis on which the posterior is broader than its grid, its mean and spread are the result.

    If it is the only one, x and y stay as correlated as in the fit.
    """
    for lane in range(width):
        fitted = lane_values[spot_rows.ERROR_X * width + lane] < math.inf
        broad = _BROAD * lane_values[spot_rows.SPACING * width + lane]
        replaced, change = 0, np.float32(1.0)
        for axis in range(2):
            spread = lane_values[(spot_rows.SPREAD_X + axis) * width + lane]
            if spread > broad or not fitted:
                mean = lane_values[(spot_rows.MEAN_X + axis) * width + lane]
                change = spread / lane_values[(spot_rows.ERROR_X + axis) * width + lane]
                lane_values[(spot_rows.X + axis) * width + lane] = mean
                lane_values[(spot_rows.ERROR_X + axis) * width + lane] = spread
                replaced += 1
        covariance = change * lane_values[spot_rows.COVARIANCE * width + lane]
        if replaced == 2:
            covariance = lane_values[spot_rows.SPREAD_XY * width + lane]
        lane_values[spot_rows.COVARIANCE * width + lane] = covariance


@compiled
def _is_illuminated(width: int, lane: int, expected: float, lane_values: Array) -> bool:
    """Return whether there is a spot: its expected flux is not clearly missing, or it is significant."""
    seen = lane_values[spot_rows.SEEN * width + lane]
    error = lane_values[spot_rows.SEEN_ERROR * width + lane]
    if expected >= 0.0:
        return expected >= LEAST_FLUX_E and seen + _SURELY * error > _LIT_FRACTION * expected
    return seen >= LEAST_SIGNIFICANCE * error


@compiled
def _is_moving(width: int, lane: int, error: float, lane_values: Array) -> bool:
    """Return whether further steps, as a geometric series, would move a lane by several standard errors."""
    move = lane_values[spot_rows.MOVE * width + lane]
    before = lane_values[spot_rows.MOVE_BEFORE * width + lane]
    return move > error and move * move > _MOVING * error * (before - move)


@compiled
def _finish(group: Group, steps: int, expects_flux: bool, scratch: Scratch) -> None:
    """Write the results and the flags of the lanes."""
    width, settings, lane_values, found = (
        width_of(group.lanes),
        group.settings,
        scratch.own.lane_values,
        scratch.results,
    )
    for lane in range(width):
        s = min(group.first + lane, settings.shape[1] - 1)
        bits = scratch.flags[lane]
        error_x = lane_values[spot_rows.ERROR_X * width + lane]
        error_y = lane_values[spot_rows.ERROR_Y * width + lane]
        flux = lane_values[spot_rows.FLUX * width + lane]
        if not bits & TOO_MANY_BAD_PIXELS:  # else no further flags are added
            expected = settings[FLUX, s] if expects_flux else np.float32(-1.0)
            illuminated = _is_illuminated(width, lane, expected, lane_values)
            if not (error_x + error_y < math.inf and illuminated and abs(flux) < math.inf):
                bits |= NO_FLUX
            elif flux < settings[LEAST_FLUX, s]:
                bits |= OUTLIER_LIKELY
            error = settings[ERROR_SCALE, s] * max(error_x, error_y)
            if _is_moving(width, lane, error, lane_values):
                bits |= NOT_CONVERGED
        scratch.flags[lane], scratch.iterations[lane] = bits, steps
        found[groups.X * width + lane] = lane_values[spot_rows.X * width + lane]
        found[groups.Y * width + lane] = lane_values[spot_rows.Y * width + lane]
        found[groups.FLUX * width + lane] = flux if abs(flux) < math.inf else np.float32(0.0)
        found[groups.ERROR_X * width + lane], found[groups.ERROR_Y * width + lane] = error_x, error_y
        found[groups.COVARIANCE * width + lane] = lane_values[spot_rows.COVARIANCE * width + lane]


weighted_of_groups = driver_of(locate_weighted)
fitted_of_groups = driver_of(locate_fitted)
posterior_of_groups = driver_of(locate_posterior)
