"""faintspot in pyRTC: `FaintspotSlopes`, a slopes process, `FaintspotCamera`, a sensor, and `FaintspotLoop`.

::

    slopes:
      class_name: faintspot.adapters.pyrtc.FaintspotSlopes
      faintspot: faintspot.toml

The classes are created on first access, which imports pyRTC.
"""

import functools
import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.adapters.base import (
    CALIBRATION_FLUX_E,
    FLUX_FRAMES,
    ToolSlopes,
    check_version,
    layout_around,
    parts_of,
)
from faintspot.base.errors import InputError, MissingExtraError
from faintspot.engine.streams.stream import Follower
from faintspot.loop.control import PredictiveControl

TESTED = "2.1.0"
_MOMENT_S = 0.1
_logger = logging.getLogger(__name__)
PREDICTED = "predicted"
"""Name of the input stream of predicted slopes."""


def __getattr__(name: str) -> type:
    made = {"FaintspotSlopes": slopes_process, "FaintspotCamera": camera, "FaintspotLoop": loop}
    if name in made:
        return made[name]()
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _pyrtc() -> Any:
    """Return the module pyrtc; warn once about an untested version."""
    try:
        import pyrtc
    except ImportError:
        raise MissingExtraError("pyrtc", "pyrtc", "faintspot.adapters.pyrtc") from None
    check_version("pyRTC", "pyrtcao", TESTED)
    return pyrtc


@functools.cache
def slopes_process() -> type:
    """Return the class `FaintspotSlopes`, a `SlopesProcess` of pyRTC.

    Its configuration is that of a `SlopesProcess` of type "SHWFS", and

    faintspot : str or dict
        A faintspot.toml, or its tables: `settings` (and `estimator`), `calibration`, `psf`, `weights`.
    noise_free : bool
        Whether frames are noise-free calibration frames, e.g. of a simulated sensor. Default: false.
    calibration_flux_e, flux_frames : float
        See `faintspot.adapters.base.ToolSlopes`; `flux_frames` 0: no running mean.
    input_streams: predicted : str
        Stream of the predicted slopes, as long as `signal`; optional.

    Raises
    ------
    MissingExtraError
        When pyRTC is not installed.
    """
    tool = _pyrtc()
    process: Any = tool.SlopesProcess

    class FaintspotSlopes(process):  # type: ignore[misc]
        """A pyRTC slopes process that uses faintspot instead of pyRTC's centroiders."""

        def __init__(self, conf: Mapping[str, Any]) -> None:
            self.measuring = _Measuring(conf)
            super().__init__(conf)

        def _compute_slopes_shwfs(self, image: NDArray[np.generic]) -> NDArray[np.float32]:
            """Return slopes as pyRTC's centroiders do: (2 N, N) px, the x map above the y map."""
            return self.measuring.maps(self, image, tool.open_stream)

        def recorded(self) -> NDArray[np.float64]:
            """Return the last signal for a recording: NaN where not measured, which is 0 in the stream."""
            return self.measuring.tool.recorded(self.read(block=False))

        def calibrating(self, flux_e: float | None = None) -> AbstractContextManager[None]:
            """Measure as for calibration in a `with` block; see `ToolSlopes.calibrating`."""
            return self.measuring.tool.calibrating(flux_e)

    FaintspotSlopes.__module__, FaintspotSlopes.__qualname__ = __name__, "FaintspotSlopes"
    return FaintspotSlopes


@functools.cache
def camera() -> type:
    """Return the class `FaintspotCamera`, a pyRTC `WavefrontSensor` that reads frames from a stream.

    Its configuration is that of a `WavefrontSensor`, with the function `expose`, and

    frames : str
        Stream of the frames: NAME (pyshmem), e.g. NAME_frames of `faintspot realtime telescope`, or
        isio:NAME. Frames are converted to uint16, the type of pyRTC's raw frames. The stream need not exist
        yet.

    Raises
    ------
    MissingExtraError
        When pyRTC is not installed.
    """
    sensor: Any = _pyrtc().WavefrontSensor

    class FaintspotCamera(sensor):  # type: ignore[misc]
        """A pyRTC sensor whose frames come from a stream."""

        EXTRA_CONFIG_KEYS = ("frames",)

        def __init__(self, conf: Mapping[str, Any]) -> None:
            self.following = _Frames(conf)
            super().__init__(conf)

        def expose(self) -> None:
            """Publish the next frame if one comes within a moment."""
            if self.following.next_into(self.data):
                super().expose()

        def close(self, *arguments: object, **options: object) -> None:
            """Close the sensor and the stream."""
            super().close(*arguments, **options)
            self.following.close()

    FaintspotCamera.__module__, FaintspotCamera.__qualname__ = __name__, "FaintspotCamera"
    return FaintspotCamera


