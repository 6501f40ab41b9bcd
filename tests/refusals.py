"""Refusals: errors of one line that name what was wrong."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from faintspot.base.errors import InputError


@contextmanager
def refused(*words: str) -> Iterator[None]:
    """Expect an InputError of one line that holds all these words."""
    with pytest.raises(InputError) as caught:
        yield
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message, message
