"""Methods that experiments compare: an estimator with settings, its use in a loop, and control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import one_of
from faintspot.base.errors import InputError
from faintspot.base.options import AUTO, REQUIRED, TEXT, TEXTS, Options, number, setting
from faintspot.loop.control.base import CONTROLS, INTEGRATOR, KALMAN
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.estimators.registry import estimator_named
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

PRIOR = "prior_std_px"
"""Option of estimators whose prior the loop sets: standard deviation from the predicted position."""
PREDICTED, WEIGHTED, UNCORRECTED, TRUE = "predicted", "weighted", "uncorrected", "true"
VARIANTS = {
    PREDICTED: "predicted",
    WEIGHTED: "weighted reconstructor",
    UNCORRECTED: "gain not corrected",
    TRUE: "true slopes",
}
"""Uses of an estimator in a loop that differ from the usual one: name and label."""


def _checked_settings(name: str, value: object) -> Settings:
    if not isinstance(value, Settings):
        raise InputError(f"expected Settings, got {type(value).__name__}", name=name)
    return value


@dataclass(frozen=True, eq=False)
class Method(Options, table="method"):
    """Method that experiments compare: estimator, settings, prior knowledge and control.

    Parameters
    ----------
    label : str
    settings : Settings
    gain : float, optional
        Loop gain, 0 to 2. Default: the configuration's.
    variants : sequence of str
        "predicted": estimators that take a prior are given the slopes that the loop predicts. "weighted":
        slopes count by their standard errors. "uncorrected": slopes are not divided by their centroid gain,
        as those with a prediction; else it is that measured at the run's flux, for control that learns the
        one learnt from telemetry. "true": slopes are the wavefront's true mean gradients instead of measured
        ones.
    control : str
        What makes commands of the slopes, see `control.base.CONTROLS`. All but the integrator
        learn from telemetry of a loop with the integrator, in other turbulence.
    noise_scale : float
        What control multiplies the variance of the slopes' noise by that telemetry shows.
    psf, weights : PSF, FixedWeights, optional
        For the estimators that need them. Default PSF: that of a flat wavefront.

    Raises
    ------
    InputError
        For an empty label, an unknown variant or control, a gain or scale out of range.

    Examples
    --------
    >>> import faintspot as fs
    >>> from faintspot.loop.simulation import Method
    >>> method = Method("a window, less gain", fs.Settings("window"), gain=0.4)
    >>> method.name, method.control, method.gain
    ('window', 'integrator', 0.4)
    >>> Method.named("ml+weighted+kalman").label
    'maximum likelihood, weighted reconstructor, predictive Kalman filter'
    """

    label: str = setting(REQUIRED, kind=TEXT)
    settings: Settings = setting(REQUIRED, check=_checked_settings)
    gain: float | None = number(None, 0, 2)
    variants: tuple[str, ...] = setting((), kind=TEXTS, choices=tuple(VARIANTS))
    control: str = setting(INTEGRATOR, choices=tuple(CONTROLS))
    noise_scale: float = number(1.0, 0, 100, low_open=True)
    psf: PSF | None = None
    weights: FixedWeights | None = None

    @classmethod
    def named(cls, name: str) -> Method:
        """Return a method by its name, with automatic options of its estimator.

        The name is that of an estimator, of variants and of control, joined by "+": "ml+weighted+kalman".
        With the Kalman filter, estimators that take a prior are given its prediction.

        Raises
        ------
        InputError
            For an unknown estimator, variant or control, or one that does not suit the estimator.
        """
        first, *parts = name.split("+")
        kind = estimator_named(first)
        parts = [one_of(f"method {name!r}", part, [*VARIANTS, *CONTROLS]) for part in parts]
        variants, control = {part for part in parts if part in VARIANTS}, INTEGRATOR
        if parts and parts[-1] in CONTROLS:
            control = parts.pop()
        if len(variants) != len(parts):
            raise InputError(f"method = {name!r}: expected the control once, at the end")
        if PREDICTED in variants and not kind.takes_prior:
            raise InputError(f"method = {name!r}: expected an estimator that takes a prior, got {first!r}")
        if control == KALMAN and kind.takes_prior:
            variants.add(PREDICTED)
        ordered = tuple(variant for variant in VARIANTS if variant in variants)
        words = [kind.label, *(VARIANTS[variant] for variant in ordered)]
        words += [] if control == INTEGRATOR else [CONTROLS[control]]
        automatic = {option: AUTO for option, declared in kind.declared().items() if declared.automatic}
        return cls(", ".join(words), Settings(kind(**automatic)), variants=ordered, control=control)

    @property
    def name(self) -> str:
        """Name in commands and results, of which `named` makes the method."""
        implied = PREDICTED if self.control == KALMAN else ""
        variants = [variant for variant in self.variants if variant != implied]
        return "+".join([self.estimator.name, *variants, *([self.control] * (self.control != INTEGRATOR))])

    @property
    def is_predicted(self) -> bool:
        """Whether the loop's prediction is given to estimators that take a prior."""
        return PREDICTED in self.variants

    @property
    def corrects_gain(self) -> bool:
        """Whether slopes are divided by their centroid gain, which those near a prediction do not have."""
        return not {PREDICTED, UNCORRECTED} & set(self.variants)

    @property
    def estimator(self) -> Estimator:
        """The estimator with its options."""
        return self.settings.estimator

    @property
    def parts(self) -> dict[str, Any]:
        """Arguments of a pipeline beside settings and calibration."""
        return {"psf": self.psf, "weights": self.weights}

    @property
    def has_prior(self) -> bool:
        """Whether the estimator uses the controller's prediction as its prior."""
        has = self.is_predicted and PRIOR in self.settings.declared() and TRUE not in self.variants
        return has and getattr(self.settings, PRIOR) is not None

    def prior_std_px(self, slopes: int) -> NDArray[np.float64] | None:
        """Return the standard deviations of the estimator's prior around the prediction, (2 n,), or None."""
        if not self.has_prior:
            return None
        std_px = np.broadcast_to(getattr(self.settings, PRIOR), (slopes // 2,))
        return np.tile(std_px, 2).astype(np.float64)

    def with_options(self, changes: Mapping[str, Any]) -> Method:
        """Return the same with some settings changed."""
        return replace(self, settings=self.settings.replace(**changes)) if changes else self
