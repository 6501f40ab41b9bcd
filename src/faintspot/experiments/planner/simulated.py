"""Simulated spots with known positions, to choose settings on and to score them on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import spawn
from faintspot.experiments.planner.question import Question
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.sensor.layout import Layout

Floats = NDArray[np.float64]

SPOTS_PER_FRAME = 64


@dataclass(frozen=True, eq=False)
class SpotFrames:
    """Frames of one flux, and the truth."""

    frames: NDArray[Any]
    """(n_frames, rows, columns): windows on top of each other, electrons at the camera's output."""
    truth: Floats
    """(n_frames, SPOTS_PER_FRAME, 2), px."""


@dataclass(frozen=True, eq=False)
class SimulatedSpots:
    """Noiseless spots, to be exposed at any flux: the same positions and speckles at every one."""

    detector: Detector
    layout: Layout
    calibration: Calibration
    choosing: tuple[Floats, Floats]
    scoring: tuple[Floats, Floats]

    @classmethod
    def of(cls, question: Question, realisations: int, rng: np.random.Generator) -> SimulatedSpots:
        """Simulate `realisations` spots to score on, and half as many to choose on (whole frames)."""
        first, second = spawn(rng, 2)
        n_frames = max(2, -(-realisations // SPOTS_PER_FRAME))
        background = question.background_e * question.em_gain
        spots = question.spots
        return cls(
            question.detector,
            Layout.grid((SPOTS_PER_FRAME, 1), pixels=spots.shape),
            replace(question.camera, dark=background, gain_e_per_adu=1.0),
            spots.simulated(-(-n_frames // 2) * SPOTS_PER_FRAME, first),
            spots.simulated(n_frames * SPOTS_PER_FRAME, second),
        )

    def exposed(self, flux_e: float, rng: np.random.Generator) -> tuple[SpotFrames, SpotFrames]:
        """Return frames to choose on and frames to score on at a flux."""
        ny, nx = self.layout.window
        samples = []
        for (images, truth), noise in zip((self.choosing, self.scoring), spawn(rng, 2), strict=True):
            frames = self.detector.expose(flux_e * images, noise).reshape(-1, SPOTS_PER_FRAME * ny, nx)
            samples.append(SpotFrames(frames, truth.reshape(-1, SPOTS_PER_FRAME, 2)))
        return samples[0], samples[1]

    @cached_property
    def _pipelines(self) -> dict[str, SlopePipeline]:
        return {}

    def measure(self, sample: SpotFrames, method: Method) -> Slopes:
        """Measure the spots of a sample as the user's own frames would be."""
        # What knows the spot takes time to prepare, and often has the same settings at every flux.
        key = f"{method.settings} {id(method.psf)} {id(method.score)}"
        if key not in self._pipelines:
            self._pipelines[key] = SlopePipeline(
                self.layout, method.settings, self.calibration, **method.parts
            )
        return self._pipelines[key](sample.frames)

    def measure_each(
        self, sample: SpotFrames, method: Method, name: str, values: Sequence[Any]
    ) -> list[tuple[NDArray[np.generic], NDArray[np.generic]]]:
        """Return x and y, (n_frames, SPOTS_PER_FRAME), for each value of one of a method's options.

        Where sub-apertures may have values of their own, the values share one pipeline.
        """
        if not method.estimator.declared()[name].per_subaperture:
            results = [self.measure(sample, method.with_options({name: value})) for value in values]
            return [(slopes.x, slopes.y) for slopes in results]
        count = len(values)
        layout = Layout.grid((count * SPOTS_PER_FRAME, 1), pixels=self.layout.window)
        settings = method.settings.replace(**{name: np.repeat(values, SPOTS_PER_FRAME)})
        pipeline = SlopePipeline(layout, settings, self.calibration, **method.parts)
        slopes = pipeline(np.tile(sample.frames, (1, count, 1)))
        x, y = (part.reshape(-1, count, SPOTS_PER_FRAME).swapaxes(0, 1) for part in (slopes.x, slopes.y))
        return list(zip(x, y, strict=True))
