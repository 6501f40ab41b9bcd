"""The ways to measure slopes that a closed-loop experiment compares, and what of each is tuned."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from faintspot.checks import one_of
from faintspot.errors import InputError
from faintspot.estimate.noise import suggested_strength
from faintspot.loop.calibration import make_detector
from faintspot.loop.configuration import CLOSED, R0_WAVELENGTH_M, LoopConfiguration
from faintspot.loop.record import Arm
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.settings import Settings

Choice = Mapping[str, float]
"""Values of the parameters that are tuned, by name."""

_MOST_ITERATIONS = 100  # near infeasible strengths the denoising is far from done after ten
_TOLERANCE = 1e-3
_TRAINING_SPOTS = 8000
_TRAINING_RANGE_PX = {CLOSED: 2.0, "open": 5.0}
_TRAINING_SEED = 4


@dataclass(frozen=True)
class Parameter:
    """Something of an arm that is tuned."""

    values: tuple[float, ...]
    """Increasing: what it may be."""
    coarse: tuple[float, ...]
    """Those of the first look."""
    meaning: str


PARAMETERS: dict[str, Parameter] = {
    "gain": Parameter((0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9), (0.2, 0.4, 0.7), "loop gain"),
    "kept": Parameter(
        (0.015, 0.02, 0.03, 0.045, 0.065, 0.09, 0.13, 0.18, 0.25, 0.35, 0.5, 0.7),
        (0.045, 0.13, 0.35),
        "brightest pixels kept, as a fraction of the window's",
    ),
    "strength": Parameter(
        (0.1, 0.2, 0.3, 0.4, 0.55, 0.7, 0.85, 1.0, 1.2),
        (0.4, 0.85),
        "strength of the denoising, as a fraction of the noise of a mean pixel",
    ),
    "smoothing_px": Parameter(
        (0.5, 0.7, 0.9, 1.2, 1.6, 2.1, 2.8, 3.7), (0.7, 1.6), "standard deviation of the Gaussian, px"
    ),
    "threshold": Parameter(
        (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0),
        (0.5, 1.5, 3.0),
        "threshold, as a multiple of the noise of a mean pixel",
    ),
    "weight": Parameter(
        (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6),
        (1.0, 2.0, 4.0),
        "width of the weight, in lambda / d",
    ),
    "blur_px": Parameter(
        (0.0, 0.4, 0.8, 1.2, 1.7, 2.3, 3.0), (0.8, 1.7), "Gaussian blur of the PSF for what speckles add, px"
    ),
    "model_error": Parameter(
        (0.0, 0.1, 0.2, 0.35, 0.5, 0.8), (0.1, 0.5), "how far spots differ from the PSF, as a fraction"
    ),
    "prior_px": Parameter((0.2, 0.35, 0.5, 0.7, 1.0, 1.5), (0.5, 1.0), "standard deviation of the prior, px"),
}


@dataclass(frozen=True)
class _Recipe:
    """How an arm is made."""

    label: str
    parameters: tuple[str, ...]
    settings: Callable[[LoopConfiguration, Choice], Settings]
    options: tuple[tuple[str, Any], ...] = ()
    """Of `Arm`."""


def _plain(configuration: LoopConfiguration, choice: Choice) -> Settings:
    # Of all pixels but the darkest one, nothing subtracted.
    kept = configuration.sensor.pixels**2 - 1
    return Settings(denoise=False, keep_brightest=kept, rule="threshold")


def _thresholded(configuration: LoopConfiguration, choice: Choice) -> Settings:
    return Settings(
        estimator="thresholded", threshold_e=choice["threshold"] * mean_pixel_noise_e(configuration)
    )


def _brightest(configuration: LoopConfiguration, choice: Choice) -> Settings:
    return Settings(denoise=False, keep_brightest=kept_pixels(configuration, choice["kept"]))


def _smoothed(configuration: LoopConfiguration, choice: Choice) -> Settings:
    kept = kept_pixels(configuration, choice["kept"])
    return Settings(estimator="smoothed", smoothing_px=choice["smoothing_px"], keep_brightest=kept)


def _denoised(configuration: LoopConfiguration, choice: Choice) -> Settings:
    strength = choice["strength"] * mean_pixel_noise_e(configuration)
    return denoised_settings(strength, kept_pixels(configuration, choice["kept"]))


def _weighted(configuration: LoopConfiguration, choice: Choice) -> Settings:
    return Settings(estimator="weighted", weight_fwhm_px=choice["weight"] * configuration.spot_width_px)


def _likelihood(configuration: LoopConfiguration, choice: Choice) -> Settings:
    return Settings(estimator="ml", model_error=choice["model_error"])


def _posterior(configuration: LoopConfiguration, choice: Choice) -> Settings:
    return Settings(estimator="map", model_error=choice["model_error"], prior_std_px=choice["prior_px"])


def _trained(configuration: LoopConfiguration, choice: Choice) -> Settings:
    return Settings(estimator="trained")


_WEIGHTED = ("weighted_reconstructor", True)
_UNCORRECTED = ("correct_gain", False)
# What starts from the loop's own prediction and stays near it has no gain of its own to correct: the gain
# is measured without a prediction.
_PREDICTED = (("predict_prior", True), _UNCORRECTED)

_ML = ("gain", "blur_px", "model_error")
_MAP = ("gain", "blur_px", "model_error", "prior_px")
_RECIPES: dict[str, _Recipe] = {
    "cog": _Recipe("centre of gravity", ("gain",), _plain),
    "thresholded": _Recipe("thresholded", ("gain", "threshold"), _thresholded),
    "brightest": _Recipe("brightest pixels", ("gain", "kept"), _brightest),
    "brightest_uncorrected": _Recipe(
        "brightest pixels, gain not corrected", ("gain", "kept"), _brightest, (_UNCORRECTED,)
    ),
    "smoothed": _Recipe("Gaussian smoothing", ("gain", "kept", "smoothing_px"), _smoothed),
    "tv": _Recipe("TV denoising", ("gain", "kept", "strength"), _denoised),
    "tv_uncorrected": _Recipe(
        "TV denoising, gain not corrected", ("gain", "kept", "strength"), _denoised, (_UNCORRECTED,)
    ),
    "weighted": _Recipe("weighted", ("gain", "weight"), _weighted),
    "ml": _Recipe("maximum likelihood", _ML, _likelihood),
    "ml_weighted": _Recipe("maximum likelihood, weighted reconstructor", _ML, _likelihood, (_WEIGHTED,)),
    "map": _Recipe("maximum a posteriori", _MAP, _posterior, _PREDICTED),
    "map_weighted": _Recipe(
        "maximum a posteriori, weighted reconstructor", _MAP, _posterior, (*_PREDICTED, _WEIGHTED)
    ),
    "trained": _Recipe("trained score", ("gain",), _trained),
    "trained_predicted": _Recipe("trained score, from the prediction", ("gain",), _trained, _PREDICTED),
}

ARM_NAMES = tuple(_RECIPES)


def default_arms(configuration: LoopConfiguration) -> tuple[str, ...]:
    """Return the names of the arms that are compared where none are asked for.

    The score is trained for spots that turbulence speckles: not where the source is elongated. In open loop,
    where an error of the centroid gain is not fed back, some do without its correction.
    """
    names = list(ARM_NAMES)
    if configuration.sensor.spot_elongation > 1:
        names = [name for name in names if not name.startswith("trained")]
    if configuration.control.mode == CLOSED:
        names = [name for name in names if not name.endswith("_uncorrected")]
    return tuple(names)


def arm_label(name: str) -> str:
    """Return an arm's name as reports write it.

    Raises
    ------
    InputError
        For an unknown arm.
    """
    return _recipe(name).label


def tuned_parameters(name: str) -> dict[str, Parameter]:
    """Return what is tuned of an arm, by name.

    Raises
    ------
    InputError
        For an unknown arm.
    """
    return {parameter: PARAMETERS[parameter] for parameter in _recipe(name).parameters}


def arm_named(name: str, configuration: LoopConfiguration, choice: Choice) -> Arm:
    """Return an arm with tuned values, for the configuration's own light.

    The PSF of those that need one is that of a flat wavefront, blurred as is tuned; the score is trained on
    simulated spots of the same strength of turbulence, light and camera.

    Parameters
    ----------
    name : str
        One of `ARM_NAMES`.
    configuration : LoopConfiguration
    choice : mapping of str to float
        A value for each of `tuned_parameters`.

    Raises
    ------
    InputError
        For an unknown arm, or a value that is missing.
    """
    recipe = _recipe(name)
    for parameter in recipe.parameters:
        if parameter not in choice:
            raise InputError(f"choice: expected a value for {parameter!r} of the arm {name!r}")
    settings = recipe.settings(configuration, choice)
    psf = _blurred_psf(configuration, choice["blur_px"]) if "blur_px" in recipe.parameters else None
    score = _trained_score(configuration) if settings.estimator == "trained" else None
    return Arm(recipe.label, settings, float(choice["gain"]), psf=psf, score=score, **dict(recipe.options))


def denoised_settings(strength_e: float, kept: int) -> Settings:
    """Return the settings of TV denoising and brightest pixels with a solver that has converged."""
    return Settings(
        noise_std=strength_e, keep_brightest=kept, max_iterations=_MOST_ITERATIONS, tolerance=_TOLERANCE
    )


def kept_pixels(configuration: LoopConfiguration, fraction: float) -> int:
    """Return a number of kept pixels for a fraction of the window's."""
    pixels = configuration.sensor.pixels**2
    return max(4, min(pixels - 1, round(fraction * pixels)))


