"""Calls of user code that may never return."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import TypeVar

from faintspot.base.errors import InputError
from faintspot.slopes.estimators.faults import one_line

Result = TypeVar("Result")
_TRIAL = "faintspot-trial"


def call_within(limit_s: float, name: str, function: Callable[..., Result], *arguments: object) -> Result:
    """Call a function in a thread of its own and return what it returns.

    Parameters
    ----------
    limit_s : float
        Time limit; a call that exceeds it is abandoned and its thread asked to end, see `end_thread`.
    name : str
        Subject of the error message.

    Raises
    ------
    InputError
        When the time is over, or the function raises an exception that would end the process or the thread,
        such as SystemExit. Other exceptions are passed on.
    """
    replies: SimpleQueue[tuple[Result | None, BaseException | None]] = SimpleQueue()

    def work() -> None:
        try:
            replies.put((function(*arguments), None))
        except BaseException as error:  # pass any exception to the caller
            replies.put((None, error))

    thread = threading.Thread(target=work, name=_TRIAL, daemon=True)
    thread.start()
    try:
        result, error = replies.get(timeout=limit_s)
    except Empty:
        end_thread(thread)
        raise InputError(f"{name}: did not return within {limit_s:g} s") from None
    if isinstance(error, Exception):
        raise error
    if error is not None:
        raise InputError(f"{name}: {one_line(error)}")
    return result  # type: ignore[return-value]


def call_is_under_way() -> bool:
    """Return whether a `call_within` is running in this process: it may compile and delay other threads.

    An abandoned call counts until its thread has ended.
    """
    return any(thread.name == _TRIAL for thread in threading.enumerate())


def end_thread(thread: threading.Thread) -> None:
    """Ask an abandoned thread to end; Python code ends at its next step.

    Otherwise an endless loop would keep taking turns with all other threads. Compiled code is not
    interrupted.
    """
    if thread.ident is not None:
        identifier, exception = ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(identifier, exception)
