"""A simulated telescope at a camera's pace, which reads commands and publishes pixels and truth."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.checks import not_none, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.base.files import Closing
from faintspot.base.text_files import check_keys
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.readout import CameraReport, Readout, readout_type
from faintspot.engine.processes.requests import EFFECT_TIMEOUT_S, Handler, changes_of
from faintspot.engine.streams.bridge import CommandStream
from faintspot.engine.streams.shared_streams import create_stream, held
from faintspot.loop.simulation.configuration import LoopConfiguration
from faintspot.loop.simulation.telescope import TelescopeModel, make_detector
from faintspot.loop.slope_covariance import ARCSEC
from faintspot.slopes.spots.shapes import R0_WAVELENGTH_M

ORDERS = ("photons", "magnitude", "r0_m", "seeing_arcsec", "wind_factor")
_FWHM = 0.976  # long-exposure FWHM in units of wavelength / r0, without outer scale (Roddier 1981)
_LARGEST_PHOTONS = 1e9


@dataclass(frozen=True)
class ObservingConditions:
    """The star's flux and the turbulence.

    Raises
    ------
    InputError
        When the flux exceeds what a camera can take.
    """

    photons: float
    """Photo-electrons per fully illuminated sub-aperture and frame."""
    r0_m: tuple[float, float]
    """Range within which the Fried parameter at 500 nm drifts."""
    wind_factor: float = 1.0
    """Wind speeds as a multiple of the configuration's."""

    def __post_init__(self) -> None:
        number_between("photons", self.photons, 0, _LARGEST_PHOTONS, low_open=True)

    @classmethod
    def of(cls, configuration: LoopConfiguration) -> ObservingConditions:
        """Return the configuration's own conditions."""
        r0 = configuration.atmosphere.r0_m
        return cls(configuration.photons, r0 if isinstance(r0, tuple) else (r0, r0))

    def ordered(self, configuration: LoopConfiguration, changes: Mapping[str, object]) -> ObservingConditions:
        """Return the conditions with changes, by the names of `ORDERS`.

        Raises
        ------
        InputError
            For an unknown name, a value out of its range, two values of the flux or two of the seeing.
        """
        check_keys("", changes, ORDERS, what="order")
        for pair in (("photons", "magnitude"), ("r0_m", "seeing_arcsec")):
            if all(name in changes for name in pair):
                raise InputError(f"{' and '.join(pair)}: expected one of the two, got both")
        new: dict[str, Any] = {}
        if "photons" in changes:
            new["photons"] = number_between("photons", changes["photons"], 0, _LARGEST_PHOTONS, low_open=True)
        if "magnitude" in changes:
            magnitude = number_between("magnitude", changes["magnitude"], -30, 60)
            new["photons"] = float(configuration.photometry.electrons(magnitude))
        if "r0_m" in changes:
            new["r0_m"] = _two_ends("r0_m", changes["r0_m"], 0.01, 1e3)
        if "seeing_arcsec" in changes:
            ends = _two_ends("seeing_arcsec", changes["seeing_arcsec"], 0.01, 10)
            new["r0_m"] = tuple(_FWHM * R0_WAVELENGTH_M / (ARCSEC * seeing) for seeing in ends)
        if "wind_factor" in changes:
            new["wind_factor"] = number_between("wind_factor", changes["wind_factor"], 0, 100)
        return replace(self, **new)


def _two_ends(name: str, value: object, low: float, high: float) -> tuple[float, float]:
    """Return a single number twice, or a pair unchanged."""
    ends = numbers_between(name, value, low, high)
    if ends.size not in (1, 2) or ends.ndim > 1:
        raise InputError(f"{name}: expected one number, or two to drift between, got {value!r:.80}")
    first, last = ends.flat[0], ends.flat[-1]
    return float(first), float(last)


TRUTH = ("frame", "strehl", "rms_nm", "r0_m", "time_s", "begun_s", "command_frame", "photons")
"""Values of NAME_truth for a frame, float64.

Strehl ratio and rms of the residual wavefront, r0, the middle of the exposure on the atmosphere's clock, the
start of the exposure (CLOCK_MONOTONIC), the frame number stamped on the commands in use (-1: none yet), and
photo-electrons per fully illuminated sub-aperture.
"""
LENGTHY = ("set",)
"""Commands that wait for the next exposure; other commands are answered meanwhile."""
_BETWEEN_COMPLAINTS_S = 10.0


