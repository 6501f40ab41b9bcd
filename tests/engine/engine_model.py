"""A plain model of an engine: which frames it measures, with which settings, and what it counts."""

import threading
from dataclasses import dataclass, field, replace
from functools import cache
from queue import SimpleQueue
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tests.engine.bench import CALIBRATION, LAYOUT
from tests.patience import LIMIT_S

import faintspot as fs
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.engine.frames.timing import Counters
from faintspot.slopes.estimators import Estimator

N, SLOTS = len(LAYOUT), 4
BRIGHT = 60_000
"""Pixel with which the estimator "mine" fails."""
MOST_FAILURES = 3
"""Frames in a row that an estimator may fail in before it is given up."""
LARGEST_GAP = 1_000_000
"""Frame numbers that a camera may leave out; beyond, it has begun anew."""


class Camera:
    """A source in the engine's thread, which waits there for the test when all frames are measured."""

    def __init__(self) -> None:
        self._ready, self._orders = threading.Semaphore(0), SimpleQueue[bool]()

    def step(self) -> bool:
        """Return whether a frame has begun; called by the engine."""
        self._ready.release()
        return self._orders.get(timeout=2 * LIMIT_S)

    def close(self) -> None:
        """Called by the engine when it has ended."""

    def go_on(self, has_frame: bool) -> None:
        """Let the engine look at the ring, without waiting until it has."""
        self._orders.put(has_frame)

    def rest(self) -> None:
        """Wait until the engine has done all that there is to do."""
        assert self._ready.acquire(timeout=LIMIT_S)


@dataclass(frozen=True, eq=False, kw_only=True)
class Peak(Estimator):
    """The same as the estimator of the file, "mine", without being registered."""

    size: Any = 1.0
    name = "peak"
    label = "peak"

    def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
        """Return a part of the place of the brightest pixel."""
        if BRIGHT / 2 < images.max() < BRIGHT:
            raise ValueError("bright")
        n, _, nx = images.shape
        row, column = np.divmod(images.reshape(n, -1).argmax(axis=1), nx)
        return self.size * np.column_stack([column - (nx - 1) / 2, row - (nx - 1) / 2])


@dataclass(frozen=True)
class Plain:
    """Settings as plain values; tuples have one for each sub-aperture."""

    estimator: str = "brightest"
    keep: tuple[int, ...] = (9,) * N
    share: float = 1.0
    factor: float = 1.0
    """Of the estimator's file, by which versions of it differ."""
    search_px: tuple[float, ...] = (3.0,) * N

    @property
    def settings(self) -> fs.Settings:
        """The settings of a pipeline."""
        if self.estimator == "mine":
            return fs.Settings(Peak(size=self.factor * self.share), search_range_px=list(self.search_px))
        options: dict[str, Any] = {"keep_brightest": list(self.keep)}
        return fs.Settings("brightest", **options, search_range_px=list(self.search_px))


@cache
def pipeline_of(plain: Plain) -> fs.SlopePipeline:
    """Return the pipeline of settings."""
    return fs.SlopePipeline(LAYOUT, plain.settings, CALIBRATION, threads=1)


class Frame(NamedTuple):
    """A frame in the camera's ring."""

    number: int
    arrival: int
    pixels: NDArray[Any] | None
    """None: its last rows have not come."""


class Record(NamedTuple):
    """A published frame."""

    number: int
    method: int
    change: int
    lost: int
    slopes: fs.Slopes
    loop: int
    commands: NDArray[np.float64] | None


class Turns(NamedTuple):
    """Configurations that take turns: what each makes of the settings."""

    labels: tuple[str, ...] = ("set",)
    every: int = 1
    first: int = 0


@dataclass
class Version:
    """Accepted settings and what measures frames with them."""

    settings: Plain
    turns: Turns
    methods: list[Plain]
    number: int = 0
    fallback: "Version | None" = None
    failures: list[int] = field(default_factory=list)

    def begin(self) -> None:
        """Measure the frames of another ring."""
        self.failures = [0] * len(self.methods)


