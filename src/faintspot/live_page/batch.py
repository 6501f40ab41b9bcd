"""What came since the last look, from a running engine or a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from faintspot.sensor.layout import Layout

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Picture:
    """A frame and its denoised images, with the record of that frame where it is still known."""

    frame: int
    raw: NDArray[np.float32]
    """(h, w), ADU."""
    denoised: NDArray[np.float32]
    """(n, ny, nx), electrons."""


@dataclass(frozen=True)
class Batch:
    """What came since the last look."""

    records: NDArray[Any]
    """As `faintspot.realtime.telemetry_segment.record_type`."""
    missed: int = 0
    """Records that the page was too slow for."""
    picture: Picture | None = None
    """The newest."""
    truth: tuple[int, float, float] | None = None
    """Of the newest frame whose truth is known: frame, Strehl ratio, rms wavefront in nm."""
    commands: Floats | None = None
    """The newest, as they came."""
    changes: list[dict[str, Any]] = field(default_factory=list)
    """Changes of settings."""
    anew: bool = False
    """Whether what was gathered before has nothing to do with it."""


class Source(Protocol):
    """Where batches come from."""

    name: str
    layout: Layout | None
    """None before there is any."""
    arms: list[str]
    """Names of the arms of settings in turn."""

    def read(self) -> Batch | None:
        """Return what came since the last call; None where there is no source."""
        ...

    def place(self) -> dict[str, Any]:
        """Say where it comes from, as plain values for the page."""
        ...

    def close(self) -> None:
        """Let go of everything."""
        ...