@dataclass(eq=False)
class Order:
    """Requested change of the observing conditions."""

    conditions: ObservingConditions
    frame: int = -1
    """First frame with them."""
    in_effect: threading.Event = field(default_factory=threading.Event)


@dataclass(frozen=True, eq=False)
class Exposure:
    """A frame, and its truth as in `TRUTH`."""

    pixels: NDArray[Any]
    truth: tuple[float, ...]


class SimulatedTelescope(Readout, Closing):
    """Telescope that observes as `simulate_loop` does, with the commands of a stream.

    The exposure takes one frame time, the read-out a part of the next one. At the start of an exposure the
    mirror takes the newest commands of the stream NAME_commands and holds them until its end. Frame k equals
    that of `simulate_loop` with the same commands, seed and realisation; late frames delay the atmosphere,
    too. Simulation and read-out run in separate threads.

    With `waits`, an exposure begins no earlier than the engine, if one runs, has sent the command that is due
    then: on a slow machine there are fewer frames in a second, but the loop is the same.

    Rows go into the pixel ring NAME. After the last one, the stream NAME_truth gets the truth (`TRUTH`) and
    NAME_frames the whole frame, both stamped with its number.

    Parameters
    ----------
    configuration : LoopConfiguration
        Its frame rate is that of the camera.
    name : str
        Name of the pixel ring and of the streams.
    seed : int, optional
        Default: the configuration's.
    realisation : int
    say : function, optional
        Called with a one-line message about the commands, and when the pace cannot be kept.
    waits : bool
        Whether to wait for the command that is due.
    keep_truth : function, optional
        Called with the values of `TRUTH` after each frame.
    **rows
        readout_fraction and rows_per_block [default: the rows of a sub-aperture], as for `Readout`.

    Attributes
    ----------
    telescope_model : TelescopeModel
    commands : CommandStream

    Raises
    ------
    InputError
        When a value is out of its range, parts do not fit together, or the ring or a stream cannot be made.
    MissingExtraError
        When HCIPy or pyshmem is not installed.
    """

    def __init__(
        self,
        configuration: LoopConfiguration,
        name: str,
        *,
        seed: int | None = None,
        realisation: int = 0,
        say: Callable[[str], None] | None = None,
        waits: bool = False,
        keep_truth: Callable[[tuple[float, ...]], None] | None = None,
        **rows: Any,
    ) -> None:
        self.configuration, self.name, self._say = configuration, name, say or (lambda _: None)
        self._keep_truth, self._waits = keep_truth, waits
        self._conditions = ObservingConditions.of(configuration)
        start = configuration.run.seed if seed is None else seed
        self.telescope_model = telescope_model = TelescopeModel(configuration, start, realisation)
        self._wind = telescope_model.atmosphere.velocity
        layout, mirror = telescope_model.optics.sensor.layout, telescope_model.optics.mirror
        dtype = readout_type(make_detector(configuration))
        with ExitStack() as undo:
            ring = undo.enter_context(PixelRing.create(name, layout.frame_shape, dtype))
            super().__init__(
                ring,
                layout.frame_shape,
                dtype,
                frame_rate_hz=configuration.control.frame_rate_hz,
                spins=False,  # the simulation needs the processor
                **{"rows_per_block": layout.window[0], **rows},
            )
            self._frames = create_stream(f"{name}_frames", layout.frame_shape, dtype)
            undo.callback(self._frames.unlink)
            self._truth = create_stream(f"{name}_truth", (len(TRUTH),), np.float64)
            undo.callback(self._truth.unlink)
            self.commands = CommandStream(f"{name}_commands", mirror.commands, self._say)
            undo.callback(self.commands.close)
            self._resources = undo.pop_all()
        self._worker = ThreadPoolExecutor(1, "faintspot-exposure")
        self._resources.callback(self._worker.shutdown)
        self._underway: Future[Exposure] | None = None
        self._last: Exposure | None = None
        self._orders = threading.Lock()
        self._order: Order | None = None
        self._complained_s, self._complained_of = -np.inf, 0

    def close(self) -> None:
        """Remove the ring and the streams; repeated calls do nothing."""
        self._resources.close()

    def run(
        self,
        n_frames: int | None = None,
        stop: threading.Event | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> CameraReport:
        """Observe until `n_frames` are out or `stop` is set; a later call continues.

        Raises
        ------
        InputError
            When `n_frames` is not a whole number of at least 1, or another process holds a stream's lock.
        """
        self._complained_of = 0
        with held(self._frames, self._truth):
            return super().run(n_frames, stop, progress)

    def order(self, changes: Mapping[str, object]) -> Order:
        """Change conditions from the next exposure on; see `ORDERS`.

        Raises
        ------
        InputError
            When a name or value is not valid; nothing changes then.
        """
        with self._orders:
            before = self._conditions if self._order is None else self._order.conditions
            self._order = Order(before.ordered(self.configuration, changes))
            return self._order

    def status(self) -> dict[str, object]:
        """Return the telescope's counters and conditions, for the control channel."""
        last = self._last
        return {
            "name": self.name,
            "configuration": self.configuration.name,
            "frame_rate_hz": self.configuration.control.frame_rate_hz,
            "frames": self._next,
            "late": self.late,
            "overruns": self.overruns,
            "truth": None if last is None else dict(zip(TRUTH, last.truth, strict=True)),
            "conditions": asdict(self._conditions),
            "commands": {
                "stream": self.commands.stream,
                "length": self.telescope_model.optics.mirror.commands,
                "obstacle": self.commands.obstacle,
                **asdict(self.commands.counters),
            },
        }

    # ---- frame by frame

    def _frame(self) -> NDArray[np.generic]:
        """Return frame number `_next`, whose exposure began a frame time ago (except for the first one)."""
        if self._underway is None:
            self._underway = self._begin(self._next)
        self._last = self._underway.result()
        return self._last.pixels

    def _publish(self, moment: int, frame: NDArray[np.generic]) -> None:
        """Read out one frame while the exposure of the next one begins."""
        number, exposure = self._next, not_none(self._last)
        self._underway = self._begin(number + 1)
        super()._publish(moment, frame)
        self._truth.write_locked(np.array(exposure.truth), frame_id=number)
        self._frames.write_locked(frame, frame_id=number)
        if self._keep_truth is not None:
            self._keep_truth(exposure.truth)
        self._complain()

    def _begin(self, number: int) -> Future[Exposure]:
        """Begin an exposure with the present conditions and commands."""
        if self._waits:  # the newest command that can be there is that of the last frame but one
            self._await_engine(number + 1 - max(2, self.configuration.control.delay_frames))
        begun_s = time.monotonic()
        self.commands.update()
        time_s = (number + 0.5) / self.configuration.control.frame_rate_hz
        with self._orders:
            order, self._order = self._order, None
            if order is not None:
                self._set(order.conditions, time_s)
                order.frame = number
                order.in_effect.set()
        stamps = begun_s, float(self.commands.frame), self._conditions.photons
        return self._worker.submit(self._expose, number, time_s, self.commands.commands_nm, stamps)

    def _set(self, conditions: ObservingConditions, time_s: float) -> None:
        """Change flux and turbulence; the phase screens stay where the wind has moved them."""
        atmosphere = self.telescope_model.atmosphere.blown(self._wind * conditions.wind_factor, time_s)
        self.telescope_model.atmosphere = replace(atmosphere, r0_range_m=conditions.r0_m)
        self.telescope_model.photons = conditions.photons
        self._conditions = conditions

    def _expose(
        self, number: int, time_s: float, commands_nm: NDArray[np.float64], stamps: tuple[float, ...]
    ) -> Exposure:
        """Simulate one frame; runs in a separate thread."""
        after, residual_nm = self.telescope_model.wavefronts(time_s, commands_nm)
        truth = self.telescope_model.truth(time_s, after)
        truth_values = (float(number), truth.strehl, truth.rms_nm, truth.r0_m, time_s)
        return Exposure(self.telescope_model.frame(number, residual_nm), truth_values + stamps)

    def _complain(self) -> None:
        """Report, at intervals, that the pace cannot be kept."""
        now = time.monotonic()
        if self.overruns <= self._complained_of or now - self._complained_s < _BETWEEN_COMPLAINTS_S:
            return
        rate = self.configuration.control.frame_rate_hz
        self._say(
            f"cannot keep {rate:g} frames/s: {self.overruns} frame times went by without a frame, "
            f"{self.late} frames were late"
        )
        self._complained_of, self._complained_s = self.overruns, now


def commands_of(telescope: SimulatedTelescope) -> dict[str, Handler]:
    """Return the commands of the control channel: status and set."""

    def change(fields: Mapping[str, object]) -> Mapping[str, Any]:
        order = telescope.order(changes_of(fields))
        frame = order.frame if order.in_effect.wait(EFFECT_TIMEOUT_S) else None
        return {"frame": frame, "conditions": asdict(order.conditions)}

    return {"status": lambda fields: telescope.status(), "set": change}
