"""Options of an engine, and the interface of a source in its own thread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


class FrameInput(Protocol):
    """Source that brings frames into the ring in the engine's own thread."""

    def step(self) -> bool:
        """Wait a moment for a frame; return whether one has come."""
        ...

    def close(self) -> None:
        """Release all resources."""
        ...


@dataclass(frozen=True)
class EngineOptions:
    """Options of an engine.

    Parameters
    ----------
    threads : int
        Number of threads that measure.
    cpus : sequence of int, optional
        Processors to pin threads to; the first one is for the thread that calls `Engine.run`.
    deadline_s : float
        Latency from a frame's last row beyond which slopes count as late.
    images_every : int
        Interval, in frames of one configuration, at which telemetry keeps images; 0: no images.
    mean_flux : float, optional
        Number of frames over which the flux of each sub-aperture is averaged, for estimators that use it.
        Default: they keep `flux_e`.
    polls : bool
        Whether threads poll for rows all the time. Default: they sleep until shortly before rows are due.
    """

    threads: int = 1
    cpus: Sequence[int] | None = None
    deadline_s: float = 1e-3
    images_every: int = 100
    mean_flux: float | None = None
    polls: bool = False
