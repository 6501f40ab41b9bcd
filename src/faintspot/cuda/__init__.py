"""Slopes on an NVIDIA GPU: the work of `faintspot.kernels.gravity`, a warp of 32 threads per sub-aperture.

`SlopePipeline(..., device="cuda")` measures frames that lie in the host's memory. For more than that:

- `FrameStream` is the steady state of a real-time computer: one stream per sensor, memory that the GPU reads
  directly, and the sequence transfer, kernel, transfer recorded once as a graph;
- `DevicePipeline.measure` takes frames that are on the GPU already and leaves the slopes there.

Needs the extra `gpu` and a GPU, or NUMBA_ENABLE_CUDASIM=1 in the environment before Numba is imported:
Numba's CUDA simulator then runs the same code, slowly, on the CPU.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from faintspot.base.lazy import lazy_attributes

if TYPE_CHECKING:
    from faintspot.pipeline.device import DevicePipeline as DevicePipeline
    from faintspot.pipeline.device import DeviceSlopes as DeviceSlopes
    from faintspot.pipeline.device_stream import FrameStream as FrameStream

_HOMES = {
    "DevicePipeline": "faintspot.pipeline.device",
    "DeviceSlopes": "faintspot.pipeline.device",
    "FrameStream": "faintspot.pipeline.device_stream",
}

__all__ = ["DevicePipeline", "DeviceSlopes", "FrameStream"]

__getattr__ = lazy_attributes(__name__, _HOMES)
