"""A closed loop for a million frames: does anything grow, and is every lost frame counted?

Engine, page and a cheap sky are processes of their own. Arms take turns, two clients read the page and one
does not, and every `CHANGE_S` something changes: settings, arms, the loop gain, the loop is opened and
closed, or a wrong value is refused. The files are those of `faintspot realtime demo`.

The sky stands for a telescope, which a busy machine cannot simulate a million times within an hour: spots of
one shape, moved by a disturbance of the mirror's own modes (three sines each) and by what the mirror does
about it, with noise of a Gaussian of the right variance. The mirror takes the newest commands when an
exposure begins, so the loop is closed. FAINTSPOT_LONG_FRAMES is how many frames, FAINTSPOT_LONG_RATE_HZ how
many a second.
"""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import cycle
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
from numpy.typing import NDArray

from benchmarks.live_page import client, page, read
from benchmarks.measuring import Row, Table
from benchmarks.realtime_processes import resident_bytes
from faintspot.ao_loop import LoopConfiguration, load_loop
from faintspot.ao_loop.camera import camera_calibration, make_detector
from faintspot.base.errors import InputError
from faintspot.control.configuration import save_control
from faintspot.live_page.demonstration import LiveDemonstration
from faintspot.realtime.camera import Readout, readout_type
from faintspot.realtime.command_stream import CommandStream
from faintspot.realtime.control import LENGTHY_TIMEOUT_S, request
from faintspot.realtime.pixel_ring import PixelRing
from faintspot.realtime.private_socket import socket_path
from faintspot.sensor.layout import Layout

FRAMES = int(os.environ.get("FAINTSPOT_LONG_FRAMES", "1000000"))
RATE_HZ = float(os.environ.get("FAINTSPOT_LONG_RATE_HZ", "500"))
PHOTONS, TURN_FRAMES, CHANGE_S, LOOK_S, READING = 200.0, 250, 2.0, 10.0, 2
WARM = 0.1
"""Part of the frames after which memory is taken as what it should stay."""
MOST_GROWN = 5e6
_DISTURBANCE_PX, _LARGEST_PX, _STEPS, _POOL = 0.7, 5.0, 32, 1 << 20
_COMPILING_S, _SEEN_S = 900.0, 1.0


# ---- the sky, a process of its own


class Sky(Readout):
    """Frames of spots that a disturbance and a mirror move.

    Parameters
    ----------
    ring : PixelRing
    folder : path
        What `LiveDemonstration.write_files` wrote.
    """

    def __init__(self, ring: PixelRing, folder: Path, configuration: LoopConfiguration) -> None:
        dtype = readout_type(make_detector(configuration))
        super().__init__(ring, ring.shape, dtype, frame_rate_hz=RATE_HZ, rows_per_block=16, spins=False)
        layout, calibration = Layout.load(folder / "faintspot.toml"), camera_calibration(configuration)
        self._matrix = np.load(folder / "interaction_matrix.npy")
        self._reference = np.load(folder / "reference_slopes.npy").astype(np.float64)
        self.commands = CommandStream(f"{ring.name}_commands", self._matrix.shape[1], lambda _: None)
        rng = np.random.default_rng(1)
        self._rates = 2 * np.pi * rng.uniform(0.1, 3.0, (3, self._matrix.shape[1])) / RATE_HZ
        self._phases = rng.uniform(0, 2 * np.pi, self._rates.shape)
        self._amplitude = 1.0
        moved = np.array([self._disturbance(frame) for frame in range(0, 100_000, 1000)])
        self._amplitude = _DISTURBANCE_PX / np.sqrt(np.mean(moved**2))
        self._profiles = _profiles(layout.window[0], configuration.scene.seen_fwhm_px)
        self._noise = rng.standard_normal(_POOL).astype(np.float32)
        self._places, self._rng = _places(layout), rng
        self._read_noise_e = float(configuration.camera.read_noise_e)
        self._level, self._adu_per_e = float(calibration.dark), 1 / float(calibration.gain_e_per_adu)
        self._pixels = np.full(ring.shape, round(self._level), dtype)
        self.squares = np.zeros(2)
        """Sums over frames of the mean square of the slopes, px^2: of the disturbance, of what is left."""

    def _disturbance(self, frame: int) -> NDArray[np.float64]:
        """Return slopes, px."""
        modes = np.sin(self._rates * frame + self._phases).sum(axis=0)
        return np.asarray(self._amplitude * (self._matrix @ modes))

    def _frame(self) -> NDArray[Any]:
        self.commands.take()
        disturbance = self._disturbance(self._next)
        left = disturbance + self._matrix @ self.commands.commands_nm
        self.squares += np.mean(disturbance**2), np.mean(left**2)
        places = np.clip(left + self._reference, -_LARGEST_PX, _LARGEST_PX).reshape(2, -1)
        across, along = self._profiles[np.rint((places + _LARGEST_PX) * _STEPS).astype(np.int64)]
        flux = np.float32(PHOTONS) * along[:, :, None] * across[:, None, :]
        start = self._rng.integers(_POOL - flux.size)
        noise = self._noise[start : start + flux.size].reshape(flux.shape)
        electrons = flux + np.sqrt(flux + self._read_noise_e**2) * noise
        self._pixels.reshape(-1)[self._places] = np.maximum(
            np.rint(self._level + self._adu_per_e * electrons), 0
        )
        return self._pixels


