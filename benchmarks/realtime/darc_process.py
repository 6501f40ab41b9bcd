"""DARC's real-time process without Corba: built from its sources, driven through shared memory."""

import mmap
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

import faintspot as fs
from faintspot.adapters.library.folder import ExportedLibrary

ROOT = Path(__file__).parents[2]
MODULES = ROOT / "examples" / "darc"
_ALIGNED, _NAME_BYTES = 64, 16
_STEP_S, _PATIENCE_S = 0.005, 20.0
_ENTRY_HEADER = 32  # bytes before an entry of a circular buffer
_OVERWRITTEN = 16  # oldest entries, which may be written while they are read
_ENTRIES, _MOST_BYTES = 4000, 8_000_000  # of a circular buffer

Parameters = dict[str, Any]


def sources() -> Path | None:
    """Return the folder that has DARC's sources and the script that builds it, if they are here."""
    found = Path(os.environ.get("FAINTSPOT_SHARED", ROOT.parent / "shared")) / "peers"
    return found if (found / "build_darc.sh").exists() and (found / "darc").is_dir() else None


def missing() -> str:
    """Return what is missing to build DARC; empty if nothing is."""
    if sources() is None:
        return "DARC's sources (FAINTSPOT_SHARED/peers)"
    headers = {"numa.h": "libnuma-dev", "fftw3.h": "libfftw3-dev"}
    lacking = [package for header, package in headers.items() if not Path("/usr/include", header).exists()]
    lacking += [tool for tool in ("gcc", "taskset") if shutil.which(tool) is None]
    return ", ".join(lacking)


def build(folder: Path, library: ExportedLibrary, flags: str = "-O3") -> Path:
    """Build DARC, its own modules and ours in a folder."""
    peers = sources()
    assert peers is not None
    environment = {**os.environ, "CFLAGS": flags}
    subprocess.run([peers / "build_darc.sh", folder], env=environment, check=True, capture_output=True)
    common = ["gcc", "-O3", "-w", "-fPIC", "-shared", f"-I{peers}/darc/include"]
    camera: list[str | Path] = [MODULES / "simulated_camera.c", peers / "darc/src/userArray.c"]
    subprocess.run([*common, *camera, "-o", folder / "libsimulated.so"], check=True)
    ours = library.bundle.parent
    link = [f"-I{ours}", f"-L{ours}", "-lfaintspot", f"-Wl,-rpath,{ours}"]
    module: list[str | Path] = [MODULES / "faintspot_slope.c", "-o", folder / "libfaintspotslope.so"]
    subprocess.run([*common, *module, *link], check=True)
    return folder


def await_state(is_there: Callable[[], bool], what: str) -> None:
    """Wait until something is so; raise TimeoutError if it does not come."""
    end = time.monotonic() + _PATIENCE_S
    while not is_there():
        if time.monotonic() > end:
            raise TimeoutError(f"DARC: {what} did not come within {_PATIENCE_S:g} s")
        time.sleep(_STEP_S)


