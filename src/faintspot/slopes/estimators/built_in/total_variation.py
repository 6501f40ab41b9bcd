"""Total-variation denoising (the method of the paper), then brightest pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none
from faintspot.base.errors import InputError
from faintspot.base.options import PerSubaperture, Value, is_auto, option
from faintspot.base.tables import FEW_KEPT, PRESETS, of_denoising
from faintspot.slopes.estimators.automatic import automatic_strength
from faintspot.slopes.estimators.base import BACKGROUND, CALIBRATED, RAW, Estimator, Step, Style
from faintspot.slopes.estimators.built_in.gravity import GravityPlan, KeepingBrightest
from faintspot.slopes.estimators.noise import ALGORITHMS, suggested_strength, tv_denoise
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene, Sensor
from faintspot.slopes.kernels.positions import gravity
from faintspot.slopes.kernels.total_variation.flat_start import flat_start_table

_STRENGTHS = (1.0, 0.4, 0.6, 0.8, 1.25)  # multiples of the automatic strength
_LEAST_STRENGTH_E = 1e-3
_SPREAD = 1.5  # pixels with the same noise after denoising, in simulations
_LIMITS = "tolerance", "max_iterations"


class _TotalVariationPlan(GravityPlan):
    """Strengths, and the starting point of the denoising."""

    estimator: TotalVariation

    def __init__(self, estimator: TotalVariation, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        limits = {"tolerance": gravity.TOLERANCE, "max_iterations": gravity.LIMIT}
        self.rows_of_options = {**self.rows_of_options, "noise_std": gravity.STRENGTH, **limits}

    @cached_property
    def tables(self) -> gravity.GravityTables:
        """See `GravityPlan`."""
        return gravity.GravityTables(
            flat_start_table(*self.sensor.window), ALGORITHMS[self.estimator.algorithm]
        )

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        super().fill(table)
        table[gravity.TOLERANCE], table[gravity.LIMIT] = self.each("tolerance"), self.each("max_iterations")

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        super().fill_flux(table, flux_e)
        automatic = is_auto(self.estimator.noise_std)
        strength = automatic_strength(**self.rule_arguments(flux_e)) if automatic else self.each("noise_std")
        table[gravity.STRENGTH], table[gravity.SPREAD] = strength, np.where(strength > 0, _SPREAD, 1.0)


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class TotalVariation(KeepingBrightest):
    """Centre of gravity of the brightest pixels of the denoised image (Basden et al. 2015, MNRAS)."""

    noise_std: Any = option(
        None,
        'Denoising strength: standard deviation of the noise to remove from a pixel. "auto": chosen from '
        "read noise, flux and spot by `estimators.automatic.automatic_strength`. 0: no "
        "denoising. A strength above 0.9 of an image's own rms is lowered to 0.6 of it.",
        unit="e-",
        low=0.0,
        automatic=True,
    )
    tolerance: Value = option(
        None,
        "Relative change in 24 iterations at which the denoising of a sub-aperture stops; see "
        "`faintspot.tv_denoise`. Default: 0.0025 where more than 32 pixels are kept; else, and with the "
        'preset "fast", 0 (only the iteration limit applies).',
        low=0.0,
        high=1.0,
    )
    max_iterations: Value = option(
        None,
        "Iteration limit. Default: 24, or 480 where more than 32 pixels are kept or a tolerance is set; with "
        'the preset "fast" 8.',
        low=1,
        high=2**24,
        whole=True,
    )
    algorithm: str = option(
        "fgp", "Algorithm of the denoising.", choices=tuple(ALGORITHMS), per_subaperture=False
    )
    preset: str = option(
        "accurate",
        '"fast": 8 denoising iterations for every image, so that the run time is constant. Its accuracy is '
        "given in docs/results/tv_settings.md.",
        choices=PRESETS,
        per_subaperture=False,
    )

    name = "tv"
    label = "TV denoising"
    method = "total-variation denoising, brightest pixels, centre of gravity"
    cost = 0.71
    style = Style("#D55E00", "-", "s")
    plan = _TotalVariationPlan
    steps_shown = (RAW, CALIBRATED, Step("denoised", "denoised"), BACKGROUND)
    automatic_method = "tv"
    strength_option = "noise_std"

    def __post_init__(self) -> None:
        super().__post_init__()
        strength = self.noise_std
        if strength is None or (isinstance(strength, PerSubaperture) and strength.default is None):
            raise InputError(
                'expected a number (electrons) or "auto", got none; '
                'or set estimator = "brightest", which does not denoise',
                name="noise_std",
            )

    @property
    def is_automatic(self) -> bool:
        """See `KeepingBrightest`."""
        return is_auto(self.noise_std) or is_auto(self.keep_brightest)

    def for_bright_flux(self) -> Estimator:
        """Do not denoise: a noise-free image has nothing to remove."""
        return not_none(self.without_denoising()).for_bright_flux()

    def values(self, name: str, n_subapertures: int, pixels: int) -> NDArray[Any]:
        """See `Options`; tolerance and iteration limit depend on the number of pixels kept."""
        values = super().values(name, n_subapertures, pixels)
        if name not in _LIMITS:
            return values
        kept = self.values("keep_brightest", n_subapertures, pixels)
        keeps_few = np.full(n_subapertures, True) if is_auto(self.keep_brightest) else kept <= FEW_KEPT
        if name == "max_iterations":
            keeps_few &= np.isnan(super().values("tolerance", n_subapertures, pixels))
        usual = [of_denoising(self.preset, keeps_few=few)[name] for few in (False, True)]
        filled = np.where(np.isnan(values), np.where(keeps_few, usual[1], usual[0]), values)
        return filled.astype(np.asarray(usual).dtype)

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        where, unit, strength = "", "", self._span("noise_std", n_subapertures, pixels)
        if not is_auto(self.noise_std):
            unit = " e-"
            denoised = int(np.count_nonzero(self.values("noise_std", n_subapertures, pixels)))
            if denoised < n_subapertures:
                where = f" in {denoised} of {n_subapertures} sub-apertures"
        tolerance, limit = (self._span(name, n_subapertures, pixels) for name in _LIMITS)
        return (
            f"total-variation denoising{where} of strength {strength}{unit} ({self.algorithm}, tolerance "
            f"{tolerance}, at most {limit} iterations); {self.kept_in_words(n_subapertures, pixels)}"
        )

    def for_scene(self, scene: Scene) -> Self:
        """Use the preset "fast"."""
        return self.replaced({"preset": "fast"})

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[Any]]:
        """Return numbers of kept pixels and strengths around the automatic ones."""
        ordinary = float(
            suggested_strength(scene.dark_noise_e, scene.excess_noise * scene.flux_e, scene.pixels)
        )
        strength = max(float(automatic_strength(**scene.rule_arguments)) or ordinary, _LEAST_STRENGTH_E)
        return {**super().tuned(scene), "noise_std": [strength * factor for factor in _STRENGTHS]}

    def denoised(self, images: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """See `KeepingBrightest`."""
        if is_auto(self.noise_std):
            return None  # the strength depends on the flux
        limits = {name: getattr(self, name) for name in _LIMITS}
        result: NDArray[np.float32] = tv_denoise(
            images,
            self.noise_std,
            algorithm=self.algorithm,
            preset=self.preset,
            lower_strength=True,
            **limits,
        )
        return result
