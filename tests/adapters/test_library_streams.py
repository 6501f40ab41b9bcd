"""The C program between two streams of ImageStreamIO: slopes and streams are those of Python."""

import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.adapters.library_cases import EXAMPLES, exported, frames_of, pipeline_of, run
from tests.engine.image_files import IsioFile
from tests.patience import LIMIT_S, wait_for

import faintspot as fs
from faintspot.adapters.library.folder import ExportedLibrary
from faintspot.adapters.library.objects import TARGETS, native_target
from faintspot.engine.streams.image_layout import METADATA, SEMAPHORES, path_of, places_of
from faintspot.engine.streams.image_stream import ImageStream, ImageStreamWriter

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler"),
]
_OF_ITS_WRITER = {"name", "creationtime", "lastaccesstime", "atime", "writetime", "creatorPID", "inode"}


@pytest.fixture(scope="module")
def pipeline() -> fs.SlopePipeline:
    return pipeline_of("brightest", TARGETS[native_target()].width)


@pytest.fixture(scope="module")
def library(pipeline: fs.SlopePipeline) -> ExportedLibrary:
    return exported(pipeline, "streams")


@pytest.fixture(scope="module")
def program(library: ExportedLibrary, tmp_path_factory: pytest.TempPathFactory) -> Path:
    built, folder = tmp_path_factory.mktemp("program") / "streams", library.bundle.parent
    flags = ("-g", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    link = (f"-I{folder}", f"-L{folder}", "-lfaintspot", f"-Wl,-rpath,{folder}")
    run("cc", *flags, EXAMPLES / "streams.c", "-o", built, *link)
    return built


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    monkeypatch.setenv("ASAN_OPTIONS", "detect_leaks=0")  # of programs that end with an error
    return tmp_path


@contextmanager
def started(*command: object) -> Iterator[tuple[subprocess.Popen[str], ImageStream]]:
    """The program, and the stream of its slopes."""
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([str(part) for part in command], **pipes) as process:
        try:
            wait_for(lambda: path_of("slopes").exists() or process.poll() is not None, process.communicate)
            yield process, ImageStream("slopes")
        finally:
            process.kill()


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    out, errors = process.communicate(timeout=LIMIT_S)
    return process.returncode, out, errors


def slopes_of(stream: ImageStream, count: int) -> NDArray[Any]:
    """The slopes of so many publications, when they are there."""
    assert stream.wait(count - 1, LIMIT_S)
    publication = stream.read(None, LIMIT_S)
    assert publication is not None
    assert publication.total == count
    return publication.values


def comparable(content: bytes) -> bytes:
    """The content of a stream without what differs from writer to writer."""
    own = bytearray(content)
    head = np.frombuffer(own, METADATA, 1)[0]
    places = places_of(head)
    for name in _OF_ITS_WRITER:
        head[name] = np.zeros((), METADATA[name])
    own[places.semaphores : places.semaphores + 4] = bytes(4)  # on which the test waits
    own[places.readers : places.writers + 4 * SEMAPHORES] = bytes(
        places.writers - places.readers + 4 * SEMAPHORES
    )
    return bytes(own)


def expected(pipeline: fs.SlopePipeline, frame: NDArray[Any]) -> NDArray[np.float32]:
    slopes = pipeline(frame)
    return np.concatenate([slopes.x, slopes.y])[None]


def test_slopes_of_uint16_are_those_of_python_in_a_stream_as_pythons(
    program: Path, library: ExportedLibrary, pipeline: fs.SlopePipeline, folder: Path
) -> None:
    frames = frames_of(pipeline, "uint16")
    file = IsioFile(folder / "wfs.im.shm", frames.shape[:0:-1], "u2")
    file.write(frames[0])  # before the program begins
    with started(program, library.bundle, "wfs", "slopes") as (process, stream):
        for count, frame in enumerate(frames, start=1):
            file.write(frame)
            assert slopes_of(stream, count).tobytes() == expected(pipeline, frame).tobytes()
        file.put(288, "B", 1)  # one that is never finished, then a whole one
        file.put(264, "Q", file.get(264, "Q") + 1)
        file.write(frames[0])
        slopes = slopes_of(stream, len(frames) + 1)
        assert slopes.tobytes() == expected(pipeline, frames[0]).tobytes()
        written = (folder / "slopes.im.shm").read_bytes()
        writer = ImageStreamWriter("python", (slopes.size,))
        for _ in range(stream.count):
            writer.publish(slopes, file.get(264, "Q") - 1)
        assert comparable(written) == comparable(writer.path.read_bytes())
        process.send_signal(signal.SIGTERM)
        assert ended(process) == (0, f"{len(frames) + 1} frames, 1 lost\n", "")
    assert not (folder / "slopes.im.shm").exists()
    assert file.get(file.readers, "i") == 0


def test_slopes_of_float32_by_polling(
    program: Path, library: ExportedLibrary, pipeline: fs.SlopePipeline, folder: Path
) -> None:
    frames = frames_of(pipeline, "float32")
    writer = ImageStreamWriter("wfs", frames.shape[1:])
    with started(program, library.bundle, "wfs", "slopes", "poll") as (process, stream):
        for count, frame in enumerate(frames, start=1):
            writer.publish(frame, count)
            assert slopes_of(stream, count).tobytes() == expected(pipeline, frame).tobytes()
        writer.close()  # the end of the stream ends the program, too
        assert ended(process)[::2] == (1, "streams: wfs: was removed or created again\n")
    assert not (folder / "slopes.im.shm").exists()


@pytest.mark.parametrize(
    "case", ["size", "type", "version", "cut", "missing", "no stream", "readers", "taken"]
)
def test_streams_that_do_not_fit_are_refused(
    case: str, program: Path, library: ExportedLibrary, pipeline: fs.SlopePipeline, folder: Path
) -> None:
    height, width = pipeline.layout.frame_shape
    sizes = (width + 1, height) if case == "size" else (width, height)
    changes = {"version": b"1.00"} if case == "version" else {}
    file = IsioFile(folder / "wfs.im.shm", sizes, "f8" if case == "type" else "u2", **changes)
    if case == "cut":
        (folder / "wfs.im.shm").write_bytes(file.memory[:-8])
    if case == "missing":
        (folder / "wfs.im.shm").unlink()
    if case == "no stream":
        (folder / "slopes.im.shm").write_text("something else")
    if case == "readers":
        for number in range(10):
            file.put(file.readers + 4 * number, "i", 1)
    if case == "taken":
        ImageStreamWriter("slopes", (3,))
    before = sorted(path.read_bytes() for path in folder.glob("slopes*"))
    done = subprocess.run(
        [program, library.bundle, "wfs", "slopes"], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
    assert done.stderr.startswith("streams: slopes: " if case in ("no stream", "taken") else "streams: wfs: ")
    assert sorted(path.read_bytes() for path in folder.glob("slopes*")) == before
