"""What the tests of the engine share."""

from collections.abc import Iterator
from typing import Any
from uuid import uuid4

import pytest

from faintspot.engine.processes.segment import FOLDER

try:
    import pyshmem  # starts a process, which tests that are not slow may not do later
except ImportError:
    pyshmem = None


@pytest.fixture
def bench() -> Iterator[object]:
    pytest.importorskip("pyshmem")
    from tests.engine.bench import Bench

    with Bench() as bench:
        yield bench


@pytest.fixture
def sky() -> Iterator[object]:
    """A telescope with a name of its own, and the engines that follow it."""
    pytest.importorskip("hcipy")
    pytest.importorskip("pyshmem")
    from tests.engine.closed_loop import Sky

    made = Sky(f"fs_test_{uuid4().hex[:12]}")
    yield made
    made.close()


@pytest.fixture
def name() -> Iterator[str]:
    """A name of its own; what shared memory holds under it is removed."""
    chosen = f"fs_test_{uuid4().hex[:12]}"
    yield chosen
    for path in FOLDER.glob(f"{chosen}*"):
        path.unlink()
    if pyshmem is not None:
        for part in ("in", "slopes", "commands", "truth", "frames"):
            pyshmem.unlink_quiet(f"{chosen}_{part}")


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The configuration file of the simulated telescope, and its control; nobody writes there."""
    from tests.engine.closed_loop import configured

    return configured(tmp_path_factory.mktemp("bench"))