def _profiles(pixels: int, fwhm_px: float) -> NDArray[np.float32]:
    """Return what of a Gaussian spot falls into each pixel of a line, by position in `_STEPS` of a pixel."""
    positions = np.arange(round(2 * _LARGEST_PX * _STEPS) + 1) / _STEPS - _LARGEST_PX
    offsets = np.arange(pixels) - (pixels - 1) / 2 - positions[:, None]
    values = np.exp(-4 * np.log(2) * (offsets / fwhm_px) ** 2)
    return np.asarray(values / values.sum(axis=1, keepdims=True), np.float32)


def _places(layout: Layout) -> NDArray[np.int64]:
    """Return where in a frame, as one line, the pixels of each window are, (n, ny, nx)."""
    rows, columns = (np.arange(side) for side in layout.window)
    first = layout.corners[:, 0] * layout.frame_shape[1] + layout.corners[:, 1]
    return np.asarray(first[:, None, None] + rows[:, None] * layout.frame_shape[1] + columns, np.int64)


def observe(name: str, folder: Path) -> None:
    """Publish `FRAMES` frames, and say what they were, as JSON."""
    configuration = load_loop(folder / "loop.toml")
    dtype = readout_type(make_detector(configuration))
    shape = Layout.load(folder / "faintspot.toml").frame_shape
    with PixelRing.create(name, shape, dtype) as ring:
        sky = Sky(ring, folder, configuration)
        while not _counted(name):  # the engine has yet to make itself ready for such frames
            sky.run(1)
            time.sleep(_SEEN_S)
        sky.squares[:], before = 0, _counted(name)
        report = sky.run(FRAMES)
        disturbed, left = np.sqrt(sky.squares / report.frames)
        said: dict[str, float] = {"frames": report.frames, "before": before, "overruns": report.overruns}
        said |= {"seconds": report.seconds, "disturbance_px": disturbed, "left_px": left}
        print(json.dumps(said), flush=True)
        time.sleep(_SEEN_S)
        sky.commands.close()


def _ask(name: str, command: str, **fields: Any) -> dict[str, Any]:
    """Ask the engine, with the patience that a busy machine needs."""
    return request(socket_path(name), command, timeout_s=LENGTHY_TIMEOUT_S, **fields)


def _counted(name: str) -> int:
    """Return how many frames the engine says that it has measured or lost."""
    counters = _ask(name, "status")["counters"]
    return int(counters["processed"] + counters["dropped"])


# ---- everything together


def held(pid: int) -> dict[str, float]:
    """What a process holds."""
    place = Path(f"/proc/{pid}")
    return {
        "MB": resident_bytes(pid) / 1e6,
        "threads": len(os.listdir(place / "task")),
        "descriptors": len(os.listdir(place / "fd")),
    }


class Changes:
    """What changes while the loop runs, one after the other, and how often each was done."""

    def __init__(self, name: str, arms: list[str]) -> None:
        self._name, self.done, self.refused = name, dict[str, int](), dict[str, int]()
        self.states: dict[str, int] = {}
        """How often the loop was found in which state, and why it was open."""
        turns = ",".join(arms), ",".join(arms[::-1]), ",".join(arms[:2])
        flux = (0.9 * PHOTONS, 1.1 * PHOTONS, PHOTONS)
        self._turns, self._flux, self._gains = cycle(turns), cycle(flux), cycle((0.2, 0.3, 0.4))
        self._kinds = cycle(("set", "gain", "set", "opened", "closed", "set", "refused", "set", "arms"))

    def next(self) -> None:
        """See how the loop is, and change something."""
        loop = _ask(self._name, "loop", action="status")["loop"]
        state = loop["state"] if loop["opened_because"] is None else f"open ({loop['opened_because']})"
        self.states[state] = self.states.get(state, 0) + 1
        kind = next(self._kinds)
        try:
            self._change(kind)
            self.done[kind] = self.done.get(kind, 0) + 1
        except InputError:
            self.refused[kind] = self.refused.get(kind, 0) + 1

    def _change(self, kind: str) -> None:
        if kind == "set":
            _ask(self._name, "set", changes={"flux_e": next(self._flux)})
        elif kind == "refused":
            _ask(self._name, "set", changes={"flux_e": -1.0})
        elif kind == "gain":
            _ask(self._name, "loop", action="gain", gain=next(self._gains))
        elif kind == "arms":
            _ask(self._name, "interleave", arms=next(self._turns), every=TURN_FRAMES)
        else:
            _ask(self._name, "loop", action="open" if kind == "opened" else "close")


