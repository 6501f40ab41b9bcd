"""Refusals: errors of one line that name what was wrong."""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from faintspot.base.errors import InputError


@contextmanager
def refused(*words: str, match: str | None = None) -> Iterator[None]:
    """Expect an InputError of one line that holds all these words and matches a pattern."""
    with pytest.raises(InputError, match=match) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message


def assert_each_refused(call: Callable[..., Any], **values: Iterable[Any]) -> None:
    """Expect that a call refuses each value of each argument, in one line that names it, and any number."""
    for name, each in values.items():
        for value in each:
            is_number = isinstance(value, int | float) and math.isfinite(value)
            try:
                with refused(name, f"{value:g}" if is_number else ""):
                    call(**{name: value})
            except (AssertionError, pytest.fail.Exception) as error:
                raise AssertionError(f"{name} = {value!r}: {error}") from error


def refused_in_one_line(call: Callable[[], Any]) -> Any:
    """Return what a call returns, or None where it refuses with an InputError in one line."""
    try:
        return call()
    except InputError as error:
        message = str(error)
    if not message or "\n" in message:
        raise AssertionError(f"expected one line, got {message!r}")
    return None
