"""Frames read out row by row at the pace of a camera, and a simulated one: frames of moving spots."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.generators import spawn
from faintspot.base.sizes import check_size
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.sensor.layout import Layout
from faintspot.simulate import Detector, sensor_frames

_SPIN_NS = 150_000  # a sleep wakes up later than asked for by up to this; the rest is spun
_BETWEEN_REPORTS_NS = 100_000_000
LATE = 0.1
"""A frame that starts later than its moment by this part of the frame time counts as late."""


class StopEvent(Protocol):
    """What says that the camera is to stop: threading.Event, multiprocessing.Event."""

    def is_set(self) -> bool:
        """Whether to stop."""
        ...


@dataclass(frozen=True)
class SpotMotion:
    """How spots move from frame to frame, each on its own and each axis on its own.

    A first-order autoregressive process (AR(1)): Gaussian positions around the sub-aperture's centre, whose
    correlation falls by a factor e within the correlation time.

    Parameters
    ----------
    standard_deviation_px : float
        Of the position on each axis.
    correlation_time_s : float
        0: every frame's positions are new.

    Raises
    ------
    InputError
        When one is negative or not finite.
    """

    standard_deviation_px: float = 0.3
    correlation_time_s: float = 0.01

    def __post_init__(self) -> None:
        for name in ("standard_deviation_px", "correlation_time_s"):
            object.__setattr__(self, name, number_between(name, getattr(self, name), 0))

    def positions(
        self, n_frames: int, n_spots: int, frame_rate_hz: float, rng: np.random.Generator
    ) -> NDArray[np.float64]:
        """Return x and y of every spot in every frame, px, shape (n_frames, n_spots, 2)."""
        time_s = self.correlation_time_s
        kept = math.exp(-1 / (frame_rate_hz * time_s)) if time_s else 0.0
        steps = rng.standard_normal((n_frames, n_spots, 2))
        # The first position already has the spread that all later ones have.
        steps[1:] *= math.sqrt(1 - kept**2)
        for frame in range(1, n_frames):
            steps[frame] += kept * steps[frame - 1]
        positions: NDArray[np.float64] = self.standard_deviation_px * steps
        return positions


@dataclass(frozen=True)
class CameraReport:
    """What a run of the camera did.

    Attributes
    ----------
    frames : int
        Frames published.
    overruns : int
        Frame times of the schedule that went by without a frame, because the one before came too late.
    seconds : float
        From the start of the first frame to the end of the last one's frame time.
    late : int
        Frames that started later than their moment by more than `LATE` of the frame time.
    """

    frames: int
    overruns: int
    seconds: float
    late: int = 0

    @property
    def frame_rate_hz(self) -> float:
        """Frames published a second."""
        return self.frames / self.seconds if self.seconds else 0.0


class Readout(ABC):
    """Publishes frames in a ring on a fixed schedule, row by row, at the pace of a camera.

    Parameters
    ----------
    ring : PixelRing
        Created by this process.
    shape, dtype
        Of the frames.
    frame_rate_hz : float
        Frames a second, up to 100,000.
    readout_fraction : float
        Part of the frame time in which the rows arrive, one after the other, 0 to 1. 0: all at once.
    rows_per_block : int
        Rows that are published together.
    first_number : int
        Number of the first frame.
    spins : bool
        Whether to keep the processor for the last 0.15 ms before each moment; a sleep may wake up that late.

    Attributes
    ----------
    late, overruns : int
        Of the run under way; as `CameraReport`.

    Raises
    ------
    InputError
        When a value is out of its range, or the ring is not for such frames.
    """

    def __init__(
        self,
        ring: PixelRing,
        shape: tuple[int, int],
        dtype: np.dtype[Any],
        *,
        frame_rate_hz: float,
        readout_fraction: float = 0.8,
        rows_per_block: int = 4,
        first_number: int = 0,
        spins: bool = True,
    ) -> None:
        if (ring.shape, ring.dtype) != (shape, dtype):
            raise InputError(
                f"ring: expected frames of {shape} and {dtype}, got {ring.shape} and {ring.dtype}"
            )
        rate = number_between("frame_rate_hz", frame_rate_hz, 0, 1e5, low_open=True)
        fraction = number_between("readout_fraction", readout_fraction, 0, 1)
        rows = ring.shape[0]
        block = int(number_between("rows_per_block", rows_per_block, 1, rows, integer=True))
        self._ring, self._period_ns, self._next = ring, 1e9 / rate, first_number
        self._spins, self.late, self.overruns = spins, 0, 0
        ends = [*range(block, rows, block), rows]
        # First row, last row and, from the start of the frame, the moment of each block.
        self._blocks = [
            (first, last, round(fraction * self._period_ns * last / rows))
            for first, last in zip([0, *ends[:-1]], ends, strict=True)
        ]

    @abstractmethod
    def _frame(self) -> NDArray[Any] | None:
        """Return frame number `_next`, None when there are no more."""

    def run(
        self,
        n_frames: int | None = None,
        stop: StopEvent | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> CameraReport:
        """Publish frames until there are `n_frames`, none are left or `stop` is set; a later run goes on.

        Frames start on a fixed schedule, which does not drift. A frame that is late is published as fast as
        possible; when it leaves no time for the next one, that frame time is left out and counted as an
        overrun. Frame numbers have no gaps then. `progress` is told the number of frames, ten times a second.

        Raises
        ------
        InputError
            When `n_frames` is not a whole number of at least 1.
        """
        limit = None if n_frames is None else int(number_between("n_frames", n_frames, 1, integer=True))
        start, tick, published, told = time.monotonic_ns(), 0, 0, 0
        self.late = self.overruns = 0
        while (limit is None or published < limit) and not (stop is not None and stop.is_set()):
            frame = self._frame()  # before its moment: it may have to be fetched
            if frame is None:
                break
            moment = start + round(tick * self._period_ns)
            self._wait_until(moment)
            now = time.monotonic_ns()
            self.late += now - moment > LATE * self._period_ns
            self._publish(moment, frame)
            published += 1
            tick = max(tick + 1, int((time.monotonic_ns() - start) // self._period_ns))
            self.overruns = tick - published
            if progress is not None and now - told > _BETWEEN_REPORTS_NS:
                progress(published)
                told = now
        if published:
            # The last frame has its frame time, too, so that rates come out right.
            self._wait_until(start + round(tick * self._period_ns))
        if progress is not None:
            progress(published)
        return CameraReport(published, self.overruns, (time.monotonic_ns() - start) / 1e9, self.late)

    def _publish(self, moment: int, frame: NDArray[Any]) -> None:
        """Read out one frame that starts at that moment."""
        ring = self._ring
        slot = ring.begin(self._next)
        for first, last, delay in self._blocks:
            self._wait_until(moment + delay)
            slot[first:last] = frame[first:last]
            ring.rows_ready(last)
        self._next += 1

    def _wait_until(self, moment: int) -> None:
        if self._spins:
            _wait_until(moment)
        else:
            time.sleep(max(0, moment - time.monotonic_ns()) / 1e9)


class Camera(Readout):
    """Publishes simulated frames of a Shack-Hartmann sensor, row by row.

    The frames are simulated beforehand and shown in turn, for ever: frame number n is
    ``frames[n % n_distinct]``. At the end of a turn the spots jump.

    Parameters
    ----------
    layout : Layout
        Where the sub-apertures are.
    ring : PixelRing
        Created by this process, of the layout's frame shape and the type that `readout_type` names.
    frame_rate_hz : float
        Frames a second, up to 100,000.
    flux_e : float or array_like, shape (n,)
        Electrons per sub-aperture and frame, as for `faintspot.simulate.sensor_frames`.
    detector : Detector, optional
        Default: 1 e- read noise and nothing else.
    profile, size
        The spots, as for `faintspot.spots.shapes`.
    motion : SpotMotion, optional
    readout_fraction : float
        Part of the frame time in which the rows arrive, one after the other, 0 to 1. 0: all at once.
    rows_per_block : int
        Rows that are published together.
    n_distinct : int
        How many frames are simulated.
    rng : numpy.random.Generator, optional
        Where positions and noise come from.

    Attributes
    ----------
    frames : ndarray, shape (n_distinct, rows, columns)
        ADU, read-only.
    truth : ndarray, float64, shape (n_distinct, n, 2)
        True x and y of each spot from the middle of its window, px, read-only.

    Raises
    ------
    InputError
        When a value is out of its range, or the ring does not fit the layout and detector.
    """

    def __init__(
        self,
        layout: Layout,
        ring: PixelRing,
        *,
        frame_rate_hz: float,
        flux_e: ArrayLike = 200.0,
        detector: Detector | None = None,
        profile: str = "diffraction",
        size: float = 1.0,
        motion: SpotMotion | None = None,
        readout_fraction: float = 0.8,
        rows_per_block: int = 4,
        n_distinct: int = 200,
        rng: np.random.Generator | None = None,
    ) -> None:
        camera = Detector(read_noise_e=1.0) if detector is None else detector
        super().__init__(
            ring,
            layout.frame_shape,
            readout_type(camera),
            frame_rate_hz=frame_rate_hz,
            readout_fraction=readout_fraction,
            rows_per_block=rows_per_block,
        )
        count = int(number_between("n_distinct", n_distinct, 1, integer=True))
        check_size("n_distinct frames", (count, *layout.frame_shape), what="pixels")
        motion_rng, noise_rng = spawn(rng, 2)
        moving = SpotMotion() if motion is None else motion
        self.frames, self.truth = sensor_frames(
            layout.corners,
            layout.window,
            layout.frame_shape,
            count,
            flux_e=flux_e,
            profile=profile,
            size=size,
            positions=moving.positions(count, len(layout), frame_rate_hz, motion_rng),
            detector=camera,
            rng=noise_rng,
        )
        self.frames.flags.writeable = self.truth.flags.writeable = False

    def _frame(self) -> NDArray[Any]:
        """Return frame number `_next`."""
        frame: NDArray[Any] = self.frames[self._next % len(self.frames)]
        return frame


def readout_type(detector: Detector) -> np.dtype[np.generic]:
    """Return the type of a detector's frames: float32, or with `bits` uint16 or uint32."""
    if detector.bits is None:
        return np.dtype(np.float32)
    return np.dtype(np.uint16 if detector.bits <= 16 else np.uint32)


def _wait_until(moment: int) -> None:
    """Return at that time of CLOCK_MONOTONIC, ns, or at once when it is past."""
    left = moment - time.monotonic_ns()
    if left > _SPIN_NS:
        time.sleep((left - _SPIN_NS) / 1e9)
    while time.monotonic_ns() < moment:
        pass
