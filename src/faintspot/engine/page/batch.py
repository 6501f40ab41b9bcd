"""Data that arrived since the last read, from a running engine or a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.sensor.layout import Layout

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Picture:
    """A frame and its denoised images, with the record of that frame if still available."""

    frame: int
    raw: NDArray[np.float32]
    """(h, w), ADU."""
    denoised: NDArray[np.float32]
    """(n, ny, nx), electrons."""


@dataclass(frozen=True)
class Batch:
    """Data that arrived since the last read."""

    records: NDArray[np.void]
    """Records, as in `faintspot.engine.telemetry.segment.record_type`."""
    missed: int = 0
    """Number of records for which the page was too slow."""
    picture: Picture | None = None
    """The newest picture."""
    truth: tuple[int, float, float] | None = None
    """Truth of the newest frame that has one: frame, Strehl ratio, rms wavefront error [nm]."""
    commands: Floats | None = None
    """The newest commands, in the engine's unit."""
    changes: list[dict[str, Any]] = field(default_factory=list)
    """Changes of settings."""
    anew: bool = False
    """Whether earlier data belong to another engine or another part of the recording."""


class BatchSource(Protocol):
    """Interface of a source of batches."""

    name: str
    layout: Layout | None
    """Layout of the sensor; None until it is known."""
    methods: list[str]
    """Names of the interleaved configurations."""

    def read(self) -> Batch | None:
        """Return the data since the last call; None if there is no source."""
        ...

    def state(self) -> dict[str, Any]:
        """Return the state of the source as plain values for the page."""
        ...

    def close(self) -> None:
        """Release all resources."""
        ...