async def _watch(
    url: str, changes: Changes, sky: subprocess.Popen[str], pids: dict[str, int], name: str
) -> tuple[list[tuple[int, dict[str, dict[str, float]]]], int]:
    """Change and look until the sky ends; return what was held after how many frames, and the updates."""
    clients, counts = [await client(url) for _ in range(READING + 1)], [0] * READING
    reading = [asyncio.ensure_future(read(each, counts, i)) for i, each in enumerate(clients[:READING])]
    looks: list[tuple[int, dict[str, dict[str, float]]]] = []
    looked = 0.0
    while sky.poll() is None:
        await asyncio.sleep(CHANGE_S)
        await asyncio.to_thread(changes.next)
        if time.monotonic() - looked > LOOK_S and sky.poll() is None:
            looked = time.monotonic()
            frames = _ask(name, "status")["counters"]["frames_in"]
            looks.append((frames, {process: held(pid) for process, pid in pids.items()}))
            print(json.dumps(looks[-1]), flush=True)
    for task in reading:
        task.cancel()
    for each in clients:
        each.close()
    return looks, sum(counts)


@contextmanager
def _started(command: list[str], **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run a command; end it."""
    process = subprocess.Popen(
        [sys.executable, "-m", *command], stdin=subprocess.DEVNULL, text=True, **options
    )
    try:
        yield process
    finally:
        process.terminate()
        process.wait()


def _until_ready(name: str) -> None:
    """Wait until the engine waits for frames; it may have to compile."""
    end = time.monotonic() + _COMPILING_S
    while time.monotonic() < end:
        with suppress(InputError):
            request(socket_path(name), "status")
            return
        time.sleep(0.5)
    raise TimeoutError("the engine does not answer")


def run() -> list[Table]:
    """Close the loop for a million frames."""
    name = f"faintspot_benchmark_{uuid4().hex[:8]}"
    with tempfile.TemporaryDirectory() as place:
        shown = LiveDemonstration(Path(place), PHOTONS, RATE_HZ, name, 0, 1)
        _, configuration = shown.write_files()
        save_control(configuration, largest_residual_px=_LARGEST_PX)  # where frames are lost, too
        # The sky's spots have no speckles, for which the demonstration's window is told its centroid gain.
        window = (
            f"estimator=window+window_fwhm_px={2 * shown.observed.scene.seen_fwhm_px:.3g}+centroid_gain=1"
        )
        arms = ["brightest+integrator", f"{window}+integrator", "map+kalman"]
        turns = ["--interleave", ",".join(arms), "--every", str(TURN_FRAMES), "--images-every", "20"]
        command = ["faintspot", "realtime", "run", "--config", str(configuration), "--name", name, *turns]
        with _started([*command, "--close-loop"], stdout=subprocess.DEVNULL) as engine:
            _until_ready(name)
            simulating = ["benchmarks.closed_loop_long", name, place]
            with _started(simulating, stdout=subprocess.PIPE) as sky, page(name) as (serving, url):
                changes = Changes(name, arms)
                pids = {"engine": engine.pid, "page": serving.pid}
                looks, updates = asyncio.run(_watch(url, changes, sky, pids, name))
                assert sky.stdout is not None
                seen = json.loads(sky.stdout.read())
                status = _ask(name, "status")
    return _tables(seen, status, looks, changes, updates)


def _tables(
    seen: dict[str, float],
    status: dict[str, Any],
    looks: list[tuple[int, dict[str, dict[str, float]]]],
    changes: Changes,
    updates: int,
) -> list[Table]:
    counters = status["counters"]
    uncounted = seen["before"] + seen["frames"] - counters["processed"] - counters["dropped"]
    columns = {
        "sent": seen["frames"],
        "measured": counters["processed"],
        "lost, counted": counters["dropped"],
        "lost, not counted": uncounted,
        "frames/s": seen["frames"] / seen["seconds"],
        "disturbance, px rms": seen["disturbance_px"],
        "left, px rms": seen["left_px"],
    }
    notes = [
        f"done: {changes.done}; refused: {changes.refused}; the engine says {counters['settings_changes']} "
        f"changes of settings, {counters['settings_refused']} refused",
        f"the loop, looked at every {CHANGE_S:g} s: {changes.states}",
        f"{updates / READING / seen['seconds']:.1f} updates a second of each client of the page; "
        f"{seen['overruns']:.0f} frame times went by without a frame",
    ]
    frames = Table(
        "closed-loop-long",
        "A closed loop, arms in turn, settings that change, a page that is watched",
        [Row(f"{seen['frames']:.0f} frames", columns, "none not counted", uncounted == 0)],
        notes,
    )
    warm = next(each for count, each in looks if count >= WARM * seen["frames"])
    first, last = looks[0][1], looks[-1][1]
    rows = []
    for process in last:
        values = {
            f"{what}, {when}": look[process][what]
            for what in ("MB", "threads", "descriptors")
            for when, look in (("first", first), ("warm", warm), ("last", last))
        }
        grown = 1e6 * (last[process]["MB"] - warm[process]["MB"])
        rows.append(Row(process, values, f"< {MOST_GROWN / 1e6:g} MB more than warm", grown < MOST_GROWN))
    return [
        frames,
        Table("closed-loop-long-held", f"What is held; warm: after {WARM:.0%} of the frames", rows),
    ]


if __name__ == "__main__":
    observe(sys.argv[1], Path(sys.argv[2]))
