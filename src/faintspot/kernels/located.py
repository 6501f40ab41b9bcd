"""From frames to slopes with estimators that know the spot: weighted, matched, ml, map and trained."""

from __future__ import annotations

import math
from typing import Any

from faintspot.flags import SubapertureFlag
from faintspot.kernels import fused, spot_numbers
from faintspot.kernels.compiling import compiled
from faintspot.kernels.fused import NO_LIGHT, TOO_MANY_BAD_PIXELS, prepare_group, store_stage, within
from faintspot.kernels.likelihood import fit_group
from faintspot.kernels.posterior import posterior_of_group
from faintspot.kernels.simd import load, rounded, splat, store, width_of
from faintspot.kernels.smoothing import gather_taps
from faintspot.kernels.start import LEAST_LIGHT_E, find_start
from faintspot.kernels.trained import apply_score
from faintspot.kernels.weighted import weigh_group

WEIGHTED, FITTED, POSTERIOR, TRAINED = range(4)
"""What is done to the calibrated images."""

OUTLIER_LIKELY = int(SubapertureFlag.OUTLIER_LIKELY)
LEAST_SIGNIFICANCE = 1.0
"""A spot less significant than this many standard deviations counts as no light."""
SMALLEST_VARIANCE = 1e-4
"""Electrons squared: keeps the weights finite where there is no noise."""
_LIT_FRACTION = 0.2  # of the expected light: what is surely less is no light
_SURELY = 3.0  # standard deviations
_BROAD = 0.5  # standard deviation, in units of the grid's spacing, above which sums over the grid are good


@compiled
def locate_groups(
    lanes: Any,
    frames: Any,
    corners: Any,
    ny: Any,
    nx: Any,
    calibration: Any,
    saturation: Any,
    tables: Any,
    variants: Any,
    prior: Any,
    method: Any,
    steps: Any,
    from_peak: Any,
    round_electrons: Any,
    taps: Any,
    model: Any,
    posterior: Any,
    score: Any,
    start: Any,
    stop: Any,
    scratch: Any,
    slopes: Any,
    stages: Any,
) -> None:
    """Compute the slopes of the groups [start, stop) of a block of frames.

    Parameters that are not listed here are those of `fused.slopes_of_groups`.

    Parameters
    ----------
    prior : (1 or n_frames, 2, n_subapertures) float32
        Predicted x and y, px from the reference position.
    method : int
        WEIGHTED, FITTED, POSTERIOR or TRAINED.
    steps : int
        Of the fit or of the weighted centre of gravity.
    from_peak : bool
        Whether to begin with the smoothed image's peak instead of the predicted position.
    round_electrons : bool
        Whether images are rounded to whole electrons.
    taps : (n_subapertures, 2, 1 + reach) float32
        Of the smoothing that finds the start.
    model : (n_models, 2, rank, 2, PHASES, length) float32
        See `profiles.look_up`.
    posterior : tuple
        tables, constants, grid, spacing of `posterior_of_group`.
    score : tuple
        tables, steps_per_px, margin of `apply_score`.
    scratch : tuple of arrays, from `new_scratch` in `spot_scratch`
    """
    width = width_of(lanes)
    image, smoothed, lane_taps, numbers, profiles, rows, values, lane_counts = scratch
    starts, models, kinds = (
        lane_counts[:width],
        lane_counts[width : 2 * width],
        lane_counts[2 * width : 3 * width],
    )
    flags, bad_counts = lane_counts[3 * width : 4 * width], lane_counts[4 * width :]
    n = corners.shape[0]
    n_groups = (n + width - 1) // width
    for item in range(start, stop):
        f, group = item // n_groups, item % n_groups
        first = group * width
        settings = tables[variants[f]]
        prepare_group(
            lanes,
            frames,
            f,
            group,
            corners,
            ny,
            nx,
            calibration,
            saturation,
            settings,
            image,
            smoothed,
            starts,
            flags,
            bad_counts,
            numbers,
        )
        for stage in range(stages.shape[0]):
            store_stage(width, image, stages[stage, f], first)
        if round_electrons:
            for i in range(ny * nx):
                store(image, i * width, rounded(load(lanes, image, i * width)))
        predicted = prior[min(f, prior.shape[0] - 1)]
        _read_settings(width, first, ny, nx, settings, predicted, models, kinds, numbers)
        if from_peak:
            gather_taps(width, first, taps, lane_taps)
            find_start(lanes, image, ny, nx, taps.shape[2] - 1, lane_taps, smoothed, numbers)
        if method in (TRAINED, POSTERIOR):
            _expect_light(width, first, settings, numbers)
        if method == TRAINED:
            apply_score(lanes, image, ny, nx, score[0], kinds, score[1], score[2], numbers, starts, rows)
            _sum_light(lanes, image, ny, nx, first, settings, numbers)
        elif method == WEIGHTED:
            weigh_group(lanes, image, ny, nx, model, models, steps, numbers, starts, profiles)
        else:
            if method == POSTERIOR:
                _begin_at_posterior_mean(
                    lanes, image, ny, nx, posterior, kinds, numbers, starts, rows, values
                )
            _set_weights(width, first, settings, numbers)
            fit_group(lanes, image, ny, nx, model, models, steps, numbers, starts, profiles)
            if method == POSTERIOR:
                _keep_broad_posteriors(width, numbers)
        for lane in range(min(width, n - first)):
            _store_slope(
                width, lane, f, first + lane, method, steps, settings, numbers, flags, bad_counts, slopes
            )


