"""The demonstration: a simulated faint star on a CANARY-like sensor, with and without denoising.

7 x 7 sub-apertures of which 36 are lit, 16 x 16 pixels each, an EMCCD at high gain.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none, number_between
from faintspot.base.statistics import Estimate, absolute_errors
from faintspot.experiments.curves import Curve, Gain, gain_at_flux
from faintspot.experiments.methods import NO_TV, TV, TV_OVER_NO_TV
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.noise import suggested_strength
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames

FLUXES_E = (15.0, 30.0, 60.0, 120.0, 240.0, 480.0)
SHOWN_FLUX_E = 60.0
POSITION_RANGE_PX = 1.0
BEST_KEPT = (6, 8, 10, 12, 16, 20, 28, 40, 60)
FIXED_KEPT = 40
STRENGTH_FACTORS = (0.5, 0.7, 1.0, 1.4)

DETECTOR = Detector(read_noise_e=45.0, em_gain=500.0, gain_e_per_adu=20.0, offset_adu=200.0, bits=16)
CALIBRATION = Calibration(dark=200.0, gain_e_per_adu=20.0, em_gain=500.0)
READ_NOISE_E = 45.0 / 500.0  # referred to photo-electrons
EXCESS_NOISE = 2.0


@dataclass(frozen=True)
class Scored:
    """Choice at one flux, with its errors on other frames."""

    settings: Settings
    errors: NDArray[np.float64]
    """(|dx| + |dy|) / 2 of every scored slope, px."""

    @property
    def slope_error(self) -> Estimate:
        """R with its standard error, px."""
        return Estimate.of_mean(self.errors)


@dataclass(frozen=True)
class Comparison:
    """Measurements without and with denoising at every flux of FLUXES_E, in one mode."""

    mode: str
    without: list[Scored]
    denoised: list[Scored]

    def difference(self, i: int) -> Estimate:
        """R without minus R with denoising at flux i, with its paired standard error."""
        return Estimate.of_mean(self.without[i].errors - self.denoised[i].errors)

    def flux_gain(self, rng: np.random.Generator) -> Gain:
        """Flux gain of denoising at SHOWN_FLUX_E."""
        errors = {TV: self.denoised, NO_TV: self.without}
        curve = Curve.of_errors(
            FLUXES_E,
            {method: np.stack([score.errors for score in scored]) for method, scored in errors.items()},
        )
        return not_none(gain_at_flux(curve, SHOWN_FLUX_E, rng, **TV_OVER_NO_TV))  # at one of its fluxes


def demonstration_layout() -> Layout:
    """Return the layout: 36 of 7 x 7 sub-apertures of 16 x 16 pixels."""
    return Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)


def simulate(
    layout: Layout, flux_e: float, n_frames: int, rng: np.random.Generator
) -> tuple[NDArray[Any], NDArray[np.float64]]:
    """Return frames in ADU and the true positions (n_frames, n, 2), px."""
    return sensor_frames(
        layout, n_frames, flux_e=flux_e, position_range_px=POSITION_RANGE_PX, detector=DETECTOR, rng=rng
    )


def compare(
    n_frames: int, rng: np.random.Generator, progress: Callable[[int, int], None] | None = None
) -> list[Comparison]:
    """Measure R with and without denoising at all fluxes, in both modes.

    Number of kept pixels and strength are chosen on the first half of the frames and scored on the other.

    Raises
    ------
    InputError
        For fewer than two frames.
    """
    n_frames = int(number_between("n_frames", n_frames, 2, integer=True))
    layout = demonstration_layout()
    comparisons = [Comparison("best k", [], []), Comparison(f"fixed k = {FIXED_KEPT}", [], [])]
    for i, flux in enumerate(FLUXES_E):
        frames, truth = simulate(layout, flux, n_frames, rng)
        best = float(suggested_strength(READ_NOISE_E, flux, layout.pixels, excess_noise=EXCESS_NOISE))
        for comparison, kept in zip(comparisons, (BEST_KEPT, (FIXED_KEPT,)), strict=True):
            without = [Settings(NO_TV, keep_brightest=k) for k in kept]
            with_tv = [
                Settings(TV, noise_std=best * factor, keep_brightest=k)
                for factor in STRENGTH_FACTORS
                for k in kept
            ]
            comparison.without.append(choose(layout, without, frames, truth))
            comparison.denoised.append(choose(layout, with_tv, frames, truth))
        if progress is not None:
            progress(i + 1, len(FLUXES_E))
    return comparisons


def choose(
    layout: Layout, candidates: list[Settings], frames: NDArray[np.generic], truth: NDArray[np.float64]
) -> Scored:
    """Choose the settings with the smallest R on the first half of the frames; score them on the other."""
    half = len(frames) // 2

    def errors(settings: Settings, part: slice) -> NDArray[np.float64]:
        slopes = SlopePipeline(layout, settings, CALIBRATION)(frames[part])
        return absolute_errors(slopes.x, slopes.y, truth[part]).ravel()

    best = min(candidates, key=lambda settings: float(errors(settings, slice(half)).mean()))
    return Scored(best, errors(best, slice(half, None)))