class _ParameterBuffer:
    """One of the two buffers of parameters: names, types, starts, sizes, dimensions; see DARC's buffer.h."""

    def __init__(self, path: Path) -> None:
        await_state(lambda: path.exists() and path.stat().st_size > 20, str(path))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), 0)
        self.header = np.frombuffer(self._memory, np.int32, 5)
        await_state(lambda: bool(self.header[0] and self.header[3]), f"the header of {path}")
        time.sleep(0.05)  # DARC clears the memory before it writes the header
        self._places: dict[str, int] = {}

    @property
    def is_used(self) -> bool:
        """Whether DARC reads this buffer."""
        return bool(self.header[2] & 1)

    def fill(self, values: Parameters) -> None:
        """Write all parameters; the first one last, which tells DARC that the rest is there."""
        start, n = int(self.header[0]), int(self.header[1])
        content = np.frombuffer(self._memory, np.uint8)[start:]
        names, kinds = content[: n * _NAME_BYTES].reshape(n, _NAME_BYTES), content[n * 16 : n * 17]
        starts, sizes = (content[n * k : n * (k + 4)].view(np.int32) for k in (17, 21))
        dimensions, shapes = content[n * 25 : n * 29].view(np.int32), content[n * 29 : n * 53].view(np.int32)
        comments, place = content[n * 53 : n * 57].view(np.int32), -(-n * 57 // _ALIGNED) * _ALIGNED
        items = list(values.items())
        for index in [*range(1, len(items)), 0]:
            name, value = items[index]
            code, data = _encoded(value)
            content[place : place + data.size] = data
            self._places[name] = start + place
            kinds[index], starts[index], sizes[index] = ord(code), place, data.size
            dimensions[index], comments[index] = 1, 0
            shapes[6 * index : 6 * index + 6] = [data.size // {"d": 8, "s": 1, "n": 1}.get(code, 4), *[0] * 5]
            place += -(-max(data.size, 1) // _ALIGNED) * _ALIGNED
            names[index] = np.frombuffer(name.encode().ljust(_NAME_BYTES, b"\0"), np.uint8)
        names[len(items) :] = 0

    def ask_for_switch(self) -> None:
        """Ask DARC to use the other buffer."""
        place = self._places["switchRequested"]
        np.frombuffer(self._memory, np.int32, 1, place)[0] = 1


def _encoded(value: object) -> tuple[str, NDArray[np.uint8]]:
    """Return DARC's type of a value, and its bytes."""
    if value is None:
        return "n", np.zeros(0, np.uint8)
    if isinstance(value, str):
        return "s", np.frombuffer(value.encode() + b"\0", np.uint8)
    array = np.atleast_1d(np.ascontiguousarray(value))
    return array.dtype.char, array.view(np.uint8).ravel()


class CircularBuffer:
    """Newest entries of a circular buffer; see DARC's circ.h."""

    def __init__(self, path: Path, dtype: type[Any]) -> None:
        await_state(path.exists, str(path))
        time.sleep(0.1)
        with path.open("r+b") as file:
            self._bytes = np.frombuffer(mmap.mmap(file.fileno(), 0), np.uint8)
        size, self._length = self._integer(24), self._integer(16)
        count = size * np.dtype(dtype).itemsize
        step = -(-(count + _ENTRY_HEADER) // 8) * 8
        first = self._integer(52)
        entries = self._bytes[first : first + self._length * step].reshape(self._length, step)
        self._numbers = entries[:, 4:8].view(np.int32)[:, 0]
        self._data = entries[:, _ENTRY_HEADER : _ENTRY_HEADER + count].view(dtype)
        self._bytes[12:16].view(np.int32)[0] = 1  # write every frame

    def _integer(self, place: int) -> int:
        return int(self._bytes[place : place + 4].view(np.int32)[0])

    @property
    def number(self) -> int:
        """Frame number of the newest entry."""
        return int(self._numbers[self._integer(8)])

    def since(self, number: int) -> tuple[NDArray[np.int32], NDArray[Any]]:
        """Return frame numbers and data of the entries after a frame number, oldest first, as far as kept."""
        last = self._integer(8)
        count = min(int(self._numbers[last]) - number, self._length - _OVERWRITTEN)
        order = (last - np.arange(count)[::-1]) % self._length
        numbers, data = self._numbers[order].copy(), self._data[order].copy()
        kept = numbers > self.number - self._length + _OVERWRITTEN  # not written anew meanwhile
        return numbers[kept], data[kept]

    def next(self, count: int) -> tuple[NDArray[np.int32], NDArray[Any]]:
        """Return the next entries, when they are there; fewer than fit the buffer."""
        begin = self.number
        await_state(lambda: self.number - begin >= count, f"{count} frames")
        numbers, data = self.since(begin)
        return numbers[:count], data[:count]


class Darc:
    """DARC's process, on given processors; a context manager.

    Parameters
    ----------
    folder : Path
        Where it is built; its output goes into darc.log.
    name : str
        Prefix of its shared memory.
    values : dict
        Parameters.
    environment : dict
        For the modules.
    cpus : str
        Processors, as for `taskset`.
    """

    def __init__(
        self, folder: Path, name: str, values: Parameters, environment: Mapping[str, str], cpus: str = "0,1"
    ) -> None:
        self.folder, self.name, self.cpus = folder, name, cpus
        self._memory = Path("/dev/shm")
        self._values, self._environment = (
            values,
            {**os.environ, "LD_LIBRARY_PATH": str(folder), **environment},
        )

    def __enter__(self) -> Self:
        self._remove()
        command = ["taskset", "-c", self.cpus, str(self.folder / "darcmain"), f"-s{self.name}"]
        entries = min(_ENTRIES, _MOST_BYTES // (8 * len(self._values["subapFlag"])))
        command += ["-b8000000", "-e160"]
        for buffer in ("rtcCentBuf", "rtcTimeBuf"):
            command += ["-c", buffer, str(entries)]
        with (self.folder / "darc.log").open("w") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, env=self._environment)
        try:
            self._buffers = [_ParameterBuffer(self._memory / f"{self.name}rtcParam{k}") for k in (1, 2)]
            self._buffers[1].fill({"switchRequested": np.int32(0), **self._values})
            self._buffers[0].fill({"switchRequested": np.int32(1), **self._values})
            self.slopes = CircularBuffer(self._memory / f"{self.name}rtcCentBuf", np.float32)
            self.times = CircularBuffer(self._memory / f"{self.name}rtcTimeBuf", np.float64)
            self.next(1)
        except BaseException:
            self.__exit__()
            raise
        return self

    def next(self, count: int) -> tuple[NDArray[np.int32], NDArray[Any]]:
        """Return frame numbers and slopes (count, 2 n) of the next frames: x and y of each in turn."""
        return self.slopes.next(count)

    def switch(self, values: Parameters) -> None:
        """Write parameters into the buffer that is not in use, and wait until DARC uses it."""
        free, used = sorted(self._buffers, key=lambda buffer: buffer.is_used)
        free.fill({"switchRequested": np.int32(0), **values})
        used.ask_for_switch()
        await_state(lambda: free.is_used, "the switch of the parameters")

    def kill(self) -> None:
        """End the process at once."""
        self.process.kill()
        self.process.wait()

    def __exit__(self, *_: object) -> None:
        self.process.terminate()
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_PATIENCE_S)
        self.kill()
        self._remove()

    def _remove(self) -> None:
        for path in self._memory.glob(f"*{self.name}*"):
            path.unlink(missing_ok=True)


def parameters(layout: fs.Layout, folder: Path, dark_adu: float, threads: int = 1) -> Parameters:
    """Return everything that the core and its modules ask for, with DARC's own centre of gravity."""
    (ny, nx), (h, w), n = layout.window, layout.frame_shape, len(layout)
    corners, i, f = layout.corners, np.int32, np.float32
    places = np.column_stack([corners[:, 0], corners[:, 0] + ny, 0 * corners[:, 0] + 1])
    columns = np.column_stack([corners[:, 1], corners[:, 1] + nx, 0 * corners[:, 1] + 1])
    none = (
        "threadAffinity threadPriority subapAllocation actuators actSequence actuatorMask cameraParams "
        "adapWinShiftCnt mirrorName mirrorParams figureName figureParams bufferName bufferParams calthr "
        "calibrateParams fakeCCDImage slopeParams adaptiveGroup centIndexArray centroidWeight refCentroids "
        "reconParams bleedGroups decayFactor gainE"
    )
    zero = (
        "pause printTime nsteps delay noPrePostThread iterSource printUnused clearErrors currentErrors "
        "frameno addActuators openLoopIfClip recordCents mirrorOpen figureOpen bufferOpen bufferUseSeq "
        "thresholdAlgo useBrightest adapResetCount centroidMode maxAdapOffset subapLocType"
    )
    return {
        **dict.fromkeys(none.split()),
        **dict.fromkeys(zero.split(), i(0)),
        **dict.fromkeys(("ncam", "go", "closeLoop", "threadAffElSize", "camerasOpen"), i(1)),
        **dict.fromkeys(("calibrateOpen", "slopeOpen", "reconlibOpen"), i(1)),
        **dict.fromkeys(("adaptiveWinGain", "fluxThreshold", "bleedGain"), f(0)),
        **dict.fromkeys(("figureGain", "powerFactor"), f(1)),
        "nacts": i(2),
        "maxClipped": i(2),
        "v0": np.zeros(2, f),
        "gainReconmxT": np.zeros((2 * n, 2), f),
        "nsub": np.full(1, n, i),
        "npxlx": np.full(1, w, i),
        "npxly": np.full(1, h, i),
        "ncamThreads": np.full(1, threads, i),
        "switchTime": np.float64(0),
        "version": " " * 120,
        "windowMode": "basic",
        "reconstructMode": "simple",
        "subapFlag": np.ones(n, i),
        "subapLocation": np.ascontiguousarray(np.column_stack([places, columns]), i),
        "pxlCnt": ((corners[:, 0] + ny) * w).astype(i),
        "calmult": np.ones(h * w, f),
        "calsub": np.full(h * w, dark_adu, f),
        "totVarMin": np.zeros(n, f),
        "tvmMaxIter": np.full(n, 24, i),
        "tvmPrecision": np.zeros(n, f),
        "cameraName": str(folder / "libsimulated.so"),
        "reconName": str(folder / "libsimulated.so"),
        "calibrateName": str(folder / "librtccalibrate.so"),
        "slopeName": str(folder / "librtcslope.so"),
    }
