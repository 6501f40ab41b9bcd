"""Pixels and wavefront of every frame in SPECULA."""

from typing import Any

import numpy as np
from specula import cpuArray
from specula.base_processing_obj import BaseProcessingObj, InputDesc
from specula.connections import InputValue
from specula.data_objects.electric_field import ElectricField
from specula.data_objects.pixels import Pixels

from benchmarks.loops.foreign.base import Floats


class NotedFrames(BaseProcessingObj):
    """Keeps what the detector sees."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.frames: list[Floats] = []
        self.paths_m: list[Floats] = []
        self.amplitude: Floats | None = None
        self.inputs["in_pixels"] = InputValue(type=Pixels)
        self.inputs["in_ef"] = InputValue(type=ElectricField)

    @classmethod
    def input_names(cls) -> dict[str, Any]:
        """Return the inputs."""
        return {"in_pixels": InputDesc(Pixels, "Frame"), "in_ef": InputDesc(ElectricField, "Wavefront")}

    @classmethod
    def output_names(cls) -> dict[str, Any]:
        """Return no outputs."""
        return {}

    def trigger_code(self) -> None:
        """Keep a frame."""
        self.frames.append(np.array(cpuArray(self.local_inputs["in_pixels"].pixels)))
        field = self.local_inputs["in_ef"]
        self.paths_m.append(1e-9 * np.array(cpuArray(field.phaseInNm)))
        self.amplitude = np.array(cpuArray(field.A))
