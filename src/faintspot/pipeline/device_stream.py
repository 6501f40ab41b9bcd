"""The steady state: frame after frame of one sensor through one CUDA stream."""

from __future__ import annotations

import importlib
from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import DTypeLike

from faintspot.base.errors import InputError
from faintspot.cuda.availability import simulated
from faintspot.kernels.groups import SlopeArrays
from faintspot.pipeline.device import DevicePipeline, Results
from faintspot.pipeline.slope_pipeline import SlopePipeline
from faintspot.pipeline.slopes import Slopes


class FrameStream:
    """Measures the frames of one sensor, one after the other, without waiting for other sensors.

    Frames and slopes lie in pinned host memory, which the GPU reads and writes by itself. Transfer, kernel
    and transfer are recorded once as a CUDA graph, so that a frame costs one call of the driver; where that
    is not possible (`captured` says so), they are started one by one. Several sensors have a `FrameStream`
    each, and may have a thread each.

    Parameters
    ----------
    pipeline : SlopePipeline
        Made with device="cuda". Settings that follow the flux of each frame need `flux_e`.
    dtype : dtype
        Of the camera's pixels: uint16 or float32.
    capture : bool
        False starts the three steps one by one in any case.

    Raises
    ------
    InputError
        When the pipeline is not of this kind, or for another dtype.

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
        """The next frame, (h, w): to be filled before `submit`, left alone until `wait` has returned."""
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
        self._start_steps()  # compiles, loads and brings the tables over
        self.stream.synchronize()
        self._graph = _captured(self.stream, self._start_steps) if capture and not simulated() else None

    @property
    def captured(self) -> bool:
        """Whether a frame is one launch of a CUDA graph."""
        return self._graph is not None

    def submit(self) -> None:
        """Start to measure `frame`; returns at once."""
        if self._graph is None:
            self._start_steps()
        else:
            _launch(self._graph, self.stream)

    def wait(self) -> Slopes:
        """Wait for the frame that was submitted last, and return its slopes.

        They are views of memory that the next `submit` overwrites.
        """
        self.stream.synchronize()
        self._flag_doubtful(self._arrays)
        return self._slopes

    def _start_steps(self) -> None:
        frame = self.frame.reshape(1, *self.frame.shape)
        self._frames.copy_to_device(frame, stream=self.stream)
        self._work.launch(self._frames, self.frame.dtype, self._variants, self._results, self.stream)
        self._results.memory.copy_to_host(self._memory, stream=self.stream)


@cache
def _driver() -> Any:
    """CUDA's driver, which numba-cuda brings along."""
    return importlib.import_module("cuda.bindings.driver")


def _captured(stream: Any, start: Any) -> Any:
    """Record as a graph what `start` puts into a stream; None where the driver cannot."""
    driver = _driver()
    handle = driver.CUstream(int(stream))
    mode = driver.CUstreamCaptureMode.CU_STREAM_CAPTURE_MODE_THREAD_LOCAL
    (error,) = driver.cuStreamBeginCapture(handle, mode)
    if error:
        return None
    started = True
    try:
        start()
    except Exception:  # whatever the driver does not record; the steps work one by one, as has been seen
        started = False
    error, graph = driver.cuStreamEndCapture(handle)
    if error or not started:
        return None
    error, executable = driver.cuGraphInstantiate(graph, 0)
    return None if error else executable


def _launch(graph: Any, stream: Any) -> None:
    """Start a recorded graph."""
    driver = _driver()
    (error,) = driver.cuGraphLaunch(graph, driver.CUstream(int(stream)))
    if error:
        raise RuntimeError(f"the GPU refused a frame: {error}")
