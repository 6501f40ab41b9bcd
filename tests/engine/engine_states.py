"""An engine in any state against a plain model, one frame after the other; its tests replace what waits."""

import shutil
import tempfile
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from numpy.typing import NDArray
from tests.engine.bench import CALIBRATION, LAYOUT, simulated
from tests.engine.engine_model import BRIGHT, Camera, EngineModel, N, Plain
from tests.engine.estimator_files import PEAK, write
from tests.patience import LIMIT_S, wait_for
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.engine.engine import Engine
from faintspot.engine.frames.pixel_ring import PixelRing
from faintspot.engine.frames.timing import CAUSES, INCOMPLETE
from faintspot.engine.request_handlers import commands_of
from faintspot.engine.settings.interleaving import methods_after
from faintspot.engine.settings.plan import EngineOptions
from faintspot.engine.telemetry.ring import TelemetryRing
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.estimators import estimators
from faintspot.slopes.estimators.registry import restore

ROWS = LAYOUT.frame_shape[0]
CONTROL = Control(
    np.random.default_rng(1).standard_normal((2 * N, 5)),
    None,
    ControlOptions(guard_frames=4, proven_frames=6, most_invalid=0.4),
)
BODY = f"if {BRIGHT / 2} < images.max() < {BRIGHT}:\n    raise ValueError('bright')\n{PEAK}"
SPOTS = "spots 0", "spots 1", "spots 2"
BAD = {"not finite": [np.nan, np.inf, -np.inf], "absurd": [3e38, -3e38, 1e-40]}
KINDS = st.sampled_from([*SPOTS, *BAD, *3 * ["bright"], *2 * ["dark"]])
SEVERAL = st.lists(KINDS, min_size=2, max_size=7) | KINDS.map(lambda kind: 7 * [kind])
DTYPES = st.sampled_from([np.uint16, np.float32])
STEPS = st.sampled_from([1, 1, 1, 1, 2, 0, -3, 1000, 2_000_000, 2**62])
WHERE = st.none() | st.lists(st.integers(0, N - 1), min_size=1, max_size=4)
REFUSED: list[tuple[str, dict[str, Any]]] = [
    ("set", {"changes": {"keep_brightest": 64}}),
    ("set", {"changes": {"search_range_px": np.nan}}),
    ("set", {"changes": {"search_range_px": 1}, "where": [N]}),
    ("set", {"changes": {"estimator": "ml", "search_range_px": 3.5}}),
    ("interleave", {"methods": "set,none"}),
    ("interleave", {"methods": "set", "every": 0}),
    ("interleave", {"methods": "set,search_range_px=-1"}),
    ("load", {"source": "/none/such.py"}),
    ("unload", {"estimator": "brightest"}),
    ("loop", {"action": "gain", "gain": -1}),
    ("get", {"names": ["none such"]}),
]
"""Requests that are refused in every state, and change nothing."""


@cache
def frame_of(kind: str) -> NDArray[Any]:
    """Return a frame of one of `KINDS`."""
    if kind == "dark":
        return np.full(LAYOUT.frame_shape, 100, np.uint16)
    frame: NDArray[Any] = simulated(len(SPOTS))[SPOTS.index(kind) if kind in SPOTS else 1]
    if kind == "bright":
        frame[3, 3] = BRIGHT
    elif kind in BAD:
        frame = frame.astype(np.float32)
        frame[:9:4, :20] = np.array(BAD[kind])[:, None]
    return frame


def make(settings: fs.Settings) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, settings, CALIBRATION, threads=1)


