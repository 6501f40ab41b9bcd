"""How long tests wait for other processes and threads."""

import time
from typing import Any

LIMIT_S = 60.0
"""How long to wait for what must come."""


def wait_for(condition: Any, what: object = "", step: Any = lambda: time.sleep(0.001)) -> None:
    """Wait until something is so, or take steps until it is; fail after `LIMIT_S`."""
    end = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end, what() if callable(what) else what
        step()
