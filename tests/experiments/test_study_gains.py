from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("xarray")

from faintspot.experiments import StudySpecification, Sweep, WorkerPool, run
from faintspot.experiments.paper.tables import gains_by_mode


def test_gains_of_every_mode_and_none_where_there_is_no_crossing() -> None:
    sweeps = [
        Sweep("bright", flux_e=(20, 60, 200)),
        Sweep("dark", flux_e=(10, 12), read_noise_e=(16,)),  # never reaches 0.15 px
    ]
    dataset = run(
        StudySpecification(
            "gains", sweeps, realisations=600, estimators=("brightest", "tv"), fixed_k=(20, 40)
        ),
        pool=WorkerPool(0),
    )
    table = gains_by_mode(dataset)
    assert [configuration.read_noise_e for configuration in table] == [0.1]
    (gains,) = table.values()
    assert set(gains) == {"best", "fixed20", "fixed40"}
    best, fixed = gains["best"], gains["fixed40"]
    assert best is not None
    assert fixed is not None
    # 10,000 spots give 1.24 and 1.77; 300 scored spots at each flux leave errors of about 10 %.
    assert best.factor == pytest.approx(1.24, rel=0.4)
    assert fixed.factor > best.factor
    assert np.isfinite(fixed.in_magnitudes.value)
