"""Slopes of frames that arrive row by row: those of the pipeline, bit for bit."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.frames.frame_path import FramePath, Progress, last_rows_of_groups
from faintspot.engine.frames.workers import Workers
from faintspot.loop.control import integrator
from faintspot.loop.control.integrator import SlopeProduct
from faintspot.slopes.kernels.groups import SlopeArrays
from faintspot.slopes.kernels.ordered import store
from faintspot.slopes.kernels.streaming import (
    COLD,
    LAST_ROW,
    MARGIN,
    PACE_CELLS,
    SHORTEST_NS,
    SLEEPS,
    WOKEN_LATE,
    Arrival,
    sleep_until_due,
    wait_for_group,
)
from faintspot.slopes.simulate import sensor_frames

pytestmark = pytest.mark.slow

LAYOUT = fs.Layout.grid((6, 6), pixels=8, pitch=(9, 8))
NOISE = fs.Calibration(dark=0.0, read_noise_e=1.0)
SLOTS = 3
SETTINGS = {
    "tv": fs.Settings(noise_std=1.0, keep_brightest=9),
    "plain": fs.Settings("brightest", keep_brightest=9),
    "with a noise map": fs.Settings("brightest", keep_brightest=9),
}


def frames(n: int, dtype: Any = np.uint16) -> NDArray[Any]:
    detector = fs.slopes.simulate.Detector(1.0, offset_adu=100.0, bits=16)
    simulated, _ = sensor_frames(LAYOUT, n, flux_e=200.0, detector=detector, rng=np.random.default_rng(4))
    return np.asarray(simulated).astype(dtype)


def pipeline(name: str) -> fs.SlopePipeline:
    noise = np.random.default_rng(5).lognormal(0.0, 0.5, LAYOUT.frame_shape)
    calibration = fs.Calibration(100.0, read_noise_e=noise if "noise map" in name else 1.0)
    return fs.SlopePipeline(LAYOUT, SETTINGS[name], calibration, psf=fs.PSF.analytic())


class Source:
    """Slots, and a writer that fills them row by row."""

    def __init__(self, dtype: Any = np.uint16) -> None:
        self.slots = np.zeros((SLOTS, *LAYOUT.frame_shape), dtype)
        self.cells = np.array([-1, 0], np.int64)
        self.progress = Progress(self.cells, 0, 1)

    def write(self, number: int, frame: NDArray[Any], block: int = 5, pause_s: float = 0.0) -> None:
        slot = self.slots[number % SLOTS]
        store(self.cells, 1, 0)
        store(self.cells, 0, number)
        for row in range(0, len(frame), block):
            slot[row : row + block] = frame[row : row + block]
            store(self.cells, 1, min(row + block, len(frame)))
            time.sleep(pause_s)


@contextmanager
def path_of(slopes_of: fs.SlopePipeline, source: Source, threads: int) -> Iterator[FramePath]:
    """A path of several threads that is ready for its first frame."""
    with ExitStack() as stack:
        workers = stack.enter_context(closing(Workers(threads - 1))) if threads > 1 else None
        path = FramePath(slopes_of, source.slots, source.progress, workers=workers)
        path.warm_up()
        yield path


def assert_same(found: fs.Slopes, expected: fs.Slopes, index: int) -> None:
    for name in SlopeArrays._fields:
        assert np.array_equal(getattr(found, name), getattr(expected, name)[index]), name


@pytest.mark.parametrize(
    ("name", "threads", "count", "sleeps"),
    [
        ("tv", 3, 4, False),
        ("plain", 1, 4, False),
        ("with a noise map", 3, 4, False),
        ("plain", 2, 12, True),
    ],
)
def test_same_slopes_as_the_pipeline(name: str, threads: int, count: int, sleeps: bool) -> None:
    """Also where threads sleep until rows are due."""
    data, source, last_row = frames(count), Source(), 0
    expected = pipeline(name)(data)
    block = (12, 0.02) if sleeps else (7, 0.0005)
    with path_of(pipeline(name), source, threads) as path:
        for number, frame in enumerate(data):
            writer = threading.Thread(target=source.write, args=(number, frame, *block))
            writer.start()
            assert path.measure(number, after_ns=last_row)
            last_row = time.monotonic_ns() if sleeps else 0
            writer.join()
            path.flag_doubtful()
            assert_same(path.slopes, expected, number)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_product_with_the_slopes_is_begun_while_rows_arrive(
    threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last rows come when some groups are done. Slopes are the same, and later frames begin anew."""
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    data, source = frames(4), Source()
    expected = pipeline("plain")(data)
    product = SlopeProduct(np.random.default_rng(1).standard_normal((20, 2 * len(LAYOUT))))
    taken, columns = product.memory.taken, product.columns.astype(np.float64)
    middle = LAYOUT.frame_shape[0] // 2

    def write(number: int, frame: NDArray[Any]) -> None:
        source.slots[number % SLOTS] = frame
        store(source.cells, 1, middle)
        store(source.cells, 0, number)
        end = time.monotonic() + 10.0
        while not taken.any() and time.monotonic() < end:
            time.sleep(1e-3)
        store(source.cells, 1, len(frame))

    with path_of(pipeline("plain"), source, threads) as path:
        for number, frame in enumerate(data):
            taken[:] = 0.0
            writer = threading.Thread(target=write, args=(number, frame))
            writer.start()
            assert path.measure(number, product=product.parts(threads, 0.5))
            writer.join()
            path.flag_doubtful()
            assert_same(path.slopes, expected, number)
            vector, begun = 0.5 * path.slopes.vector.astype(np.float64), taken != 0
            np.testing.assert_array_equal(taken[begun], vector.astype(np.float32)[begun])
            assert begun.any()
            np.testing.assert_allclose(product.memory.outs.sum(axis=0), taken @ columns, atol=1e-5)
            np.testing.assert_allclose(product(vector), vector @ columns, atol=1e-5)  # of float32


