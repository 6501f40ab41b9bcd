"""What the tests of the engine share."""

from __future__ import annotations

from collections.abc import Iterator
from uuid import uuid4

import pytest


@pytest.fixture
def bench() -> Iterator[object]:
    pytest.importorskip("pyshmem")
    from tests.realtime.bench import Bench

    bench = Bench()
    yield bench
    bench.close()


@pytest.fixture
def sky() -> Iterator[object]:
    """A telescope with a name of its own, and the engines that follow it."""
    pytest.importorskip("hcipy")
    pytest.importorskip("pyshmem")
    from tests.realtime.closed_loop import Sky

    made = Sky(f"fs_test_{uuid4().hex[:12]}")
    yield made
    made.close()
