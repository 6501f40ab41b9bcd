"""Continuous operation: frame after frame of one sensor through one CUDA stream."""

from __future__ import annotations

import importlib
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import DTypeLike

from faintspot.base.errors import InputError
from faintspot.slopes.kernels.cuda.availability import simulated
from faintspot.slopes.kernels.driver.groups import SlopeArrays
from faintspot.slopes.pipeline.device import DevicePipeline, Results
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes


class FrameStream:
    """Measures the frames of one sensor one after the other, independently of other sensors.

    Frames and slopes are in pinned host memory, which the GPU accesses directly. The transfers and the
    kernel are recorded as a CUDA graph, so that a frame needs one driver call. If the driver cannot record
    them (`captured` is False), they are started one by one. For several sensors, use one `FrameStream`
    each, in one thread or in several.

    Parameters
    ----------
    pipeline : SlopePipeline
        Pipeline made with device="cuda". If settings follow the flux of each frame, set `flux_e`.
    dtype : dtype
        Type of the camera's pixels: uint16 or float32.
    capture : bool
        Record the steps as a CUDA graph if possible. False: always start them one by one.

    Raises
    ------
    InputError
        If the pipeline does not use the GPU, or the dtype is another one.

    Examples
    --------
    >>> stream = FrameStream(pipeline)  # doctest: +SKIP
    >>> stream.frame[:] = camera.read()  # doctest: +SKIP
    >>> stream.submit()  # doctest: +SKIP
    >>> slopes = stream.wait()  # doctest: +SKIP
    """

    def __init__(
        self, pipeline: SlopePipeline, dtype: DTypeLike = np.uint16, *, capture: bool = True
    ) -> None:
        if pipeline.on_device is None:
            raise InputError('pipeline: expected one made with device="cuda"')
        pipeline.on_device.check_constant_flux()
        kind = np.dtype(dtype)
        if kind not in (np.uint16, np.float32):
            raise InputError(f"dtype = {kind}: expected uint16 or float32")
        self._work: DevicePipeline = pipeline.on_device
        shape, n = pipeline.layout.frame_shape, len(pipeline.layout)
        self.frame: Any = cuda.pinned_array(shape, kind)
        """Next frame, (h, w): write it before `submit` and do not change it until `wait` has returned."""
        self.frame[:] = 0
        self.stream = cuda.stream()
        """Numba's stream."""
        self._frames = cuda.device_array((1, *shape), kind)
        self._variants = cuda.to_device(np.zeros(1, np.int32))
        self._results = self._work.new_results(1)
        self._memory: Any = cuda.pinned_array(Results.size_of(1, n), np.uint8)
        measured = Results.within(self._memory, 1, n).slopes()
        self._arrays = SlopeArrays(*(getattr(measured, field.name) for field in fields(measured)))
        self._flag_doubtful = pipeline.flag_doubtful
        self._slopes = Slopes(*(getattr(measured, field.name)[0] for field in fields(measured)))
        self._start_steps()  # compiles, loads and transfers the tables
        self.stream.synchronize()
        self._graph = _captured(self.stream, self._start_steps) if capture and not simulated() else None

    @property
    def captured(self) -> bool:
        """Whether a frame is one launch of a CUDA graph."""
        return self._graph is not None

    def submit(self) -> None:
        """Start the measurement of `frame`; return immediately."""
        if self._graph is None:
            self._start_steps()
        else:
            _launch(self._graph, self.stream)

    def wait(self) -> Slopes:
        """Wait for the frame submitted last, and return its slopes.

        The slopes are views of memory that the next `submit` overwrites.
        """
        self.stream.synchronize()
        self._flag_doubtful(self._arrays, self.frame[None])
        return self._slopes

    def _start_steps(self) -> None:
        frame = self.frame.reshape(1, *self.frame.shape)
        self._frames.copy_to_device(frame, stream=self.stream)
        self._work.launch(self._frames, self.frame.dtype, self._variants, self._results, self.stream)
        self._results.memory.copy_to_host(self._memory, stream=self.stream)


@cache
def _driver() -> Any:
    """Return the CUDA driver of numba-cuda."""
    return importlib.import_module("cuda.bindings.driver")


def _captured(stream: Any, start: Any) -> Any:
    """Record the operations of `start` in a stream as a graph; return None if the driver cannot."""
    driver = _driver()
    handle = driver.CUstream(int(stream))
    mode = driver.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_THREAD_LOCAL
    (error,) = driver.cuStreamBeginCapture(handle, mode)
    if error:
        return None
    started = True
    try:
        start()
    except Exception:  # any operation that the driver cannot record; the steps themselves have run before
        started = False
    error, graph = driver.cuStreamEndCapture(handle)
    if error or not started:
        return None
    error, executable = driver.cuGraphInstantiate(graph, 0)
    return None if error else executable


def _launch(graph: Any, stream: Any) -> None:
    """Launch a recorded graph."""
    driver = _driver()
    (error,) = driver.cuGraphLaunch(graph, driver.CUstream(int(stream)))
    if error:
        raise RuntimeError(f"the GPU rejected a frame: {error}")
