"""Runs give the same results whoever does the work, in whatever order, however often they are interrupted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.study.study_runs import N_CELLS, SPECIFICATION, assert_identical, assert_same

from faintspot import InputError, study
from faintspot.study import running
from faintspot.study.cell import score_cell

pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "whole.zarr"
    study.run(SPECIFICATION, path, workers=0)
    return path


def test_in_memory(uninterrupted: Path) -> None:
    counts = []
    result = study.run(SPECIFICATION, workers=0, progress=lambda *count: counts.append(count))
    assert counts == [(i, N_CELLS) for i in range(N_CELLS + 1)]
    assert result["done"].all()
    assert_identical(result, study.open_study(uninterrupted))


def test_interrupted_and_started_again(tmp_path: Path, uninterrupted: Path) -> None:
    path = tmp_path / "s.zarr"

    def stop(finished: int, total: int) -> None:
        if finished == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study.run(SPECIFICATION, path, progress=stop, workers=0)
    assert int(study.open_study(path)["done"].sum()) == 4
    counts = []
    study.run(SPECIFICATION, path, workers=0, progress=lambda *count: counts.append(count))
    assert counts[-1] == (N_CELLS - 4, N_CELLS - 4)
    assert_same(path, uninterrupted)
    study.run(SPECIFICATION, path, workers=0, progress=lambda *count: counts.append(count))
    assert len(counts) == N_CELLS - 4 + 1


def test_other_cells_do_not_matter(uninterrupted: Path) -> None:
    whole = study.open_study(uninterrupted)
    sweep = study.Sweep("one", flux_e=[300, 30], pixels=8)
    part = study.run(replace(SPECIFICATION, sweeps=[sweep]), workers=0)
    for cell in range(2):
        chosen = (whole["flux_e"] == part["flux_e"][cell]) & (whole["pixels"] == 8)
        chosen &= whole["read_noise_e"] == 0.1
        same = whole.isel(cell=np.flatnonzero(chosen)[0])
        for name in study.store.VARIABLES:
            np.testing.assert_array_equal(part[name][cell], same[name], err_msg=name)


def test_processes(uninterrupted: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    study.run(SPECIFICATION, tmp_path / "s.zarr", workers=1, announce=lines.append)
    assert_same(tmp_path / "s.zarr", uninterrupted)
    assert lines == ["1 process on this machine"]


def test_bad_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("faintspot.compare.running._CONNECT_TIMEOUT_S", 0.3)
    with pytest.raises(InputError, match=r"scheduler = .*cannot be reached"):
        study.run(SPECIFICATION, scheduler="tcp://127.0.0.1:1")
    with pytest.raises(InputError, match="workers = -1"):
        study.run(SPECIFICATION, workers=-1)
    with pytest.raises(InputError, match="expected a StudySpecification"):
        study.run("mine.toml", workers=0)  # type: ignore[arg-type]


ON_GPU = replace(SPECIFICATION, device="cuda")


def test_no_gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from numba import cuda

    monkeypatch.setattr(cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="no NVIDIA GPU") as raised:
        study.run(ON_GPU, tmp_path / "s.zarr")
    assert "\n" not in str(raised.value)
    assert not (tmp_path / "s.zarr").exists()


@pytest.mark.parametrize(
    ("specification", "scheduler", "message"),
    [
        (ON_GPU, "tcp://host:8786", "works on this machine's GPU, not on a cluster"),
        (replace(ON_GPU, sweeps=[study.Sweep("a", pixels=40)]), None, "window of 40 x 40 pixels"),
    ],
)
def test_what_a_gpu_cannot_do(
    specification: study.StudySpecification, scheduler: str | None, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        study.run(specification, scheduler=scheduler)


@pytest.mark.parametrize("workers", [0, 2])
def test_statistics_of_a_gpu_are_worked_out_beside_it(workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In other processes or here: the numbers are the same. The CPU stands in for the GPU."""

    def score_on_cpu(cell: study.Cell, specification: study.StudySpecification) -> Any:
        return score_cell(cell, replace(specification, device="cpu"))

    monkeypatch.setattr(running, "score_cell", score_on_cpu)
    monkeypatch.setattr(running, "_check_device", lambda specification, scheduler: None)
    few = replace(ON_GPU, sweeps=[study.Sweep("a", flux_e=[30, 100, 300], pixels=8)], realisations=40)
    announced: list[str] = []
    found = study.run(few, workers=workers, announce=announced.append)
    expected = study.run(replace(few, device="cpu"), workers=0)
    for name in study.store.VARIABLES:
        np.testing.assert_array_equal(found[name], expected[name], err_msg=name)
    assert len(announced) == (workers > 0)
