"""The arms that are compared, and what each may choose from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from faintspot.estimate.automatic import automatic_kept_pixels, automatic_smoothing, automatic_strength
from faintspot.estimate.noise import suggested_strength
from faintspot.planner.question import Question
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.settings import Settings

NOTHING, WIDTH, SPOT = 0, 1, 2
KNOWLEDGE = ("noise only", "spot width", "the spot itself")
"""What an arm has to know, by its `Arm.knowledge`."""


@dataclass(frozen=True)
class Arm:
    """One way to find a spot's position."""

    name: str
    label: str
    estimator: str
    cost: float
    """Time, in units of the pipeline with 20 iterations of TV (16 x 16 px); measured once."""
    knowledge: int


ARMS = (
    Arm("plain", "brightest pixels", "cog", 0.21, NOTHING),
    Arm("thresholded", "thresholded", "thresholded", 0.15, NOTHING),
    Arm("smoothed", "Gaussian smoothing", "smoothed", 0.22, NOTHING),
    Arm("tv", "TV denoising", "cog", 0.71, NOTHING),
    Arm("weighted", "weighted", "weighted", 0.23, WIDTH),
    Arm("matched", "matched filter", "matched", 0.26, SPOT),
    Arm("ml", "maximum likelihood", "ml", 0.27, SPOT),
    Arm("map", "max. a posteriori", "map", 0.6, SPOT),
    Arm("trained", "trained score", "trained", 0.15, SPOT),
)

_KEPT = (1.0, 0.35, 0.5, 0.7, 1.4, 2.0, 3.0, 4.5)  # times the automatic number
_STRENGTHS = (1.0, 0.4, 0.6, 0.8, 1.25)  # times the automatic strength
_SMOOTHINGS = (1.0, 0.6, 0.8, 1.3, 1.7)  # times the automatic width
_THRESHOLDS = (3.0, 1.5, 2.0, 2.5, 4.0, 5.0)  # noises of a dark pixel
_OF_PEAK = (0.05, 0.1, 0.2, 0.3)  # thresholds where a spot is bright
_WEIGHTS = (1.0, 0.6, 0.8, 1.25, 1.6, 2.2)  # times the spot's width
_BLURS = (0.4, 0.0, 0.8, 1.2)  # of a speckled spot's PSF, in units of lambda / d
_MODEL_ERRORS = (0.3, 0.0, 1.0)
_PIXEL_BLUR = 0.46  # px^2, that the pixel adds to the square of a Gaussian spot's width
_LEARNT_WEIGHT_FLOOR = 1e-3
_SMALLEST_THRESHOLD_E = 0.01

Choice = dict[str, float]
"""A value for each name of an arm's axes."""