def read_noise_e(configuration: LoopConfiguration) -> float:
    """Return the read noise in photo-electrons."""
    return configuration.camera.read_noise_e / configuration.camera.em_gain


def mean_pixel_noise_e(configuration: LoopConfiguration) -> float:
    """Return the strength of `faintspot.estimate.noise.suggested_strength` for the configuration's light."""
    camera = configuration.camera
    excess = 2.0 if camera.em_gain > 1 else 1.0
    dark = math.hypot(read_noise_e(configuration), math.sqrt(excess * (camera.background_e + camera.dark_e)))
    return float(suggested_strength(dark, configuration.photons, configuration.sensor.pixels**2))


def _recipe(name: str) -> _Recipe:
    return _RECIPES[one_of("arm", name, ARM_NAMES)]


def _blurred_psf(configuration: LoopConfiguration, blur_px: float) -> PSF:
    sensor = configuration.sensor
    return _psf(configuration.spot_width_px / 2, sensor.spot_elongation, float(sensor.pixels), blur_px)


@functools.lru_cache(maxsize=16)
def _psf(size: float, elongation: float, radius_px: float, blur_px: float) -> PSF:
    psf = PSF.analytic(size=size, elongation=elongation, radius_px=radius_px)
    return psf.blurred(blur_px) if blur_px else psf


@functools.lru_cache(maxsize=4)
def _trained_score(configuration: LoopConfiguration) -> TrainedScore:
    """Train the score on spots of the weakest seeing: when unsure, the larger d / r0 is better."""
    from faintspot.training import train_estimator

    sensor, air = configuration.sensor, configuration.atmosphere
    r0 = min(np.atleast_1d(air.r0_m).tolist())
    r0_sensing = r0 * (sensor.wavelength_m / R0_WAVELENGTH_M) ** (6 / 5)
    return train_estimator(
        flux_e=configuration.photons,
        detector=make_detector(configuration),
        shape=(sensor.pixels, sensor.pixels),
        size=configuration.spot_width_px / 2,
        d_over_r0=configuration.subaperture_m / r0_sensing,
        position_range_px=_TRAINING_RANGE_PX[configuration.control.mode],
        realisations=_TRAINING_SPOTS,
        rng=np.random.default_rng([configuration.run.seed, _TRAINING_SEED]),
    )
