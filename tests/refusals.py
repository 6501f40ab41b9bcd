"""Refusals: errors of one line that name what was wrong, one by one and in tables."""

import math
import re
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


def refusal(call: Callable[[], object]) -> str:
    """Return the message with which a call refuses, which is empty where it does not."""
    try:
        call()
    except InputError as error:
        return str(error)
    return ""


def assert_all_refused(rows: Iterable[tuple[Any, tuple[str, ...]]], message_of: Callable[[Any], str]) -> None:
    """Expect that what is given in each row is refused: in one line that has the row's names and values.

    Besides those, the line has words: what was expected, or what to do. All rows that fail are reported.
    """
    faults = []
    for given, names in rows:
        try:
            message = rest = message_of(given)
        except Exception as error:
            faults.append(f"{given!r:.120}: {type(error).__name__} {error}")
            continue
        for name in sorted(names, key=len, reverse=True):
            rest = rest.replace(name, "")
        says_more = len(re.findall(r"[A-Za-z]{2,}", rest)) > 1
        if "\n" in message or not says_more or any(name not in message for name in names):
            faults.append(f"{given!r:.120}: expected a line with {names} and what to do, got {message!r}")
    assert not faults, "\n".join(faults)


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
