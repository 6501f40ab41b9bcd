"""Centres of gravity: plain, of the brightest pixels, and of the flux above a threshold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import LARGEST_FLOAT32
from faintspot.base.errors import InputError
from faintspot.base.options import Value, is_auto, option
from faintspot.slopes.estimators.automatic import automatic_kept_pixels
from faintspot.slopes.estimators.base import (
    BACKGROUND,
    CALIBRATED,
    RAW,
    Estimator,
    EstimatorPlan,
    Need,
    Step,
    Style,
)
from faintspot.slopes.estimators.centroid import RULES, most_kept, threshold_rank
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import PIXEL_BLUR_PX2, Scene, Sensor
from faintspot.slopes.kernels.groups import RANGE
from faintspot.slopes.kernels.positions import gravity

KEPT_FRACTION = 0.08  # of a window's pixels, if keep_brightest is not given: 20 of 16 x 16
FEWEST_KEPT = 5
FLUX_FLOOR = 1e-4
_KEPT = (1.0, 0.35, 0.5, 0.7, 1.4, 2.0, 3.0, 4.5)  # multiples of the automatic number
_USUAL_RANGE_PX = 1.0  # of positions, if no search range is set


@dataclass(frozen=True, eq=False, kw_only=True)
class Centroid(Estimator):
    """Centre of gravity."""

    flux_floor: Any = option(
        FLUX_FLOOR,
        "A sub-aperture is flagged NO_FLUX when the flux after background subtraction does not exceed this "
        "fraction of the largest pixel of its image.",
        low=0.0,
        high=1.0,
    )

    steps_shown: ClassVar[tuple[Step, ...]] = (RAW, CALIBRATED, BACKGROUND)


@dataclass(frozen=True, eq=False, kw_only=True)
class KeepingBrightest(Centroid):
    """Centre of gravity of the brightest pixels."""

    keep_brightest: Value = option(
        None,
        "Number of pixels kept by the background subtraction. Default: 8 % of the window's pixels, at "
        'least 5. "auto": chosen by `estimators.automatic.automatic_kept_pixels`.',
        low=1,
        high=2**24,
        whole=True,
        automatic=True,
    )
    rule: Value = option(
        "subtract_next",
        "Rule that sets the level subtracted from the kept pixels; see `faintspot.brightest_pixels`.",
        choices=RULES,
    )

    automatic_method: ClassVar[str]
    """Value of `method` for `automatic_kept_pixels`."""

    @property
    def uses_flux(self) -> bool:
        """See `Estimator`."""
        return self.is_automatic

    @property
    def is_automatic(self) -> bool:
        """Whether an option is chosen from the flux."""
        return is_auto(self.keep_brightest)

    @property
    def required(self) -> frozenset[Need]:
        """Knowledge required by the automatic options, if there are any."""
        return frozenset({Need.READ_NOISE, Need.WIDTH}) if self.is_automatic else frozenset()

    def default_of(self, name: str, pixels: int) -> float:
        """Return the default of `keep_brightest`."""
        if name == "keep_brightest":
            return min(max(FEWEST_KEPT, round(KEPT_FRACTION * pixels)), pixels - 1)
        return super().default_of(name, pixels)

    def denoised(self, images: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return the images (n, ny, nx) from which the brightest pixels are selected.

        None if only the kernel can compute them. Studies evaluate all numbers of kept pixels on these
        images at once.
        """
        return None

    def without_denoising(self) -> BrightestPixels | None:
        """See `Estimator`."""
        if self.strength_option is None:
            return None
        return BrightestPixels(**{name: getattr(self, name) for name in BrightestPixels.declared()})

    def for_bright_flux(self) -> Estimator:
        """Keep the default number of pixels if the number is automatic."""
        return self.replaced({"keep_brightest": None}) if is_auto(self.keep_brightest) else self

    def kept_in_words(self, n_subapertures: int, pixels: int) -> str:
        """Describe the steps after denoising."""
        kept, rule = (self._span(name, n_subapertures, pixels) for name in ("keep_brightest", "rule"))
        number = "an automatic number of" if is_auto(self.keep_brightest) else kept
        return f"{number} brightest of {pixels} pixels kept (rule {rule}), centre of gravity"

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return numbers of kept pixels around the automatic one, larger for speckled spots."""
        kept = float(automatic_kept_pixels(**scene.rule_arguments, method=self.automatic_method))
        kept *= max(1.0, scene.d_over_r0)
        numbers = (int(np.clip(round(kept * factor), 1, scene.pixels - 1)) for factor in _KEPT)
        return {"keep_brightest": list(dict.fromkeys(numbers))}


class GravityPlan(EstimatorPlan):
    """Settings and tables of a centre of gravity."""

    kernel = staticmethod(gravity.gravity_of_groups)
    own_scratch = staticmethod(gravity.gravity_scratch)
    tables: Any = gravity.GravityTables()
    setting_rows = gravity.SETTING_ROWS
    fewer_lanes_are_faster = True

    estimator: Centroid

    def __init__(self, estimator: Centroid, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        self._keeping = estimator if isinstance(estimator, KeepingBrightest) else None
        automatic = self._keeping is not None and self._keeping.is_automatic
        self.needs_flux = automatic and bool(np.isnan(sensor.flux_e).all())
        # An automatic number of kept pixels depends on the search range.
        ranges = {} if automatic else {"search_range_px": RANGE}
        self.rows_of_options = {"flux_floor": gravity.FLOOR, **ranges}

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        table[gravity.FLOOR], table[gravity.SPREAD] = self.each("flux_floor"), 1.0

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        if self._keeping is None:
            keep_all(table)
            return
        keep = self.each("keep_brightest")
        if is_auto(self._keeping.keep_brightest):
            method = self._keeping.automatic_method
            keep = automatic_kept_pixels(**self.rule_arguments(flux_e), method=method)
        pixels, rules = self.sensor.pixels, self.each("rule")
        for rule in np.unique(rules):
            selected = rules == rule
            limit = most_kept(pixels, rule)
            if keep[selected].max() > limit:
                ny, nx = self.sensor.window
                raise InputError(
                    f"estimator.keep_brightest = {keep[selected].max()}: expected at most {limit} "
                    f"with rule {str(rule)!r} in windows of {ny} x {nx} pixels"
                )
            table[gravity.RANK, selected] = threshold_rank(keep[selected], rule)
            table[gravity.SUBTRACT, selected] = rule != "threshold"

    def rule_arguments(self, flux_e: Floats) -> dict[str, Any]:
        """Return the arguments of the automatic rules: flux, camera and optical spot size."""
        sensor, fwhm = self.sensor, self.sensor.spot_fwhm_px
        optical = np.sqrt(np.maximum(fwhm**2 - PIXEL_BLUR_PX2, 0.25 * fwhm**2))
        # Rounded as in the kernel's table.
        reach = sensor.search_range_px.astype(np.float32)
        return {
            "flux_e": flux_e,
            "read_noise_e": sensor.read_noise_e,
            "pixels": sensor.pixels,
            "excess_noise": sensor.excess_noise,
            "background_e": sensor.calibration.background_e,
            "spot_fwhm_px": np.sqrt(optical.prod(axis=1)),
            "elongation": optical.max(axis=1) / optical.min(axis=1),
            "position_range_px": np.where(np.isfinite(reach), reach, _USUAL_RANGE_PX),
        }


def keep_all(table: NDArray[np.float32]) -> None:
    """Skip the background subtraction."""
    table[gravity.RANK] = table[gravity.SUBTRACT] = 0.0
    table[gravity.LEVEL] = -LARGEST_FLOAT32  # below every pixel


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class BrightestPixels(KeepingBrightest):
    """Centre of gravity of the brightest pixels (Basden, Myers & Gendron 2012), without denoising."""

    name = "brightest"
    label = "brightest pixels"
    method = "brightest pixels, centre of gravity"
    cost = 0.21
    style = Style("#000000", "--", "o")
    plan = GravityPlan
    automatic_method = "none"

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        return f"no denoising; {self.kept_in_words(n_subapertures, pixels)}"

    def denoised(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """See `KeepingBrightest`."""
        return images


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class CentreOfGravity(Centroid):
    """Centre of gravity of the whole window, without background subtraction."""

    name = "centroid"
    label = "centre of gravity"
    method = "centre of gravity of the whole window"
    cost = 0.13
    style = Style("#666666", ":", "x")
    plan = GravityPlan
    steps_shown = (RAW, CALIBRATED)


_OF_NOISE = (3.0, 1.5, 2.0, 2.5, 4.0, 5.0)  # multiples of the noise of a dark pixel
_OF_PEAK = (0.05, 0.1, 0.2, 0.3)  # for bright spots
_SMALLEST_E = 0.01


class _ThresholdedPlan(GravityPlan):
    """Thresholds of a centre of gravity."""

    def __init__(self, estimator: Centroid, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        self.rows_of_options = {**self.rows_of_options, "threshold_e": gravity.LEVEL}

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        table[gravity.LEVEL], table[gravity.SUBTRACT] = self.each("threshold_e"), 1.0


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Thresholded(Centroid):
    """Centre of gravity after subtracting a threshold from every pixel; negative pixels are set to 0."""

    threshold_e: Value = option(None, "Level subtracted from every pixel.", unit="e-", low=0.0, high=1e12)

    name = "thresholded"
    label = "thresholded centre of gravity"
    method = "centre of gravity of the flux above a threshold"
    cost = 0.15
    style = Style("#9a9a9a", ":", "X")
    plan = _ThresholdedPlan

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        return f"centre of gravity of the flux above {self._span('threshold_e', n_subapertures, pixels)} e-"

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return multiples of the noise of a dark pixel, and fractions of a typical spot's peak."""
        peak = scene.flux_e / (2.5 * scene.seen_fwhm_px**2)
        levels = [factor * scene.dark_noise_e for factor in _OF_NOISE] + [
            factor * peak for factor in _OF_PEAK
        ]
        return {"threshold_e": list(dict.fromkeys(max(float(f"{e:.3g}"), _SMALLEST_E) for e in levels))}

    def for_bright_flux(self) -> Thresholded:
        """Subtract nothing: a threshold for low flux does not suit high flux."""
        return self.replaced({"threshold_e": 0.0})

    def check(self, sensor: Sensor) -> None:
        """See `Estimator`."""
        if np.isnan(self.values("threshold_e", sensor.n, sensor.pixels).astype(float)).any():
            raise InputError(
                f"estimator.threshold_e: expected a level (electrons) for estimator {self.name!r}, got none"
            )
