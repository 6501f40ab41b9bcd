"""Runs give the same results whoever does the work, in whatever order, however often they are interrupted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.study_runs import N_CELLS, SPECIFICATION, assert_identical, assert_same

from faintspot import InputError, experiments
from faintspot.experiments import WorkerPool
from faintspot.experiments.study.run import VARIABLES

pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "whole.zarr"
    experiments.run(SPECIFICATION, path, pool=WorkerPool(0))
    return path


def counting(counts: list[tuple[int, ...]]) -> WorkerPool:
    return WorkerPool(0, lambda *count: counts.append(count))


@pytest.mark.slow
def test_in_memory(uninterrupted: Path) -> None:
    counts: list[tuple[int, ...]] = []
    result = experiments.run(SPECIFICATION, pool=counting(counts))
    assert counts == [(i, N_CELLS) for i in range(N_CELLS + 1)]
    assert result["done"].all()
    assert_identical(result, experiments.open_study(uninterrupted))


@pytest.mark.slow
def test_interrupted_and_started_again(tmp_path: Path, uninterrupted: Path) -> None:
    path = tmp_path / "s.zarr"

    def stop(finished: int, total: int) -> None:
        if finished == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        experiments.run(SPECIFICATION, path, pool=WorkerPool(0, stop))
    assert int(experiments.open_study(path)["done"].sum()) == 4
    counts: list[tuple[int, ...]] = []
    experiments.run(SPECIFICATION, path, pool=counting(counts))
    assert counts == [(finished, N_CELLS) for finished in range(4, N_CELLS + 1)]
    assert_same(path, uninterrupted)
    experiments.run(SPECIFICATION, path, pool=counting(counts))
    assert len(counts) == N_CELLS - 4 + 1  # a complete study tells nothing


def test_other_cells_do_not_matter(uninterrupted: Path) -> None:
    whole = experiments.open_study(uninterrupted)
    sweep = experiments.Sweep("one", flux_e=[300, 30], pixels=8)
    part = experiments.run(replace(SPECIFICATION, sweeps=[sweep]), pool=WorkerPool(0))
    for cell in range(2):
        chosen = (whole["flux_e"] == part["flux_e"][cell]) & (whole["pixels"] == 8)
        chosen &= whole["read_noise_e"] == 0.1
        same = whole.isel(cell=np.flatnonzero(chosen)[0])
        for name in VARIABLES:
            np.testing.assert_array_equal(part[name][cell], same[name], err_msg=name)


def test_bad_arguments() -> None:
    with pytest.raises(InputError, match="workers = -1"):
        experiments.run(SPECIFICATION, pool=WorkerPool(-1))
    with pytest.raises(InputError, match="expected a StudySpecification"):
        experiments.run("mine.toml")  # type: ignore[arg-type]
