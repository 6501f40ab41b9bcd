"""Errors of estimators of others: whatever their code raises becomes one line that names them."""

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
    """Turn whatever code of others raises into an `InputError` of one line.

    That includes SystemExit, and a KeyboardInterrupt that the code raises. Ctrl-C stays what it is.

    Parameters
    ----------
    title : str
        Whose code it is; the message begins with it.
    file : str, optional
        Source file of that code; the message says in which of its lines the error was raised.

    Raises
    ------
    InputError
        For any error.
    """
    interrupts: list[int] = []
    former: Any = signal.getsignal(signal.SIGINT)
    # Only the main thread gets signals, and may say how they are handled.
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
    """Return an error's name and text in one line of bounded length; of an `InputError` the text alone."""
    text = " ".join(str(error).split())[:_LONGEST]
    return text if isinstance(error, InputError) else f"{type(error).__name__}: {text}".removesuffix(": ")


def _line_of(error: BaseException, file: str | None) -> str:
    """Return the last line of a file on the way to where an error was raised."""
    line, trace = None, error.__traceback__
    while trace is not None:
        line = trace.tb_lineno if trace.tb_frame.f_code.co_filename == file else line
        trace = trace.tb_next
    return "" if line is None else f" (line {line})"
