"""A module's function in a process of its own: a crash, an exit or an endless loop there is one line here.

Images go there, and results back, through memory that only the two processes have; short messages say when.
The process is given the layout and settings when it starts, and serves one function. It ends when that is not
needed any more, and when this process ends, whatever it is doing.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import mmap
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
import weakref
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.realtime.modular import check_result, result_shape
from faintspot.realtime.module_loading import Module, StageFunction, is_path, load_module, read_module
from faintspot.realtime.time_limit import one_line
from faintspot.realtime.trial_process import pickled, program
from faintspot.sensor.layout import Layout
from faintspot.settings import Settings

_LOOK_S = 0.1  # between looks at whether this thread is to end
_ENDING_S = 5.0  # for a process that is ending to say how
_LONGEST_MESSAGE = 2000
_GO, _FAILED = b"+", b"-"


@dataclass(frozen=True)
class _Job:
    """What the process is to do: the module, its file's text, and what its function is made for."""

    source: str
    text: bytes | None
    digest: str
    layout: Layout
    settings: Settings


def isolated(name_or_path: str, about: Mapping[str, str]) -> Module:
    """Return a module each of whose functions runs in a process of its own; nothing of it runs in this one.

    Parameters
    ----------
    name_or_path : str
        As of `load_module`. A file's text is kept as it is now.
    about : mapping
        What a trial in another process has found out: name, stage, source, digest.

    Raises
    ------
    InputError
        When a file cannot be read.
    """
    text = read_module(Path(name_or_path)) if is_path(name_or_path) else None

    def make(layout: Layout, settings: Settings) -> StageFunction:
        return _Elsewhere(about["stage"], _Job(name_or_path, text, about["digest"], layout, settings))

    return Module(**about, make=make, isolated=True)


class _Elsewhere:
    """A stage's function whose work another process does."""

    def __init__(self, stage: str, job: _Job) -> None:
        memory = os.memfd_create("faintspot-module")
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        lifeline, ours = os.pipe()
        try:
            self._images, self._results = _arrays(memory, stage, job.layout, reserve=True)
            handed = [theirs.fileno(), lifeline, memory]
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", program(__name__), stage, *map(str, handed)],
                stdin=subprocess.PIPE,
                pass_fds=handed,
                start_new_session=True,  # Ctrl-C ends the engine, and that ends it
            )
        except OSError as error:
            os.close(ours)
            raise InputError(f"no process for it ({error.strerror or error})") from None
        finally:
            theirs.close()
            os.close(lifeline)
            os.close(memory)
        self._end = weakref.finalize(self, _end, self._process, self._channel, ours)
        self._channel.settimeout(_LOOK_S)
        assert self._process.stdin is not None
        with contextlib.suppress(OSError), self._process.stdin as stdin:  # if it has ended, `_answer` says so
            stdin.write(pickled(sys.path) + pickled(job))
        self._answer()

    def __call__(self, images: NDArray[np.float32]) -> NDArray[np.float32]:
        """Have images (n, ny, nx) worked on; the result is overwritten by the next call.

        Raises
        ------
        InputError
            When the module fails or its process has ended.
        """
        self._images[...] = images
        with contextlib.suppress(OSError):  # likewise
            self._channel.send(_GO)
        self._answer()
        return self._results

    def _answer(self) -> None:
        try:
            answer = self._received()
        except BaseException:  # also where this thread is given up, see `end_thread`
            self._end()
            raise
        if not answer:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_ENDING_S)
            self._end()
            code = self._process.returncode
            how = f"crashed ({signal.Signals(-code).name})" if code < 0 else f"ended (exit status {code})"
            raise InputError(f"its process has {how}")
        if answer[:1] == _FAILED:
            raise InputError(answer[1:].decode(errors="replace"))

    def _received(self) -> bytes:
        while True:
            try:
                return self._channel.recv(_LONGEST_MESSAGE)
            except TimeoutError:
                continue
            except OSError:  # it has ended before
                return b""


def _end(process: subprocess.Popen[bytes], channel: socket.socket, lifeline: int) -> None:
    """End a process and let go of what leads to it."""
    channel.close()
    os.close(lifeline)
    process.kill()
    process.wait()


def _arrays(
    memory: int, stage: str, layout: Layout, *, reserve: bool = False
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the images and the results in memory that two processes share."""
    shape = (len(layout), *layout.window)
    size = 4 * math.prod(shape)
    if reserve:
        os.posix_fallocate(memory, 0, 2 * size)  # else writing where there is no room kills the process
    mapped = mmap.mmap(memory, 2 * size)
    results = np.ndarray(result_shape(stage, layout), np.float32, mapped, size)
    return np.ndarray(shape, np.float32, mapped), results


# In the other process -------------------------------------------------------------------------------------


def main() -> None:
    """Serve a module's function until nobody wants it any more; the process's whole life."""
    stage = sys.argv[1]
    channel_number, lifeline, memory = (int(number) for number in sys.argv[2:])
    # SIGIO, which comes when the other end of this pipe is closed, ends the process even in compiled code.
    fcntl.fcntl(lifeline, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(lifeline, fcntl.F_SETFL, os.O_ASYNC)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # a crash leaves no file behind
    with contextlib.suppress(OSError, AttributeError):  # no real-time priority, as in `modular_path`
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    job: _Job = pickle.load(sys.stdin.buffer)
    channel = socket.socket(fileno=channel_number)
    images, results = _arrays(memory, stage, job.layout)
    with _answered(channel):
        function = _function(job)
    while channel.recv(1):
        with _answered(channel), np.errstate(all="ignore"):
            result = function(images)
            check_result(result, results.shape)
            results[...] = result
    os._exit(0)  # whatever threads the module has begun


@contextlib.contextmanager
def _answered(channel: socket.socket) -> Iterator[None]:
    """Say how it went; also what would end the process is an error of the module."""
    try:
        yield
    except BaseException as error:
        channel.send(_FAILED + one_line(error).encode()[: _LONGEST_MESSAGE - 1])
    else:
        channel.send(_GO)


def _function(job: _Job) -> Any:
    module = load_module(job.source, job.text)
    if module.digest != job.digest:
        raise InputError("it was changed since it was tried; load it again")
    function = module.make(job.layout, job.settings)
    if not callable(function):
        raise InputError(f"expected that it returns a function, got {type(function).__name__}")
    return function