@compiled
def _read_settings(
    width: Any,
    first: Any,
    ny: Any,
    nx: Any,
    settings: Any,
    predicted: Any,
    models: Any,
    kinds: Any,
    numbers: Any,
) -> None:
    """Copy what the lanes' sub-apertures are set to; the position is the predicted one at first."""
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        models[lane], kinds[lane] = int(settings[fused.MODEL, s]), int(settings[fused.KIND, s])
        for axis in range(2):
            half = 0.5 * (nx if axis == 0 else ny)
            zero, reach = settings[fused.ZERO_X + axis, s], settings[fused.RANGE, s]
            # The window is where a spot can be; half a pixel remains of a range that lies outside.
            low = min(max(zero - reach, -half), half - 0.5)
            high = max(min(zero + reach, half), low)
            place = zero + predicted[axis, s]
            numbers[(spot_numbers.LOW_X + 2 * axis) * width + lane] = low
            numbers[(spot_numbers.HIGH_X + 2 * axis) * width + lane] = high
            numbers[(spot_numbers.PRIOR_X + axis) * width + lane] = place
            numbers[(spot_numbers.X + axis) * width + lane] = min(max(place, low), high)
        numbers[spot_numbers.VARIANCE * width + lane] = max(settings[fused.VARIANCE, s], 0.0)
        numbers[spot_numbers.EXCESS * width + lane] = settings[fused.EXCESS, s]
        numbers[spot_numbers.PRIOR_WEIGHT * width + lane] = settings[fused.PRIOR_WEIGHT, s]
        numbers[spot_numbers.START_LIGHT * width + lane] = settings[fused.START_LIGHT, s]
        numbers[spot_numbers.GAIN_X * width + lane] = settings[fused.GAIN_X, s]
        numbers[spot_numbers.GAIN_Y * width + lane] = settings[fused.GAIN_Y, s]


@compiled
def _set_weights(width: Any, first: Any, settings: Any, numbers: Any) -> None:
    """Weights of the fit; the floor on them is a fraction of the light found so far."""
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        floor = settings[fused.WEIGHT_FLOOR, s] * numbers[spot_numbers.FLUX * width + lane]
        variance = numbers[spot_numbers.VARIANCE * width + lane] + floor
        numbers[spot_numbers.WEIGHT_VARIANCE * width + lane] = max(variance, SMALLEST_VARIANCE)
        numbers[spot_numbers.WEIGHT_EXCESS * width + lane] = settings[fused.WEIGHT_EXCESS, s]
        numbers[spot_numbers.MODEL_ERROR * width + lane] = settings[fused.MODEL_ERROR, s] ** 2


@compiled
def _expect_light(width: Any, first: Any, settings: Any, numbers: Any) -> None:
    """Take the light that is expected for the light."""
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        numbers[spot_numbers.FLUX * width + lane] = max(settings[fused.FLUX, s], LEAST_LIGHT_E)


@compiled
def _sum_light(lanes: Any, image: Any, ny: Any, nx: Any, first: Any, settings: Any, numbers: Any) -> None:
    """Standard errors from the training, and the light that is seen in the whole window."""
    width = width_of(lanes)
    zero = splat(lanes, 0.0)
    total = zero
    for y in range(ny):
        row = zero  # a sum for each row: they need not wait for each other
        for x in range(nx):
            row = row + load(lanes, image, (y * nx + x) * width)
        total = total + row
    store(numbers, spot_numbers.SEEN * width, total)
    for lane in range(width):
        s = min(first + lane, settings.shape[1] - 1)
        numbers[spot_numbers.ERROR_X * width + lane] = settings[fused.TRAINED_ERROR_X, s]
        numbers[spot_numbers.ERROR_Y * width + lane] = settings[fused.TRAINED_ERROR_Y, s]
        variance = numbers[spot_numbers.VARIANCE * width + lane]
        excess = numbers[spot_numbers.EXCESS * width + lane]
        seen = numbers[spot_numbers.SEEN * width + lane]
        numbers[spot_numbers.SEEN_ERROR * width + lane] = math.sqrt(
            ny * nx * variance + excess * max(seen, 0.0)
        )
        numbers[spot_numbers.FLUX * width + lane] = seen


