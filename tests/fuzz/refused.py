"""What everything at the door does with what it cannot use."""

from collections.abc import Callable
from typing import Any

from faintspot.base.errors import InputError


def refused_in_one_line(call: Callable[[], Any]) -> Any:
    """Return what a call returns, or None where it refuses with an InputError in one line."""
    try:
        return call()
    except InputError as error:
        message = str(error)
    if not message or "\n" in message:
        raise AssertionError(f"expected one line, got {message!r}")
    return None
