"""Errors raised by third-party estimators, converted to one line that names the estimator."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

from faintspot.base.errors import InputError

_LONGEST = 300


@contextlib.contextmanager
def faults_of(title: str, file: str | None = None) -> Iterator[None]:
    """Convert any exception raised by third-party code to a one-line `InputError`.

    This includes SystemExit, and a KeyboardInterrupt that the code itself raises. Ctrl-C still interrupts.

    Parameters
    ----------
    title : str
        Name of the code; the message begins with it.
    file : str, optional
        Source file of the code; the message states the line in which the error was raised.

    Raises
    ------
    InputError
        For any exception.
    """
    interrupts: list[int] = []
    former: Any = signal.getsignal(signal.SIGINT)
    # Only the main thread receives signals and may change their handlers.
    watched = threading.current_thread() is threading.main_thread() and callable(former)

    def note(number: int, frame: FrameType | None) -> None:
        interrupts.append(number)
        former(number, frame)

    if watched:
        signal.signal(signal.SIGINT, note)
    try:
        yield
    except BaseException as error:
        if interrupts:
            raise KeyboardInterrupt from None
        raise InputError(f"{title}{_line_of(error, file)}: {one_line(error)}") from None
    finally:
        if watched:
            signal.signal(signal.SIGINT, former)


def one_line(error: BaseException) -> str:
    """Return an error's name and text in one line of limited length; of an `InputError` the text alone."""
    text = " ".join(str(error).split())[:_LONGEST]
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}".removesuffix(": ")


def _line_of(error: BaseException, file: str | None) -> str:
    """Return the last line of `file` in the error's traceback, as text."""
    line, trace = None, error.__traceback__
    while trace is not None:
        line = trace.tb_lineno if trace.tb_frame.f_code.co_filename == file else line
        trace = trace.tb_next
    return "" if line is None else f" (line {line})"
