"""An estimator in NumPy runs in the engine: its slopes are those of the pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
from tests.realtime.bench import SETTINGS, Bench, make, simulated

from faintspot.estimators import Estimator, option, register
from faintspot.estimators.registry import _kinds

pytest.importorskip("pyshmem")


@dataclass(frozen=True, eq=False, kw_only=True)
class Peak(Estimator):
    """The brightest pixel, drawn towards the middle."""

    share: Any = option(1.0, "How much of the way.", low=0.0, high=1.0, per_subaperture=False)

    name: ClassVar[str] = "peak_in_numpy"
    label: ClassVar[str] = "brightest pixel"

    def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
        n, ny, nx = images.shape
        row, column = np.divmod(images.reshape(n, -1).argmax(axis=1), nx)
        return self.share * np.column_stack([column - (nx - 1) / 2, row - (ny - 1) / 2])


@pytest.fixture
def known() -> Iterator[None]:
    register(Peak)
    yield
    _kinds.pop(Peak.name)


@pytest.mark.usefixtures("known")
def test_set_while_the_engine_runs() -> None:
    data = simulated(4)
    settings = SETTINGS.replace(estimator=Peak(share=0.5))
    # However long NumPy takes on a disturbed machine.
    bench = Bench(deadline_s=5.0)
    try:
        with bench.ring() as ring:
            bench.attached()
            bench.send(ring, 0, data[0])
            bench.engine.live.propose({"estimator": Peak.name, "share": 0.5})
            for number in (1, 2, 3):
                bench.send(ring, number, data[number])
    finally:
        bench.close()
    slopes = bench.slopes
    for number in (2, 3):  # frame 1 was waited for already
        np.testing.assert_array_equal(slopes[number], make(settings)(data[number]).vector)
