"""Runs give the same results whoever does the work, in whatever order, however often they are interrupted."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import assert_same_files
from tests.refusals import refused

from faintspot import experiments
from faintspot.experiments import StudySpecification, Sweep, WorkerPool, measure_cell, open_study

pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")

from faintspot.experiments.study.run import (  # noqa: E402
    VARIABLES,
    dataset_of,
    new_dataset,
    stored_units,
)

SPECIFICATION = StudySpecification(
    "small",
    [
        Sweep("flux", flux_e=[10, 30, 100, 300], pixels=[6, 8]),
        Sweep("noise", read_noise_e=[0.1, 3], pixels=8),
    ],
    realisations=200,
    fixed_k=(10, 40),
)
N_CELLS = 9  # 100 e- and 0.1 e- on 8 x 8 pixels is in both sweeps


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("study") / "whole.zarr"
    experiments.run(SPECIFICATION, path, pool=WorkerPool(0))
    return path


def counting(counts: list[tuple[int, ...]]) -> WorkerPool:
    return WorkerPool(0, lambda *count: counts.append(count))


@pytest.mark.slow
def test_study_in_memory_equals_the_stored_one(uninterrupted: Path) -> None:
    counts: list[tuple[int, ...]] = []
    result = experiments.run(SPECIFICATION, pool=counting(counts))
    assert counts == [(i, N_CELLS) for i in range(N_CELLS + 1)]
    assert result["done"].all()
    xarray.testing.assert_identical(result, experiments.open_study(uninterrupted))


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
    assert_same_files(path, uninterrupted)
    experiments.run(SPECIFICATION, path, pool=counting(counts))
    assert len(counts) == N_CELLS - 4 + 1  # a complete study tells nothing


@pytest.mark.slow
def test_other_cells_do_not_matter(uninterrupted: Path) -> None:
    whole = experiments.open_study(uninterrupted)
    sweep = Sweep("one", flux_e=[300, 30], pixels=8)
    part = experiments.run(replace(SPECIFICATION, sweeps=[sweep]), pool=WorkerPool(0))
    for cell in range(2):
        chosen = (whole["flux_e"] == part["flux_e"][cell]) & (whole["pixels"] == 8)
        chosen &= whole["read_noise_e"] == 0.1
        same = whole.isel(cell=np.flatnonzero(chosen)[0])
        for name in VARIABLES:
            np.testing.assert_array_equal(part[name][cell], same[name], err_msg=name)


def test_study_refuses_wrong_arguments() -> None:
    with refused("expected a StudySpecification"):
        experiments.run("mine.toml")  # type: ignore[arg-type]


def test_a_new_dataset_has_all_variables() -> None:
    dataset = new_dataset(SPECIFICATION)
    assert dict(dataset.sizes) == {"cell": N_CELLS, "estimator": 4, "estimator2": 4, "mode": 3, "k": 63}
    assert set(dataset.data_vars) == {*VARIABLES, "done"}
    assert dataset["gain"].dims == ("cell", "estimator", "mode")
    assert dataset["stated_over_actual"].dims == ("cell", "estimator")
    assert dataset["bound"].dims == ("cell",)
    assert dataset["error_covariance"].dims == ("cell", "mode", "estimator", "estimator2")
    assert dataset["error_at_k"].dims == ("cell", "estimator", "k")
    for name in VARIABLES:
        assert dataset[name].attrs["units"]
        assert np.isnan(dataset[name]).all()
    assert not dataset["done"].any()
    assert dataset["flux_e"].attrs["units"] == "electron"
    assert dataset["pixels"].dtype.kind == "i"
    assert list(dataset["mode"].values) == ["best", "fixed10", "fixed40"]
    assert StudySpecification.from_text(dataset.attrs["specification"]) == SPECIFICATION
    assert (dataset.attrs["seed"], dataset.attrs["n"]) == (1, 200)


def test_store_is_memory(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    stored, memory = stored_units(SPECIFICATION, path), dict[str, Any]()
    xarray.testing.assert_identical(open_study(path), dataset_of(SPECIFICATION, memory))
    for index in (2, 0):
        results = measure_cell(SPECIFICATION.cells()[index], SPECIFICATION)
        stored[str(index)] = memory[str(index)] = results
    xarray.testing.assert_identical(open_study(path), dataset_of(SPECIFICATION, memory))
    assert [index for index in range(N_CELLS) if str(index) in stored] == [0, 2]
    # One chunk a cell and variable.
    assert sorted(p.name for p in (path / "error" / "c").iterdir()) == ["0", "2"]
    # A window of 6 x 6 pixels has no more than 35 k.
    small = dataset_of(SPECIFICATION, memory).isel(cell=0)
    assert int(small["pixels"]) == 6
    assert np.isfinite(small["error_at_k"].sel(estimator="brightest", k=slice(1, 35))).all()
    assert np.isnan(small["error_at_k"].sel(k=slice(36, None))).all()
    opened = xarray.open_zarr(path, consolidated=False)
    np.testing.assert_array_equal(opened["error"], dataset_of(SPECIFICATION, memory)["error"])


@pytest.mark.slow
def test_what_is_no_study_of_this_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    for wrong, found in (("folder", "something else"), ("nothing", "nothing")):
        with refused(f"found {found}"):
            open_study(tmp_path / wrong)
    path, other = tmp_path / "s.zarr", replace(SPECIFICATION, seed=2)
    stored_units(SPECIFICATION, path)
    with refused("s.zarr: belongs to another study ('small'"):
        stored_units(other, path)
    stored_units(other, path, overwrite=True)
    assert open_study(path).attrs["fingerprint"] == other.fingerprint
    shutil.rmtree(path / "gain")
    with refused("has no gain: measured by another version"):
        open_study(path)