@functools.cache
def loop() -> type:
    """Return the class `FaintspotLoop`, a `Loop` of pyRTC with the function `predictive_filter`.

    Its configuration is that of a `Loop`, and

    controller : str
        File of a `faintspot.control.PredictiveControl`. Default: the attribute `controller` is set later.

    Raises
    ------
    MissingExtraError
        When pyRTC is not installed.
    """
    tool: Any = _pyrtc().Loop

    class FaintspotLoop(tool):  # type: ignore[misc]
        """A pyRTC loop whose commands come from a predictive controller."""

        EXTRA_CONFIG_KEYS = ("controller",)

        def __init__(self, conf: Mapping[str, Any]) -> None:
            name = conf.get("controller")
            self.controller = None if name is None else PredictiveControl.load(name)
            self._starts = True
            super().__init__(conf)

        def predictive_filter(self) -> None:
            """Send the command for the next signal, the first time from the present mirror command."""
            if self.controller is None:
                raise InputError("loop.controller: expected the file of a predictive controller, got none")
            slopes = self._read_signal()
            if slopes is None:
                return
            if self._starts:
                self.controller.reset(np.ravel(self.read_stream("wfc", block=False)))
                self._starts = False
            command = self.controller(np.ravel(slopes))
            self.send_to_wfc(command.astype(self.flat.dtype), slopes=slopes)
            self.controller.prepare()

    FaintspotLoop.__module__, FaintspotLoop.__qualname__ = __name__, "FaintspotLoop"
    return FaintspotLoop