class Engines(RuleBasedStateMachine):
    """One engine after the other, under one name."""

    engine: Engine | None = None
    ring: PixelRing | None = None

    @initialize(with_loop=st.booleans(), with_file=st.booleans(), dtype=DTYPES)
    def begin(self, with_loop: bool, with_file: bool, dtype: Any) -> None:
        self.name, self.folder = f"fs_test_{uuid4().hex[:12]}", Path(tempfile.mkdtemp())
        self.registered, self.number = estimators(), -1
        self.start(with_loop)
        self.camera_begins(dtype)
        if with_loop:
            self.request_of_the_loop("close", 0.0)
        if with_file:
            self.load(1.0, False)
            self.set_estimator("mine")

    # Its life

    @precondition(lambda self: self.engine is None)
    @rule(with_loop=st.booleans())
    def start(self, with_loop: bool) -> None:
        control = CONTROL if with_loop else None
        self.model = EngineModel(ControlLoop(CONTROL, LAYOUT) if with_loop else None)
        self.camera = Camera()
        options = EngineOptions(deadline_s=LIMIT_S, images_every=2)
        source = cast(Any, self.camera)
        self.engine = Engine(self.name, make, Plain().settings, options, source=source, control=control)
        self.ask, self.telemetry = commands_of(self.engine), TelemetryRing.attach(self.name)
        self.thread = threading.Thread(target=self.engine.run)
        self.thread.start()
        self.camera.rest()
        if self.ring is not None:
            self.model.new_ring(self.ring.arrivals, self.ring.progress()[0])

    @precondition(lambda self: self.engine is not None and len(self.model.records) > 15)
    @rule(again=st.booleans())
    def stop(self, again: bool) -> None:
        for _ in range(1 + again):
            self.ask["stop"]({})
        self.camera.go_on(False)
        self.end()

    def end(self) -> None:
        """See what is left of an engine that was stopped."""
        self.thread.join(LIMIT_S)
        assert not self.thread.is_alive()
        self.compare()
        changes, _, _ = self.telemetry.changes_since(0)
        frames = {each["number"]: each["frame"] for each in changes if "loop" not in each["changes"]}
        assert frames == self.model.taken
        names, _ = methods_after(self.telemetry.description["methods"], changes)
        assert [names[record.method] for record in self.model.records] == self.model.labels
        with refused(self.name):
            TelemetryRing.attach(self.name)
        self.engine = None
        restore(self.registered)  # as in another process

    # The camera

    @precondition(lambda self: self.ring is None)
    @rule(dtype=DTYPES)
    def camera_begins(self, dtype: Any) -> None:
        self.ring = PixelRing.create(self.name, LAYOUT.frame_shape, dtype)
        if self.engine is not None:
            self.model.new_ring()
            self.model.take()
            self.go_on(False)

    @precondition(lambda self: self.ring is not None and self.ring.arrivals > 5)
    @rule()
    def camera_ends(self) -> None:
        self.close_ring()
        if self.engine is not None:
            self.model.counters.source_restarts += 1
            self.go_on(False)

    def close_ring(self) -> None:
        assert self.ring is not None
        self.ring.close()
        self.ring = None

    def go_on(self, has_frame: bool) -> None:
        self.camera.go_on(has_frame)
        self.camera.rest()

    def next_number(self, step: int) -> int:
        self.number = min(max(self.number + step, 0), 2**63 - 1)
        return self.number

    def pixels(self, kind: str) -> NDArray[Any]:
        assert self.ring is not None
        is_left_out = self.ring.dtype == np.uint16 and kind in BAD
        return np.asarray(frame_of("dark" if is_left_out else kind), self.ring.dtype)

    @precondition(lambda self: self.engine is not None and self.ring is not None)
    @rule(kinds=SEVERAL, step=STEPS)
    def frames(self, kinds: list[str], step: int) -> None:
        """Let frames come, one after the other."""
        for kind in kinds:
            self.publish(kind, step)
            self.model.measure_all()
            self.go_on(True)

    @precondition(lambda self: self.engine is not None and self.ring is not None)
    @rule(kinds=SEVERAL, step=STEPS, short=st.sampled_from([0, 2, 3, 4]))
    def frames_at_once(self, kinds: list[str], step: int, short: int) -> None:
        """Let more frames come than the ring holds; the last but few may end before its last row."""
        for index, kind in enumerate(kinds):
            self.publish(kind, step, is_short=len(kinds) - index == short)
        self.model.measure_all()
        self.go_on(True)

    def publish(self, kind: str, step: int, *, is_short: bool = False) -> None:
        assert self.ring is not None
        number, pixels = self.next_number(step), self.pixels(kind)
        self.model.arrive(number, None if is_short else pixels)
        if is_short:
            self.ring.begin(number)[:5] = pixels[:5]
            self.ring.rows_ready(5)
        else:
            self.ring.publish(pixels, number)

    @precondition(lambda self: self.engine is not None and self.ring is not None)
    @rule(kind=KINDS, then=st.sampled_from(["go on", "camera ends", "stop"]), search_px=st.floats(1.0, 3.0))
    def frame_row_by_row(self, kind: str, then: str, search_px: float) -> None:
        """Let settings change, and perhaps all end, while a frame arrives."""
        assert self.engine is not None
        assert self.ring is not None
        pixels, number = self.pixels(kind), self.next_number(1)
        slot = self.ring.begin(number)
        slot[:9] = pixels[:9]
        self.ring.rows_ready(9)
        self.model.arrive(number, pixels)
        index = self.model.take()
        self.camera.go_on(True)
        wait_for(lambda: self.engine is not None and self.engine._waiting)
        self.ask["set"]({"changes": {"search_range_px": search_px}})
        self.model.change(replace(self.model.newest.settings, search_px=(search_px,) * N))
        if then == "go on":
            slot[9:] = pixels[9:]
            self.ring.rows_ready(ROWS)
            self.model.measure(index)
            self.camera.rest()
        elif then == "camera ends":
            self.close_ring()
            self.model.counters.source_restarts += 1
            self.camera.rest()
        else:
            self.engine.stop()
            self.end()
            self.close_ring()

    @precondition(lambda self: self.engine is None and self.ring is not None)
    @rule(kinds=SEVERAL)
    def frames_before_it_starts(self, kinds: list[str]) -> None:
        """Let frames come that nobody measures."""
        assert self.ring is not None
        for kind in kinds:
            self.ring.publish(self.pixels(kind), self.next_number(1))

    # Requests

    @precondition(lambda self: self.engine is not None)
    @rule(request=st.sampled_from(REFUSED))
    def refuse(self, request: tuple[str, dict[str, Any]]) -> None:
        command, fields = request
        with refused():
            self.ask[command](dict(fields))
        self.model.counters.settings_refused += command == "set"
        if self.ring is not None:
            with refused("shape"):
                self.ring.publish(np.zeros((ROWS, 8)))
            with refused("frame_number"):
                self.ring.publish(np.zeros((ROWS, ROWS)), -1)

    @precondition(lambda self: self.engine is not None)
    @rule(name=st.sampled_from(["keep_brightest", "search_range_px"]), value=st.integers(1, 20), where=WHERE)
    def set_values(self, name: str, value: int, where: list[int] | None) -> None:
        plain, indices = self.model.newest.settings, range(N) if where is None else where

        def changed(values: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(value if index in indices else before for index, before in enumerate(values))

        after: Plain | None = None
        if name == "search_range_px":
            after = replace(plain, search_px=changed(plain.search_px))
        elif plain.estimator == "brightest":
            after = replace(plain, keep=changed(plain.keep))
        self.set({name: value}, where, after)

    @precondition(lambda self: self.engine is not None)
    @rule(estimator=st.sampled_from(["brightest", "mine", "mine"]))
    def set_estimator(self, estimator: str) -> None:
        is_known = estimator == "brightest" or self.model.factor is not None
        changes: dict[str, Any] = {"estimator": estimator}
        if estimator == "brightest":
            changes["keep_brightest"] = 12
        after = self.model.with_estimator(self.model.newest.settings, estimator) if is_known else None
        if after is not None and estimator == "brightest":
            after = replace(after, keep=(12,) * N)
        self.set(changes, None, after)

    @precondition(lambda self: self.engine is not None)
    @rule(share=st.sampled_from([0.25, 0.5, 2.0]))
    def set_share(self, share: float) -> None:
        plain = self.model.newest.settings
        self.set({"share": share}, None, replace(plain, share=share) if plain.estimator == "mine" else None)

    def set(self, changes: dict[str, Any], where: list[int] | None, after: Plain | None) -> None:
        """Change settings; without new ones this is refused."""
        fields = {"changes": changes, "where": where}
        self.asked("set", fields, None if after is None else lambda: self.model.change(after))
        self.model.counters.settings_refused += after is None

    def asked(self, command: str, fields: dict[str, Any], then: Callable[[], object] | None) -> None:
        """Make a request, and let the model do what follows; None: it is refused."""
        if then is None:
            with refused():
                self.ask[command](fields)
        else:
            self.ask[command](fields)
            then()

    @precondition(lambda self: self.engine is not None)
    @rule(
        labels=st.lists(st.sampled_from(["set", "search_range_px=2", "mine"]), min_size=1, max_size=3),
        every=st.integers(1, 3),
    )
    def interleave(self, labels: list[str], every: int) -> None:
        model = self.model
        after = model.turns._replace(
            labels=tuple(labels), every=every, first=model.turns.first + len(model.turns.labels)
        )

        def change() -> None:
            model.turns = after
            model.change(model.newest.settings)

        is_known = "mine" not in labels or model.factor is not None
        fields = {"methods": ",".join(labels), "every": every}
        self.asked("interleave", fields, change if is_known else None)

    @precondition(lambda self: self.engine is not None)
    @rule(factor=st.sampled_from([1.0, 0.5]), replaces=st.booleans())
    def load(self, factor: float, replaces: bool) -> None:
        model, path = self.model, write(self.folder, BODY.replace("self.share", f"{factor} * self.share"))

        def change() -> None:
            in_use = model.factor is not None and any(
                method.estimator == "mine" for method in model.newest.methods
            )
            model.factor, plain = factor, model.newest.settings
            if in_use:
                model.change(model.with_estimator(plain, plain.estimator))

        fields = {"source": str(path), "replace": replaces}
        self.asked("load", fields, change if replaces or model.factor is None else None)

    @precondition(lambda self: self.engine is not None)
    @rule()
    def unload(self) -> None:
        model = self.model

        def change() -> None:
            model.factor = None
            if any(method.estimator == "mine" for method in model.newest.methods):
                model.fall_back()

        self.asked("unload", {"estimator": "mine"}, None if model.factor is None else change)

    @precondition(lambda self: self.engine is not None)
    @rule(action=st.sampled_from(["close", "close", "open", "flat", "gain"]), gain=st.floats(0, 1))
    def request_of_the_loop(self, action: str, gain: float) -> None:
        loop = self.model.loop
        is_refused = loop is None or (action == "flat" and loop.closed)

        def change() -> None:
            assert loop is not None
            if action == "gain":
                loop.gain = gain
            else:
                {"close": loop.close, "open": loop.open, "flat": loop.flatten}[action]()

        self.asked("loop", {"action": action, "gain": gain}, None if is_refused else change)

    # What must be so

    @invariant()
    def it_is_as_the_model(self) -> None:
        if self.engine is not None:
            self.compare()
            self.compare_status()

    def compare(self) -> None:
        """Compare what has been published and counted."""
        assert self.engine is not None
        model, live = self.model, self.engine.live
        counted = asdict(self.engine.counters) | {"settings_changes": 0}
        expected_counters = asdict(model.counters)
        assert counted == expected_counters, set(counted.items()) - set(expected_counters.items())
        assert self.engine.account.lost_because[CAUSES[INCOMPLETE]] == model.counters.short
        records, _, _ = self.telemetry.records.since(0)
        assert len(records) == len(model.records)
        for record, expected in zip(records, model.records, strict=True):
            assert (record["frame"], record["method"], record["change"]) == expected[:3]
            assert record["lost"] == expected.lost
            for name in ("x", "y", "flux", "flags", "iterations", "standard_error_x", "covariance_xy"):
                np.testing.assert_array_equal(record[name], getattr(expected.slopes, name), err_msg=name)
            if expected.commands is not None:
                assert record["loop"] == expected.loop
                np.testing.assert_array_equal(record["commands"], expected.commands.astype(np.float32))
        assert self.telemetry.images.written == len(model.images)
        images, cursor, _ = self.telemetry.images.since(0)
        assert list(images["image_frame"]) == model.images[cursor - len(images) :]
        frames = {number: frame for frame, number, _, _ in live.taken()}
        assert frames == model.taken
        assert live.change_number == model.running.number

    def compare_status(self) -> None:
        """Compare what the engine answers."""
        model, status = self.model, self.ask["status"]({})
        running = model.running
        assert status["estimator"] == running.settings.estimator
        assert (status["methods"], status["every"]) == (list(running.turns.labels), running.turns.every)
        assert list(status["loaded"]) == ([] if model.factor is None else ["mine"])
        assert status["source_refused"] is None
        assert status["loop"]["state"] == ("none" if model.loop is None else model.loop.state)
        values = self.ask["get"]({})["settings"]
        np.testing.assert_array_equal(
            np.broadcast_to(values["search_range_px"], N), running.settings.search_px
        )
        if running.settings.estimator == "brightest":
            np.testing.assert_array_equal(np.broadcast_to(values["keep_brightest"], N), running.settings.keep)
        else:
            assert values["share"] == running.settings.share

    def teardown(self) -> None:
        if self.engine is not None:
            self.engine.stop()
            self.camera.go_on(False)
            self.thread.join(LIMIT_S)
        if self.ring is not None:
            self.ring.close()
        if hasattr(self, "folder"):
            restore(self.registered)
            shutil.rmtree(self.folder)
