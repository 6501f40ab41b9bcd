"""Methods that experiments compare: an estimator with settings, knowledge and control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.config.options import REQUIRED, TEXT, Options, number, setting
from faintspot.base.errors import InputError
from faintspot.loop.control.base import CONTROLS, INTEGRATOR
from faintspot.slopes.estimators.base import Estimator
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF

PRIOR = "prior_std_px"
"""Option of estimators whose prior the loop sets: standard deviation from the predicted position."""


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
    window_pixels : int, optional
        Side of the middle part of each sub-aperture's window that is used. Default: all.
    weighted_reconstructor : bool
        Whether slopes count by their standard errors.
    predict_prior : bool
        Whether estimators that take a prior are given the slopes that the loop predicts.
    correct_gain : bool
        Whether slopes are divided by their centroid gain: for the integrator that measured at the run's
        flux, for control that learns the one learnt from telemetry.
    true_slopes : bool
        Whether slopes are the wavefront's true mean gradients instead of measured ones.
    control : str
        What makes commands of the slopes, see `control.base.CONTROLS`. All but the integrator
        learn from telemetry of a loop with the integrator, in other turbulence.
    noise_scale : float
        What control multiplies the variance of the slopes' noise by that telemetry shows.
    matched_weights : bool
        Whether the fixed weights of `window` are the linear matched filter of a laser guide star's spots.
    follows_profile : bool
        Whether spots of a laser guide star are those of a sodium profile that is followed, not of the one
        learnt before the run.
    psf, score : PSF, FixedWeights, optional
        For the estimators that need them. Default PSF: that of a flat wavefront, or with a laser that of the
        profile learnt.

    Raises
    ------
    InputError
        For an empty label, an unknown control, a gain, window or scale out of range.

    Examples
    --------
    >>> import faintspot as fs
    >>> from faintspot.loop.simulation import Method
    >>> method = Method("a window, less gain", fs.Settings("window"), gain=0.4)
    >>> method.control, method.gain
    ('integrator', 0.4)
    """

    label: str = setting(REQUIRED, kind=TEXT)
    settings: Settings = setting(REQUIRED, check=_checked_settings)
    gain: float | None = number(None, 0, 2)
    window_pixels: int | None = number(None, 2, 64, whole=True)
    weighted_reconstructor: bool = False
    predict_prior: bool = False
    correct_gain: bool = True
    true_slopes: bool = False
    control: str = setting(INTEGRATOR, choices=tuple(CONTROLS))
    noise_scale: float = number(1.0, 0, 100, low_open=True)
    matched_weights: bool = False
    follows_profile: bool = False
    psf: PSF | None = None
    score: FixedWeights | None = None

    @property
    def estimator(self) -> Estimator:
        """The estimator with its options."""
        return self.settings.estimator

    @property
    def name(self) -> str:
        """Name of the estimator."""
        return self.estimator.name

    @property
    def parts(self) -> dict[str, Any]:
        """Arguments of a pipeline beside settings and calibration."""
        return {"psf": self.psf, "score": self.score}

    @property
    def has_prior(self) -> bool:
        """Whether the estimator uses the controller's prediction as its prior."""
        has = self.predict_prior and PRIOR in self.settings.declared() and not self.true_slopes
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
