"""What the tests of the engine share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture
def bench() -> Iterator[object]:
    pytest.importorskip("pyshmem")
    from tests.realtime.bench import Bench

    bench = Bench()
    yield bench
    bench.close()