@dataclass(frozen=True, eq=False)
class Workshop:
    """Makes the candidates of every arm, for one question."""

    question: Question
    score: TrainedScore | None = None

    @cached_property
    def psf(self) -> PSF:
        """The user's PSF, or that of the assumed profile."""
        question = self.question
        if question.psf is not None:
            return question.psf
        radius = math.ceil(max(question.shape) / 2 + question.search_range_px + 1)
        return PSF.analytic(question.profile, size=question.size, radius_px=radius)

    @cached_property
    def _blurred(self) -> dict[float, PSF]:
        return {0.0: self.psf}

    def axes(self, arm: Arm, flux_e: float) -> dict[str, list[float]]:
        """Return what an arm may choose from at a flux; the automatic value of each is the first."""
        if arm.estimator in ("cog", "smoothed"):
            return self._denoising_axes(arm.name, flux_e)
        if arm.name == "thresholded":
            return {"threshold_e": self._thresholds(flux_e)}
        if arm.name == "weighted":
            return {"weight_fwhm_px": [factor * self._seen_fwhm_px for factor in _WEIGHTS]}
        if arm.estimator in ("ml", "map", "matched") and self.question.d_over_r0:
            errors = {} if arm.name == "matched" else {"model_error": list(_MODEL_ERRORS)}
            return {"blur_px": [factor * 2 * self.question.size for factor in _BLURS], **errors}
        return {}

    def settings(self, arm: Arm, choice: Choice) -> Settings:
        """Return the settings of an arm with these values."""
        values: dict[str, Any] = {name: value for name, value in choice.items() if name != "blur_px"}
        if "keep_brightest" in values:
            values["keep_brightest"] = int(values["keep_brightest"])
        values |= {"estimator": arm.estimator, "search_range_px": self.question.search_range_px}
        if arm.name == "plain":
            values["denoise"] = False
        if arm.name == "tv":
            values["preset"] = "fast"
        if arm.name == "weighted":
            values["spot_fwhm_px"] = self._seen_fwhm_px
        if arm.estimator in ("ml", "map") and self.question.psf is not None:
            values["weight_floor"] = _LEARNT_WEIGHT_FLOOR
        if arm.name == "map":  # of positions uniform within the range
            values["prior_std_px"] = self.question.search_range_px / math.sqrt(3)
        rounded: dict[str, Any] = {
            key: rounded_to_3(value) if isinstance(value, float) else value for key, value in values.items()
        }
        return Settings(**rounded)

    def parts(self, arm: Arm, choice: Choice) -> dict[str, Any]:
        """Return the PSF or score that an arm needs, as `SlopePipeline` takes them."""
        if arm.name == "trained":
            return {"score": self.score}
        if arm.estimator not in ("matched", "ml", "map"):
            return {}
        blur = choice.get("blur_px", 0.0)
        if blur not in self._blurred:
            self._blurred[blur] = self.psf.blurred(blur)
        return {"psf": self._blurred[blur]}

    @property
    def _seen_fwhm_px(self) -> float:
        """Width of the spots with the pixels' blur."""
        return math.sqrt(self.question.fwhm_px**2 + _PIXEL_BLUR)

    def _rule(self, flux_e: float) -> dict[str, Any]:
        """Arguments of the automatic rules."""
        question = self.question
        ny, nx = question.shape
        return {
            "flux_e": flux_e,
            "read_noise_e": question.read_noise_photoelectrons,
            "pixels": ny * nx,
            "spot_fwhm_px": question.fwhm_px,
            "excess_noise": question.detector.excess_noise_factor,
            "background_e": question.background_e,
            "position_range_px": question.search_range_px,
            "profile": question.profile,
        }

    def _denoising_axes(self, name: str, flux_e: float) -> dict[str, list[float]]:
        rule = self._rule(flux_e)
        method = {"plain": "none", "smoothed": "smoothed", "tv": "tv"}[name]
        kept = float(automatic_kept_pixels(**rule, method=method))
        # Speckles spread the light over more pixels than the rule knows of.
        kept *= max(1.0, self.question.d_over_r0)
        most = rule["pixels"] - 1
        numbers = list(dict.fromkeys(float(np.clip(round(kept * factor), 1, most)) for factor in _KEPT))
        axes: dict[str, list[float]] = {"keep_brightest": numbers}
        if name == "smoothed":
            width = float(automatic_smoothing(**rule)) or 0.7
            axes["smoothing_px"] = [width * factor for factor in _SMOOTHINGS]
        if name == "tv":
            noise, excess = question_noise(self.question), rule["excess_noise"]
            ordinary = float(suggested_strength(noise, excess * flux_e, rule["pixels"]))
            strength = float(automatic_strength(**rule)) or ordinary
            axes["noise_std"] = [max(strength, 1e-3) * factor for factor in _STRENGTHS]
        return axes

    def _thresholds(self, flux_e: float) -> list[float]:
        noise = question_noise(self.question)
        peak = flux_e / (2.5 * self._seen_fwhm_px**2)  # of a typical spot, roughly
        levels = [factor * noise for factor in _THRESHOLDS] + [factor * peak for factor in _OF_PEAK]
        return list(dict.fromkeys(max(rounded_to_3(level), _SMALLEST_THRESHOLD_E) for level in levels))


def question_noise(question: Question) -> float:
    """Return the noise of a dark pixel, photo-electrons."""
    excess = question.detector.excess_noise_factor
    return math.sqrt(question.read_noise_photoelectrons**2 + excess * question.background_e)


def rounded_to_3(value: float) -> float:
    """Return a number to three digits: what is written is what was measured."""
    return float(f"{value:.3g}")
