"""Random sensors, and what it means that slopes equal the oracle's."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests import naive

import faintspot as fs

Flag = fs.SubapertureFlag
FIELDS = ("x", "y", "flux", "flags", "iterations", "bad_pixels")
# Rounding of float32, in units of the largest value that entered the calibration.
ROUNDING = 60 * float(np.finfo(np.float32).eps)
MARGIN = 1e-3  # of a decision that rounding may turn


@dataclass
class Case:
    frame: NDArray[Any]
    layout: fs.Layout
    settings: fs.Settings
    calibration: fs.Calibration
    reference: NDArray[Any]

    def pipeline(self, **options: Any) -> fs.SlopePipeline:
        return fs.SlopePipeline(self.layout, self.settings, self.calibration, self.reference, **options)


def random_layout(rng: np.random.Generator, narrowest: int) -> fs.Layout:
    ny, nx = int(rng.integers(4, 13)), int(rng.integers(narrowest, 13))
    rows, columns = (int(n) for n in rng.integers(1, 5, 2))
    gap, origin = rng.integers(0, 3, 2), rng.integers(0, 4, 2)
    grid = fs.Layout.grid(
        (rows, columns),
        pixels=(ny, nx),
        pitch=(ny + int(gap[0]), nx + int(gap[1])),
        origin=(int(origin[0]), int(origin[1])),
        frame_shape=(60, 60),
    )
    centres = grid.centres + rng.uniform(-1, 1, grid.centres.shape)
    return fs.Layout(grid.frame_shape, grid.window, grid.corners, centres)


def random_settings(rng: np.random.Generator, n: int, pixels: int, algorithm: str) -> fs.Settings:
    """Different settings for every sub-aperture. "threshold" is not continuous in the image and can only be
    compared where the image is exact, without denoising. Some sensors' estimator does not denoise at all.
    """
    rule = rng.choice(["subtract_next", "threshold", "subtract_kth"], n)
    strength = rng.uniform(0.0, 6.0, n) * rng.integers(0, 2, n) + 0.3
    shared: dict[str, Any] = {
        "keep_brightest": rng.integers(1, pixels, n),
        "rule": rule,
        "flux_floor": rng.choice([1e-4, 0.1], n),
        "max_bad_fraction": rng.choice([0.0, 0.05, 0.25, 1.0], n),
    }
    if rng.random() < 0.2:
        return fs.Settings("brightest", **shared)
    return fs.Settings(
        "tv",
        noise_std=np.where((rule != "threshold") & (rng.random(n) < 0.8), strength, 0.0),
        tolerance=rng.choice([0.0, 1e-2, 0.1], n),
        max_iterations=rng.integers(1, 40, n),
        algorithm=algorithm,
        preset=str(rng.choice(["accurate", "fast"])),
        **shared,
    )


def random_calibration(rng: np.random.Generator, shape: tuple[int, int]) -> fs.Calibration:
    def maybe(value: Any, otherwise: Any) -> Any:
        return value if rng.random() < 0.5 else otherwise

    dark, flat = rng.normal(20.0, 1.0, shape), rng.normal(1.0, 0.1, shape)
    dark[rng.random(shape) < 0.01] = np.nan
    flat[rng.random(shape) < 0.01] = rng.choice([0.0, -1.0, np.nan, np.inf])
    bad = rng.random(shape) < 0.03
    return fs.Calibration(
        dark=maybe(dark, 20.0),
        flat=maybe(flat, None),
        gain_e_per_adu=maybe(1.7, 1.0),
        em_gain=maybe(3.0, 1.0),
        bad_pixels=maybe(bad, maybe(np.argwhere(bad), None)),
        saturation_adu=maybe(120.0, None),
    )


def random_case(seed: int, dtype: str, algorithm: str = "fgp") -> Case:
    rng = np.random.default_rng(seed)
    layout = random_layout(rng, 4 if np.dtype(dtype).kind == "f" else 8)  # fewer kernels are compiled
    height, width = layout.frame_shape
    frame = 20.0 + rng.normal(0.0, 3.0, (height, width))
    y, x = np.mgrid[:height, :width]
    for centre_x, centre_y in layout.centres + rng.uniform(-1, 1, layout.centres.shape):
        frame += rng.uniform(0, 60) * np.exp(-((x - centre_x) ** 2 + (y - centre_y) ** 2) / 2)
    kind = np.dtype(dtype)
    if kind.kind in "iu":
        frame = np.rint(frame)
        frame[rng.random(frame.shape) < 0.002] = np.iinfo(kind).max
    elif rng.random() < 0.5:
        for value in (np.nan, np.inf, -np.inf, 6e4, -6e4):
            frame[rng.random(frame.shape) < 0.003] = value
    low, high = (np.iinfo(kind).min, np.iinfo(kind).max) if kind.kind in "iu" else (-np.inf, np.inf)
    return Case(
        np.clip(frame, low, high).astype(kind),
        layout,
        random_settings(rng, len(layout), layout.pixels, algorithm),
        random_calibration(rng, (height, width)),
        rng.uniform(-0.5, 0.5, (len(layout), 2)),
    )


def largest_value(case: Case) -> NDArray[np.float64]:
    """Largest magnitude, in electrons, that entered the calibration of each sub-aperture's good pixels."""
    raw = np.abs(case.frame.astype(np.float64)) + 30.0
    scale = case.calibration.maps(case.layout.frame_shape)[1].astype(np.float64)
    value = raw * scale
    value[~np.isfinite(value)] = 0.0
    return case.layout.images(value).max(axis=(-2, -1))  # type: ignore[no-any-return]


