"""Gaussian smoothing, then brightest pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintspot.base.options import Value, option
from faintspot.slopes.estimators.automatic import automatic_smoothing
from faintspot.slopes.estimators.base import BACKGROUND, CALIBRATED, RAW, Step, Style
from faintspot.slopes.estimators.built_in.gravity import GravityPlan, KeepingBrightest
from faintspot.slopes.estimators.registry import register
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.kernels.positions import gravity

_USUAL_PX = 0.7
_WIDTHS = (1.0, 0.6, 0.8, 1.3, 1.7)  # multiples of the automatic width


class _SmoothedPlan(GravityPlan):
    """Tables of a smoothing followed by a centre of gravity."""

    @cached_property
    def tables(self) -> gravity.GravityTables:
        """See `GravityPlan`."""
        from faintspot.slopes.estimators.spot_tables import gaussian_taps

        std = np.repeat(self.each("smoothing_px")[:, None], 2, axis=1)
        return gravity.GravityTables(taps=gaussian_taps(std, self.sensor.window))

    def fill(self, table: NDArray[np.float32]) -> None:
        """See `EstimatorPlan`."""
        super().fill(table)
        # Taps are (n, 2, 1 + reach), the central one first.
        squares = self.tables.taps.astype(np.float64) ** 2
        table[gravity.SPREAD] = 1 / np.prod(2 * squares.sum(axis=2) - squares[:, :, 0], axis=1)


@register
@dataclass(frozen=True, eq=False, kw_only=True)
class Smoothed(KeepingBrightest):
    """Centre of gravity of the brightest pixels of the image smoothed by a Gaussian."""

    smoothing_px: Value = option(
        None,
        "Standard deviation of the Gaussian. Default: 0.7.",
        unit="px",
        low=0.0,
        high=16.0,
        low_open=True,
    )

    name = "smoothed"
    label = "Gaussian smoothing"
    method = "linear Gaussian smoothing, brightest pixels, centre of gravity"
    cost = 0.22
    style = Style("#E69F00", "-", "D")
    plan = _SmoothedPlan
    steps_shown = (RAW, CALIBRATED, Step("smoothed", "denoised"), BACKGROUND)
    automatic_method = "smoothed"
    strength_option = "smoothing_px"

    def default_of(self, name: str, pixels: int) -> float:
        """See `Options`."""
        return _USUAL_PX if name == "smoothing_px" else super().default_of(name, pixels)

    def in_words(self, n_subapertures: int, pixels: int) -> str:
        """See `Estimator`."""
        width = self._span("smoothing_px", n_subapertures, pixels)
        return f"Gaussian smoothing of {width} px; {self.kept_in_words(n_subapertures, pixels)}"

    def tuned(self, scene: Scene) -> Mapping[str, Sequence[object]]:
        """Return numbers of kept pixels and widths around the automatic ones."""
        width = float(automatic_smoothing(**scene.rule_arguments)) or _USUAL_PX
        return {**super().tuned(scene), "smoothing_px": [width * factor for factor in _WIDTHS]}

    def denoised(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the smoothed images; they are padded with zeros."""
        from scipy.ndimage import gaussian_filter

        width = float(self.values("smoothing_px", 1, images[0].size)[0])
        smoothed: NDArray[np.float32] = gaussian_filter(images, width, mode="constant", axes=(-2, -1))
        return smoothed
