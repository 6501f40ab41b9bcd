"""Pipelines of an engine, made from settings; what is known of the spots may change while it runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from faintspot.base.errors import InputError
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.fixed_weights import FixedWeights
from faintspot.slopes.spots.psf import PSF


@dataclass(frozen=True, eq=False)
class PipelineMaker:
    """Parts of a pipeline but its settings; other processes can be given it."""

    layout: Layout
    calibration: Calibration
    psf: PSF | None = None
    score: FixedWeights | None = None
    reference: NDArray[Any] | None = None
    """Reference slopes, as for `SlopePipeline`."""

    def __post_init__(self) -> None:
        if self.layout.bin > 1:
            raise InputError(
                f"layout.bin = {self.layout.bin}: expected 1, the engine measures rows as they arrive; "
                "bin in the camera, or measure recorded frames with `faintspot slopes`"
            )

    def __call__(self, settings: Settings) -> SlopePipeline:
        """Return the pipeline with settings."""
        parts = self.layout, settings, self.calibration, self.reference
        return SlopePipeline(*parts, psf=self.psf, score=self.score)