def test_no_product_is_begun_of_frames_that_are_there_or_never_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the latter, the slopes of the frame before are still there."""
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    data, source = frames(2), Source()
    for number in range(2):  # one that has passed counts as there
        source.write(number, data[number])
    product = SlopeProduct(np.ones((20, 2 * len(LAYOUT))))
    path = FramePath(pipeline("plain"), source.slots, source.progress)
    parts = product.parts(1, 1.0)
    parts[0].taken[:] = 1.0  # of a frame that was lost
    assert path.measure(0, product=parts)
    assert not product.memory.taken.any()
    path.flag_doubtful()
    assert_same(path.slopes, pipeline("plain")(data), 0)
    assert path.slopes.vector.any()
    path.stop()
    assert not path.measure(2, product=product.parts(1, 1.0))
    assert not product.memory.taken.any()


def test_groups_wait_for_their_last_row_only() -> None:
    rows = last_rows_of_groups(pipeline("plain"), 16)
    assert rows.tolist() == [26, 53, 53]  # sub-apertures 0-15, 16-31, 32-35 in rows of 9 px


def test_what_no_path_measures_is_refused() -> None:
    source = Source()
    for shape, dtype, message in (
        ((10, 10), "u2", "expected contiguous frames"),
        (LAYOUT.frame_shape, "i4", "uint16 or float32"),
    ):
        with refused(match=message):
            FramePath(pipeline("plain"), np.zeros((2, *shape), dtype), Progress(np.zeros(2, np.int64), 0, 1))
    automatic = fs.Settings(noise_std="auto", keep_brightest="auto", spot_fwhm_px=2.0)
    with refused("settings.flux_e"):
        FramePath(fs.SlopePipeline(LAYOUT, automatic, NOISE), source.slots, source.progress)


def pace_of(last_row_ns: int, margin_ns: int) -> NDArray[np.int64]:
    pace = np.zeros(PACE_CELLS, np.int64)
    pace[LAST_ROW], pace[MARGIN] = last_row_ns, margin_ns
    return pace


def test_a_pause_of_the_camera_delays_no_later_frame() -> None:
    """After a frame that came 2 s late a thread sleeps hardly longer than before."""
    cells, control, due = np.zeros(2, np.int64), np.zeros(1, np.int64), np.full(1, 3_000_000)
    pace = pace_of(time.monotonic_ns() - 2 * 10**9, SHORTEST_NS)
    assert wait_for_group(Arrival(np.ones(2, np.int64), 0, 1, control, 0, pace, due), 0, 1, 0)  # compiled
    threading.Timer(0.5, store, (cells, 1, 1)).start()
    assert wait_for_group(Arrival(cells, 0, 1, control, 0, pace, due), 0, 1, 0)
    assert 3_000_000 < due[0] < 4_000_000


def test_a_thread_that_woke_up_late_wakes_up_earlier_next_time() -> None:
    cells, control, due = np.zeros(2, np.int64), np.zeros(1, np.int64), np.full(1, 10**9)
    pace = pace_of(0, SHORTEST_NS)
    arrival = Arrival(cells, 0, 1, control, 0, pace, due)
    assert not sleep_until_due(arrival, 0, 1, 0)  # compiled; nothing is known yet
    pace[LAST_ROW] = time.monotonic_ns()
    threading.Timer(0.2, store, (cells, 1, 1)).start()
    assert not sleep_until_due(arrival, 0, 1, 0)
    assert pace[WOKEN_LATE] == 1
    assert pace[MARGIN] > SHORTEST_NS
    assert due[0] < 10**9
    assert wait_for_group(arrival, 0, 1, 0)


def test_a_margin_above_the_time_between_frames_does_not_end_sleeping() -> None:
    cells, control, due = np.zeros(2, np.int64), np.zeros(1, np.int64), np.full(1, 10**9)
    pace = pace_of(time.monotonic_ns(), 2 * 10**9)
    assert sleep_until_due(Arrival(cells, 0, 1, control, 0, pace, due), 0, 1, 0)
    assert pace[SLEEPS] > 0
    assert pace[COLD] == 1
    assert pace[MARGIN] <= due[0] // 2