@compiled
def _is_lit(width: Any, lane: Any, s: Any, method: Any, settings: Any, numbers: Any) -> Any:
    """Whether there is a spot: where its light is expected, not surely much less; else a significant one."""
    seen = numbers[spot_numbers.SEEN * width + lane]
    error = numbers[spot_numbers.SEEN_ERROR * width + lane]
    if method in (TRAINED, POSTERIOR):
        expected = settings[fused.FLUX, s]
        return expected >= LEAST_LIGHT_E and seen + _SURELY * error > _LIT_FRACTION * expected
    return seen >= LEAST_SIGNIFICANCE * error


@compiled
def _begin_at_posterior_mean(
    lanes: Any,
    image: Any,
    ny: Any,
    nx: Any,
    posterior: Any,
    kinds: Any,
    numbers: Any,
    starts: Any,
    rows: Any,
    values: Any,
) -> None:
    """Find the posterior's mean and spread; the fit begins at the mean."""
    width = width_of(lanes)
    tables, constants, grid, spacing = posterior
    posterior_of_group(
        lanes, image, ny, nx, tables, constants, grid, spacing, kinds, numbers, starts, rows, values
    )
    store(numbers, spot_numbers.X * width, load(lanes, numbers, spot_numbers.MEAN_X * width))
    store(numbers, spot_numbers.Y * width, load(lanes, numbers, spot_numbers.MEAN_Y * width))


@compiled
def _keep_broad_posteriors(width: Any, numbers: Any) -> None:
    """Along an axis on which the posterior is broader than its grid, its mean and spread are the result."""
    for lane in range(width):
        fitted = numbers[spot_numbers.ERROR_X * width + lane] < math.inf
        broad = _BROAD * numbers[spot_numbers.SPACING * width + lane]
        for axis in range(2):
            spread = numbers[(spot_numbers.SPREAD_X + axis) * width + lane]
            if spread > broad or not fitted:
                mean = numbers[(spot_numbers.MEAN_X + axis) * width + lane]
                numbers[(spot_numbers.X + axis) * width + lane] = mean
                numbers[(spot_numbers.ERROR_X + axis) * width + lane] = spread


@compiled
def _store_slope(
    width: Any,
    lane: Any,
    f: Any,
    s: Any,
    method: Any,
    steps: Any,
    settings: Any,
    numbers: Any,
    flags: Any,
    bad_counts: Any,
    slopes: Any,
) -> None:
    """Write one sub-aperture's result; the reference position (slope 0) where it is invalid."""
    x, y, flux, flag, iterations, bad_pixels, error_x, error_y = slopes
    bits = flags[lane]
    errors = numbers[spot_numbers.ERROR_X * width + lane] + numbers[spot_numbers.ERROR_Y * width + lane]
    light = numbers[spot_numbers.FLUX * width + lane]
    if not bits & TOO_MANY_BAD_PIXELS:  # which says it all
        lit = _is_lit(width, lane, s, method, settings, numbers)
        if not (errors < math.inf and lit and abs(light) < math.inf):
            bits |= NO_LIGHT
        elif light < settings[fused.LEAST_LIGHT, s]:
            bits |= OUTLIER_LIKELY
    valid = bits & (NO_LIGHT | TOO_MANY_BAD_PIXELS) == 0
    reach = settings[fused.RANGE, s]
    place_x, place_y = numbers[spot_numbers.X * width + lane], numbers[spot_numbers.Y * width + lane]
    x[f, s] = within(place_x - settings[fused.ZERO_X, s], reach) if valid else 0.0
    y[f, s] = within(place_y - settings[fused.ZERO_Y, s], reach) if valid else 0.0
    known = valid and settings[fused.VARIANCE, s] >= 0.0
    scale = settings[fused.ERROR_SCALE, s]
    error_x[f, s] = scale * numbers[spot_numbers.ERROR_X * width + lane] if known else math.inf
    error_y[f, s] = scale * numbers[spot_numbers.ERROR_Y * width + lane] if known else math.inf
    flux[f, s] = light if abs(light) < math.inf else 0.0
    flag[f, s] = bits
    iterations[f, s] = steps
    bad_pixels[f, s] = bad_counts[lane]
