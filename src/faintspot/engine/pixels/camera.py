"""Read-out of frames row by row at a camera's pace, and a simulated camera with moving spots."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.generators import spawn
from faintspot.base.sizes import check_size
from faintspot.engine.pixels.pixel_ring import PixelRing
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import Detector, sensor_frames
from faintspot.slopes.spots.shapes import SpotShape

_SPIN_NS = 150_000  # a sleep may overrun by this much; the last part is a busy wait
_BETWEEN_REPORTS_NS = 100_000_000
LATE = 0.1
"""Delay, as a fraction of the frame time, beyond which a frame counts as late."""


class StopEvent(Protocol):
    """Event that stops a camera: threading.Event or multiprocessing.Event."""

    def is_set(self) -> bool:
        """Return whether to stop."""
        ...


@dataclass(frozen=True)
class SpotMotion:
    """Motion of the spots from frame to frame, independent for each spot and axis.

    A first-order autoregressive process (AR(1)): Gaussian positions around the sub-aperture's centre, with a
    correlation that falls by a factor e within the correlation time.

    Parameters
    ----------
    standard_deviation_px : float
        Standard deviation of the position along each axis.
    correlation_time_s : float
        Correlation time; 0 gives independent positions in every frame.

    Raises
    ------
    InputError
        When a value is negative or not finite.
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
        # The first position has the same spread as all later ones.
        steps[1:] *= math.sqrt(1 - kept**2)
        for frame in range(1, n_frames):
            steps[frame] += kept * steps[frame - 1]
        positions: NDArray[np.float64] = self.standard_deviation_px * steps
        return positions


@dataclass(frozen=True)
class CameraReport:
    """Result of a camera run.

    Attributes
    ----------
    frames : int
        Frames published.
    overruns : int
        Frame times without a frame, because the frame before came too late.
    seconds : float
        Time from the start of the first frame to the end of the last frame time.
    late : int
        Frames that started more than `LATE` of the frame time after their scheduled time.
    """

    frames: int
    overruns: int
    seconds: float
    late: int = 0

    @property
    def frame_rate_hz(self) -> float:
        """Frames published per second."""
        return self.frames / self.seconds if self.seconds else 0.0


class RowTimes(TypedDict, total=False):
    """Options of a `Readout` that say when rows arrive."""

    readout_fraction: float
    rows_per_block: int