class _Frames:
    """Frames of a stream, in order."""

    def __init__(self, conf: Mapping[str, Any]) -> None:
        name = conf.get("frames")
        if not isinstance(name, str):
            raise InputError(f"wfs.frames: expected the name of a stream, got {name!r}")
        self._shape = int(conf["height"]), int(conf["width"])
        self._follower = Follower(name, _logger.warning, self._incompatible)

    def next_into(self, frame: NDArray[np.integer]) -> bool:
        """Wait a moment for a new frame; return whether there was one."""
        publication = self._follower.take(_MOMENT_S) if self._follower.wait(_MOMENT_S) else None
        if publication is not None:
            np.clip(publication.values, 0, np.iinfo(frame.dtype).max, out=frame, casting="unsafe")
        return publication is not None

    def close(self) -> None:
        """Close the stream."""
        self._follower.close()

    def _incompatible(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> str:
        fits = shape == self._shape and dtype.kind in "iuf"
        return "" if fits else f"frames of {self._shape[0]} x {self._shape[1]} (wfs.height, wfs.width)"


class _Measuring:
    """Measurement of a slopes process; created when its geometry is known."""

    def __init__(self, conf: Mapping[str, Any]) -> None:
        if "faintspot" not in conf:
            raise InputError("slopes.faintspot: expected a faintspot.toml or its tables, got none")
        self.parts = parts_of(conf["faintspot"])
        self.noise_free = bool(conf.get("noise_free", False))
        self.flux_e = conf.get("calibration_flux_e", CALIBRATION_FLUX_E)
        frames = conf.get("flux_frames", FLUX_FRAMES)
        self.flux_frames = frames if frames else None
        self.stream_name = (conf.get("input_streams") or {}).get(PREDICTED)
        self._stream: Any = None
        self._tool: ToolSlopes | None = None
        self._places = np.empty(0, np.int64)

    @property
    def tool(self) -> ToolSlopes:
        """Measurement with the present geometry.

        Raises
        ------
        InputError
            When the geometry is not known yet.
        """
        if self._tool is None:
            raise InputError("slopes: no frame has been measured yet; measure one first")
        return self._tool

    def maps(self, process: Any, image: NDArray[np.generic], open_stream: object) -> NDArray[np.float32]:
        """Measure an image; return maps with slopes of pyRTC's valid sub-apertures only."""
        n = int(process.num_regions)
        valid = _mapped("valid_sub_aps", process.valid_sub_aps, n).astype(bool)
        references = _mapped("ref_slopes", process.ref_slopes, n).astype(np.float64)
        used = np.flatnonzero(valid[:n] | valid[n:])
        if self._tool is None or not np.array_equal(used, self._places):
            self._tool, self._places = self._made(process, image.shape, used), used
        at = np.concatenate([used, used + n * n])
        reference = references.ravel()[at].reshape(2, -1)
        prior = self._predicted(valid, open_stream)
        prior = None if prior is None else (prior.ravel()[at].reshape(2, -1) + reference).ravel()
        if not image.any():  # pyRTC's first frame is blank and only compiles the kernels
            self._tool.pipeline(image)
            return np.zeros((2 * n, n), np.float32)
        found = self._tool.measure(image, prior_px=prior, noise_free=self.noise_free)
        slopes = np.zeros((2 * n, n), np.float32)
        slopes.ravel()[at] = np.where(self._tool.last.measured, found - reference, 0.0).ravel()
        return slopes

    def _made(self, process: Any, shape: tuple[int, ...], used: NDArray[np.int64]) -> ToolSlopes:
        """Create the pipeline for pyRTC's sub-apertures."""
        if not used.size:
            raise InputError("slopes.valid_sub_aps: expected at least one valid sub-aperture, got none")
        side, spacing, n = int(process.region_size), float(process.sub_ap_spacing), int(process.num_regions)
        first = np.array([round(spacing * i) for i in range(n)])
        rows, columns = first[used // n] + process.offset_y, first[used % n] + process.offset_x
        corners = np.column_stack([columns, rows])
        if len(shape) != 2:
            raise InputError(f"frame: expected rows and columns, got shape {shape}")
        height, width = shape
        outside = (corners < 0).any(axis=1) | (corners + side > [width, height]).any(axis=1)
        if outside.any():
            where = int(used[np.argmax(outside)])
            raise InputError(
                f"slopes.valid_sub_aps: expected sub-apertures of {side} px on the frame of {height} x "
                f"{width}, got {np.count_nonzero(outside)} that leave it, first row {where // n}, column "
                f"{where % n}; leave them out, or change sub_ap_offset_x and _y"
            )
        parts = self.parts
        return ToolSlopes(
            layout_around(corners + 0.5 * (side - 1), (height, width), side),
            parts.settings,
            parts.calibration,
            psf=parts.psf,
            weights=parts.weights,
            calibration_flux_e=self.flux_e,
            flux_frames=self.flux_frames,
        )

    def _predicted(self, valid: NDArray[np.bool_], open_stream: Any) -> NDArray[np.float64] | None:
        """Return the predicted slopes as maps, or None if there are none yet."""
        if self.stream_name is None:
            return None
        if self._stream is None:
            try:
                self._stream = open_stream(self.stream_name)
            except FileNotFoundError:
                return None  # nothing has been predicted yet
        if not self._stream.count:
            return None
        values = np.asarray(self._stream.read())
        wanted = np.count_nonzero(valid)
        if values.size != wanted:
            raise InputError(f"stream {self.stream_name}: expected {wanted} slopes, got {values.size}")
        maps = np.zeros(valid.shape)
        maps[valid] = values.ravel()
        return maps


def _mapped(name: str, values: object, n: int) -> NDArray[Any]:
    """Return a checked pyRTC map for n x n sub-apertures, x above y."""
    array = np.asarray(values)
    if array.shape != (2 * n, n):
        raise InputError(
            f"slopes.{name}: expected shape {(2 * n, n)} for {n} x {n} sub-apertures, got {array.shape}; "
            "remake it for this sub_ap_spacing"
        )
    if not np.isfinite(array).all():
        raise InputError(
            f"slopes.{name}: expected finite numbers, got {np.count_nonzero(~np.isfinite(array))} NaN or "
            "infinite; remake it with every valid sub-aperture illuminated"
        )
    return array
