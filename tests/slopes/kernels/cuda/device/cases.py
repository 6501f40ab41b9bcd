"""Small sensors, and what it means that the GPU's slopes equal the CPU's."""

from __future__ import annotations

from typing import Any

import numpy as np
from tests import naive
from tests.pipeline_cases import MARGIN, Case, largest_value, random_calibration, random_settings

import faintspot as fs

Flag = fs.SubapertureFlag
ROUNDING = 100 * float(np.finfo(np.float32).eps)  # two float32 results, each within half of this of the truth


def small_case(seed: int, dtype: str, window: tuple[int, int], columns: int = 3, **fixed: Any) -> Case:
    """A row of sub-apertures with settings of their own, on a frame with noise and a spot in each."""
    rng = np.random.default_rng(seed)
    ny, nx = window
    layout = fs.Layout.grid(
        (1, columns), pixels=window, origin=(1, 2), frame_shape=(ny + 2, nx * columns + 3)
    )
    frame = 20.0 + rng.normal(0.0, 3.0, layout.frame_shape)
    y, x = np.mgrid[: layout.frame_shape[0], : layout.frame_shape[1]]
    for centre_x, centre_y in layout.centres + rng.uniform(-1, 1, layout.centres.shape):
        frame += rng.uniform(20, 60) * np.exp(-((x - centre_x) ** 2 + (y - centre_y) ** 2) / 2)
    settings = random_settings(rng, columns, ny * nx, denoised=True)
    settings = settings.replace(**{"max_iterations": np.minimum(settings.max_iterations, 12)} | fixed)
    if np.dtype(dtype).kind == "u":
        frame = np.rint(frame)
        frame[rng.random(frame.shape) < 0.004] = np.iinfo(dtype).max
    else:
        for value in (np.nan, np.inf, -np.inf, 6e4):
            frame[rng.random(frame.shape) < 0.003] = value
    calibration = random_calibration(rng, layout.frame_shape)
    return Case(frame.astype(dtype), layout, settings, calibration, rng.uniform(-0.5, 0.5, (columns, 2)))


def assert_near(case: Case, found: fs.Slopes, expected: fs.Slopes) -> None:
    """Assert equal decisions, and numbers within rounding; but for decisions that rounding may turn."""
    truth = naive.slopes(case.frame, case.layout, case.settings, case.calibration, case.reference)
    scales, side = largest_value(case), max(case.layout.window)
    for s, (true, scale) in enumerate(zip(truth, scales, strict=True)):
        assert found.bad_pixels[s] == expected.bad_pixels[s]
        if true.denoised.margin < MARGIN:
            continue
        error_e = ROUNDING * scale * case.layout.pixels
        assert found.iterations[s] == expected.iterations[s]
        assert (found.flags[s] ^ expected.flags[s]) & ~Flag.NO_FLUX == 0
        assert abs(found.flux[s] - expected.flux[s]) <= error_e
        if error_e * side < 0.02 * abs(expected.flux[s]):
            assert found.flags[s] == expected.flags[s]
            bound = error_e * side / abs(expected.flux[s]) + ROUNDING * side
            assert abs(found.x[s] - expected.x[s]) <= bound
            assert abs(found.y[s] - expected.y[s]) <= bound
            for name in ("standard_error_x", "standard_error_y"):
                left, right = getattr(found, name)[s], getattr(expected, name)[s]
                # A pixel at the threshold may be left or not; it then counts with its own noise.
                assert left == right or abs(left - right) <= 0.02 * right
            largest = expected.standard_error_x[s] * expected.standard_error_y[s]
            assert abs(found.covariance_xy[s] - expected.covariance_xy[s]) <= 0.04 * min(largest, 1e9)
    for name in ("x", "y", "flux"):
        assert np.all(np.isfinite(getattr(found, name)))
    assert not np.any(np.isnan(found.standard_error_x) | np.isnan(found.standard_error_y))
    assert np.all(np.isfinite(found.covariance_xy))