class EngineModel:
    """What an engine does, one frame after the other."""

    def __init__(self, loop: ControlLoop | None) -> None:
        self.loop, self.counters = loop, Counters()
        self.factor: float | None = None
        """Of the loaded file; None: no estimator is loaded."""
        self.turns, self.built_in = Turns(), Plain()
        self.versions = 0
        self.newest = self.running = self.prepared(Plain(), 0)
        self.frames: dict[int, int | None] = {}
        """First frames of changes by their numbers."""
        self.slots: dict[int, Frame] = {}
        self.records: list[Record] = []
        self.labels: list[str] = []
        """Configurations of the records."""
        self.images: list[int] = []
        self.measured: dict[int, int] = {}
        self.lost = 0
        self.new_ring()

    # Settings

    def with_estimator(self, plain: Plain, name: str) -> Plain:
        """Return settings with an estimator, or the newest version of its file."""
        assert name == "brightest" or self.factor is not None
        share = plain.share if plain.estimator == name else 1.0
        return replace(plain, estimator=name, share=share, factor=self.factor or 1.0)

    def turn(self, plain: Plain, label: str) -> Plain:
        """Return the settings of a configuration that takes turns."""
        if label == "search_range_px=2":
            return replace(plain, search_px=(2.0,) * N)
        return plain if label == "set" else self.with_estimator(plain, label)

    def prepared(self, plain: Plain, number: int) -> Version:
        """Return settings as accepted."""
        version = Version(plain, self.turns, [self.turn(plain, label) for label in self.turns.labels], number)
        if any(method.estimator == "mine" for method in version.methods):
            is_built_in = plain.estimator != "mine"
            settings = plain if is_built_in else replace(self.built_in, search_px=plain.search_px)
            turns = self.turns
            if turns.labels != ("set",):
                turns = Turns(first=turns.first + len(turns.labels))
            version.fallback = Version(settings, turns, [settings])
        if plain.estimator != "mine":
            self.built_in = plain
        version.begin()
        return version

    def change(self, plain: Plain) -> None:
        """Accept settings for the next frame."""
        self.offer(self.prepared(plain, 0))

    def offer(self, version: Version) -> None:
        """Accept a version for the next frame."""
        self.versions += 1
        version.number, self.newest = self.versions, version
        version.begin()
        self.frames[self.versions] = None

    def fall_back(self) -> None:
        """Give up the estimator of the file, where it is used, with the next frame."""
        fallback = self.newest.fallback
        assert fallback is not None
        self.turns = fallback.turns
        self.offer(fallback)

    @property
    def taken(self) -> dict[int, int]:
        """First frames of the changes that have taken effect, by their numbers."""
        return {number: frame for number, frame in self.frames.items() if frame is not None}

    # Frames

    def new_ring(self, arrivals: int = 0, number: int = -1) -> None:
        """Follow a ring from its next frame on, after so many frames and the last one's number."""
        self.slots.clear()
        self.arrivals = self.arrival = arrivals
        self.number = number
        for version in (self.newest, self.running):
            version.begin()

    def arrive(self, number: int, pixels: NDArray[Any] | None) -> None:
        """Let a frame come."""
        self.arrivals += 1
        self.slots[number % SLOTS] = Frame(number, self.arrivals, pixels)

    def take(self) -> int:
        """Take the newest settings for the next frame; return whose turn it is."""
        if self.newest is not self.running:
            for number, frame in self.frames.items():
                self.frames[number] = self.number + 1 if frame is None else frame
            self.running = self.newest
        version = self.running
        index = self.counters.processed // version.turns.every % len(version.methods)
        if version.failures[index] >= MOST_FAILURES:
            self.newest = version
            self.fall_back()
            return self.take()
        return index

    def measure_all(self) -> None:
        """Measure all frames that are there."""
        while self.arrival < self.arrivals:
            self.measure(self.take())

    def measure(self, index: int) -> None:
        """Measure the next frame, or lose it."""
        arrival = self.arrival + 1
        held = {frame.arrival: frame for frame in self.slots.values()}
        frame = held.get(arrival)
        if frame is not None and frame.pixels is not None:
            self._publish(frame.number, frame.pixels, index)
            return
        passed_over = 0
        if frame is not None:
            self.counters.short += 1
            self.number = frame.number
        else:
            passed_over = self.arrivals - 1 - arrival
            self.counters.torn += 1
            self.counters.passed_over += passed_over
            self.number = held[self.arrivals].number - 1
        self.arrival = arrival + passed_over
        self.lost += 1 + passed_over
        self.counters.dropped += 1 + passed_over
        self.counters.frames_in += 1 + passed_over

    def _publish(self, number: int, pixels: NDArray[Any], index: int) -> None:
        version, counters = self.running, self.counters
        settings, method = version.methods[index], version.turns.first + index
        slopes = pipeline_of(settings)(pixels)
        failed = bool(settings.estimator == "mine" and pixels[3, 3] == BRIGHT)
        version.failures[index] = version.failures[index] + 1 if failed else 0
        state, commands = 0, None
        if self.loop is not None:
            state = 2 if self.loop.closed else 1
            commands = self.loop.follow(slopes, number).copy()
            self.loop.look_after(slopes.flux)
        self.labels.append(version.turns.labels[index])
        self.records.append(Record(number, method, version.number, self.lost, slopes, state, commands))
        if self.measured.get(method, 0) % 2 == 0:
            self.images.append(number)
        self.measured[method] = self.measured.get(method, 0) + 1
        counters.frames_in += 1
        counters.processed += 1
        counters.estimator_failures += failed
        counters.invalid_subapertures += int(np.count_nonzero(~slopes.valid))
        if self.arrival and number != self.number + 1:
            jumped = number - self.number - 1 > LARGEST_GAP
            counters.skipped += 0 if jumped else max(number - self.number - 1, 0)
            counters.source_restarts += jumped
            counters.repeated += number <= self.number
        self.lost, self.arrival, self.number = 0, self.arrival + 1, number
