"""The store of a study: whole cells or none, and nobody else's."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.study_runs import N_CELLS, SPECIFICATION, assert_identical

from faintspot import InputError
from faintspot.experiments import StudySpecification, measure_cell, open_study

pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")

from faintspot.experiments.study.run import VARIABLES, dataset_of, new_dataset, stored_units  # noqa: E402

OTHER = replace(SPECIFICATION, seed=2)


def test_schema() -> None:
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
    assert_identical(open_study(path), dataset_of(SPECIFICATION, memory))
    for index in (2, 0):
        results = measure_cell(SPECIFICATION.cells()[index], SPECIFICATION)
        stored[str(index)] = memory[str(index)] = results
    assert_identical(open_study(path), dataset_of(SPECIFICATION, memory))
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


def test_what_belongs_to_others_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    stored_units(SPECIFICATION, path)
    with pytest.raises(InputError, match=r"s\.zarr: belongs to another study \('small'"):
        stored_units(OTHER, path)
    stored_units(OTHER, path, overwrite=True)
    assert open_study(path).attrs["fingerprint"] == OTHER.fingerprint
    folder = tmp_path / "folder"
    folder.mkdir()
    for wrong, found in ((folder, "something else"), (tmp_path / "nothing", "nothing")):
        with pytest.raises(InputError, match=f"found {found}"):
            open_study(wrong)


def test_of_another_version(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    stored_units(SPECIFICATION, path)
    shutil.rmtree(path / "gain")
    with pytest.raises(InputError, match="has no gain: measured by another version"):
        open_study(path)