def strengths_of(case: Case) -> NDArray[np.float64]:
    """Strength of the denoising of every sub-aperture; 0 where there is none."""
    n = len(case.layout)
    if not case.settings.estimator.without_denoising():
        return np.zeros(n)
    return case.settings.values("noise_std", n, case.layout.pixels)


def assert_equals_oracle(case: Case, slopes: fs.Slopes) -> None:
    ny, nx = case.layout.window
    rules = case.settings.values("rule", len(case.layout), ny * nx)
    strengths = strengths_of(case)
    fwhm = 0.58 * np.sqrt(case.settings.values("keep_brightest", len(case.layout), ny * nx))[:, None]
    found = naive.slopes(case.frame, case.layout, case.settings, case.calibration, case.reference)
    measured = [slope.flags & (Flag.NO_FLUX | Flag.TOO_MANY_BAD_PIXELS) == 0 for slope in found]
    known = case.frame, case.layout, case.calibration, float(np.median(fwhm))
    light = naive.light(*known, slopes.flux, measured)
    for s in np.flatnonzero(light.dark).tolist():
        found[s].x, found[s].y, found[s].flags = 0.0, 0.0, found[s].flags | Flag.NO_FLUX
    doubtful = naive.doubtful(slopes, case.layout, fwhm, case.reference)
    assert np.array_equal(slopes.flags & (Flag.AT_SEARCH_LIMIT | Flag.UNLIKE_NEIGHBOURS), doubtful)
    flags = slopes.flags & ~np.uint8(Flag.AT_SEARCH_LIMIT | Flag.UNLIKE_NEIGHBOURS)
    for s, (expected, scale) in enumerate(zip(found, largest_value(case), strict=True)):
        assert slopes.bad_pixels[s] == expected.bad_pixels
        if light.unsure[s]:
            continue
        assert (flags[s] ^ expected.flags) & ~(Flag.NO_FLUX | 16 | 32) == 0
        if expected.denoised.margin < MARGIN or 0 < strengths[s] < 1e-6 * scale:
            continue  # a strength below the image's rounding error counts as zero
        assert slopes.iterations[s] == expected.iterations
        assert (flags[s] ^ expected.flags) & ~Flag.NO_FLUX == 0
        if rules[s] == "threshold" and expected.bad_pixels:
            continue  # filled pixels may tie with others but for rounding
        error_e = ROUNDING * scale * ny * nx
        assert abs(slopes.flux[s] - expected.flux) <= error_e
        if abs(expected.flux) > 0 and error_e * max(ny, nx) < 0.02 * abs(expected.flux):
            assert flags[s] == expected.flags
            bound = error_e * max(ny, nx) / abs(expected.flux) + ROUNDING * max(ny, nx)
            assert abs(slopes.x[s] - expected.x) <= bound
            assert abs(slopes.y[s] - expected.y) <= bound


def assert_same(a: Any, b: Any, select: Any = slice(None), fields: Any = FIELDS) -> None:
    for field in fields:
        left, right = getattr(a, field)[select], getattr(b, field)[select]
        assert np.array_equal(left, right, equal_nan=True), field
