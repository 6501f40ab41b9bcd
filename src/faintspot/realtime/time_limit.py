"""Calling code of others that may never come back."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from faintspot.base.errors import InputError
from faintspot.estimators.faults import one_line

Result = TypeVar("Result")
_TRIAL = "faintspot-trial"


def call_within(limit_s: float, what: str, function: Callable[..., Result], *arguments: Any) -> Result:
    """Call a function in a thread of its own and return what it returns.

    Parameters
    ----------
    limit_s : float
        After so long it is given up; its thread is asked to end, see `end_thread`.
    what : str
        Of whom the error speaks.

    Raises
    ------
    InputError
        When the time is over, or the function raises what would end the process or the calling thread, such
        as SystemExit. Other exceptions are raised here as they are.
    """
    replies: SimpleQueue[tuple[Result | None, BaseException | None]] = SimpleQueue()

    def work() -> None:
        try:
            replies.put((function(*arguments), None))
        except BaseException as error:  # whatever it is, it belongs to the caller
            replies.put((None, error))

    thread = threading.Thread(target=work, name=_TRIAL, daemon=True)
    thread.start()
    try:
        result, error = replies.get(timeout=limit_s)
    except Empty:
        end_thread(thread)
        raise InputError(f"{what}: did not return within {limit_s:g} s") from None
    if isinstance(error, Exception):
        raise error
    if error is not None:
        raise InputError(f"{what}: {one_line(error)}")
    return result  # type: ignore[return-value]


def call_is_under_way() -> bool:
    """Return whether a `call_within` is under way in this process: it may compile, and hold up other threads.

    One that was given up counts until its thread has ended.
    """
    return any(thread.name == _TRIAL for thread in threading.enumerate())


def end_thread(thread: threading.Thread) -> None:
    """Ask a thread that is given up to end: Python code there is left at its next step.

    Else an endless loop would go on to take turns with all other threads. Compiled code does not notice.
    """
    if thread.ident is not None:
        identifier, exception = ctypes.c_ulong(thread.ident), ctypes.py_object(SystemExit)
        ctypes.pythonapi.PyThreadState_SetAsyncExc(identifier, exception)