class Readout(ABC):
    """Source that publishes frames in a ring on a fixed schedule, row by row, at a camera's pace.

    Parameters
    ----------
    ring : PixelRing
        Ring created by this process.
    shape, dtype
        Shape and type of the frames.
    frame_rate_hz : float
        Frames per second, up to 100,000.
    readout_fraction : float
        Part of the frame time in which the rows arrive one after another, 0 to 1. 0: all at once.
    rows_per_block : int
        Rows that are published together.
    first_number : int
        Number of the first frame.
    spins : bool
        Whether to busy-wait for the last 0.15 ms before each scheduled time, because a sleep may overrun by
        that.

    Attributes
    ----------
    late, overruns : int
        Counts of the current run; as in `CameraReport`.

    Raises
    ------
    InputError
        When a value is out of its range, or the ring does not fit the frames.
    """

    def __init__(
        self,
        ring: PixelRing,
        shape: tuple[int, int],
        dtype: np.dtype[np.generic],
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
        # First row, last row and time after the start of the frame, for each block.
        self._blocks = [
            (first, last, round(fraction * self._period_ns * last / rows))
            for first, last in zip([0, *ends[:-1]], ends, strict=True)
        ]

    @abstractmethod
    def _frame(self) -> NDArray[np.generic] | None:
        """Return frame number `_next`, or None at the end."""

    def run(
        self,
        n_frames: int | None = None,
        stop: StopEvent | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> CameraReport:
        """Publish frames until `n_frames` are out, the source ends or `stop` is set; a later call continues.

        Frames start on a fixed schedule, which does not drift. A late frame is published as fast as possible;
        if no time is left for the next one, that frame time is skipped and counted as an overrun. Frame
        numbers then have no gaps. `progress` is called ten times a second with the number of frames.

        Raises
        ------
        InputError
            When `n_frames` is not a whole number of at least 1.
        """
        limit = None if n_frames is None else int(number_between("n_frames", n_frames, 1, integer=True))
        start, tick, published, reported_ns = time.monotonic_ns(), 0, 0, 0
        self.late = self.overruns = 0
        while (limit is None or published < limit) and not (stop is not None and stop.is_set()):
            frame = self._frame()  # before its scheduled time, because it may have to be fetched
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
            if progress is not None and now - reported_ns > _BETWEEN_REPORTS_NS:
                progress(published)
                reported_ns = now
        if published:
            # The last frame takes its full frame time too, so that rates are right.
            self._wait_until(start + round(tick * self._period_ns))
        if progress is not None:
            progress(published)
        return CameraReport(published, self.overruns, (time.monotonic_ns() - start) / 1e9, self.late)

    def _publish(self, moment: int, frame: NDArray[np.generic]) -> None:
        """Read out one frame that starts at `moment`."""
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


class SimulatedCamera(Readout):
    """Camera that publishes simulated frames of a Shack-Hartmann sensor, row by row.

    The frames are simulated in advance and shown cyclically: frame number n is ``frames[n % n_distinct]``.
    The spots jump when the cycle restarts.

    Parameters
    ----------
    layout : Layout
        Positions of the sub-apertures.
    ring : PixelRing
        Ring created by this process, with the layout's frame shape and the type given by `readout_type`.
    frame_rate_hz : float
        Frames per second, up to 100,000.
    flux_e : float or array_like, shape (n,)
        Electrons per sub-aperture and frame, as for `faintspot.slopes.simulate.sensor_frames`.
    detector : Detector, optional
        Default: 1 e- read noise and nothing else.
    motion : SpotMotion, optional
    readout_fraction : float
        Part of the frame time in which the rows arrive one after another, 0 to 1. 0: all at once.
    rows_per_block : int
        Rows that are published together.
    n_distinct : int
        Number of frames that are simulated.
    rng : numpy.random.Generator, optional
        Generator of positions and noise.
    **spot_shape
        profile, size, elongation and angle_deg, see `faintspot.slopes.spots.shapes`.

    Attributes
    ----------
    frames : ndarray, shape (n_distinct, rows, columns)
        ADU, read-only.
    truth : ndarray, float64, shape (n_distinct, n, 2)
        True x and y of each spot from the centre of its window, px, read-only.

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
        motion: SpotMotion | None = None,
        readout_fraction: float = 0.8,
        rows_per_block: int = 4,
        n_distinct: int = 200,
        rng: np.random.Generator | None = None,
        **spot_shape: Unpack[SpotShape],
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
            positions=moving.positions(count, len(layout), frame_rate_hz, motion_rng),
            detector=camera,
            rng=noise_rng,
            **spot_shape,
        )
        self.frames.flags.writeable = self.truth.flags.writeable = False

    def _frame(self) -> NDArray[np.generic]:
        """Return frame number `_next`."""
        frame: NDArray[np.generic] = self.frames[self._next % len(self.frames)]
        return frame


def readout_type(detector: Detector) -> np.dtype[np.generic]:
    """Return the type of a detector's frames: float32, or uint16 or uint32 if it has `bits`."""
    if detector.bits is None:
        return np.dtype(np.float32)
    return np.dtype(np.uint16 if detector.bits <= 16 else np.uint32)


def _wait_until(moment: int) -> None:
    """Wait until a time of CLOCK_MONOTONIC, ns; return at once if it is past."""
    remaining = moment - time.monotonic_ns()
    if remaining > _SPIN_NS:
        time.sleep((remaining - _SPIN_NS) / 1e9)
    while time.monotonic_ns() < moment:
        pass
