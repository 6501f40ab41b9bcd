"""Trained linear score, applied in a few passes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.estimators import spot_tables
from faintspot.slopes.estimators.base import Estimator, EstimatorPlan, Need, Style
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Sensor
from faintspot.slopes.kernels.spot_fits import fits as spot_fits
from faintspot.slopes.spots.score import TrainedScore

Floats = NDArray[np.float64]
_LEAST_SMOOTHING_PX = 0.1


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Trained(Estimator):
    """Trained linear score, made by `faintspot.train_estimator` or `train_from_frames`."""

    name = "trained"
    label = "trained score"
    method = "trained linear score of the sensor, applied in a few passes"
    needs = frozenset({Need.SCORE})
    cost = 0.15
    style = Style("#6b3fa0", "-", "h")
    takes_prior = True

    @property
    def uses_flux(self) -> bool:
        """See `Estimator`."""
        return True

    def check(self, sensor: Sensor) -> None:
        """See `Estimator`."""
        super().check(sensor)
        assert isinstance(sensor.score, TrainedScore)
        kinds = sensor.score.index
        if kinds is not None and len(kinds) != sensor.n:
            raise InputError(
                f"score.index: expected {sensor.n} numbers, one per sub-aperture, got {len(kinds)}"
            )

    def prepared(self, sensor: Sensor) -> EstimatorPlan:
        """See `Estimator`."""
        return _Plan(self, sensor)


class _Plan(EstimatorPlan):
    """Tables of the score."""

    kernel = staticmethod(spot_fits.scored_of_groups)
    setting_rows = spot_fits.SETTING_ROWS

    def __init__(self, estimator: Trained, sensor: Sensor) -> None:
        super().__init__(estimator, sensor)
        assert isinstance(sensor.score, TrainedScore)
        self._score = sensor.score
        self.needs_flux = bool(np.isnan(sensor.flux_e).all())

    @cached_property
    def tables(self) -> spot_fits.ScoreTables:
        """See `EstimatorPlan`."""
        score, sensor = self._score, self.sensor
        std = np.full((sensor.n, 2), max(score.smoothing_px, _LEAST_SMOOTHING_PX))
        return spot_fits.ScoreTables(
            score.passes,
            score.start == "peak",
            spot_tables.gaussian_taps(std, sensor.window),
            *spot_tables.score_tables(score, sensor.window, sensor.width),
        )

    @cached_property
    def own_scratch(self) -> partial[spot_fits.SpotScratch]:
        """See `EstimatorPlan`."""
        return partial(spot_fits.spot_scratch, taps=self.tables.taps.shape[2])

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        table[spot_fits.START_FLUX] = 1.0  # the flux is expected, not measured at the start

    def fill_flux(self, table: NDArray[np.float32], flux_e: Floats) -> None:
        """See `EstimatorPlan`."""
        score = self._score
        table[spot_fits.FLUX] = np.nan_to_num(flux_e)
        classes = score.flux_class(flux_e)
        kinds = 0 if score.index is None else score.index
        table[spot_fits.KIND] = kinds * len(score.flux_e) + classes
        levels = [score.standard_error(float(flux)) for flux in np.unique(flux_e)]
        errors = np.stack(levels)[np.unique(flux_e, return_inverse=True)[1]]
        own = np.arange(self.sensor.n) if score.index is not None else 0
        errors = errors[np.arange(self.sensor.n), own]
        table[spot_fits.TRAINED_ERROR_X], table[spot_fits.TRAINED_ERROR_Y] = errors.T
