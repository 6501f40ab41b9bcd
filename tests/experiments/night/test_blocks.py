from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.night_cases import night_with

from faintspot.base.errors import InputError
from faintspot.experiments.night.blocks import Night, load_night


def test_a_night_is_read_as_it_was_written(tmp_path: Path) -> None:
    night = night_with()
    night.save(tmp_path / "night.zarr")
    night.save(tmp_path / "night.zarr")  # over itself
    again = load_night(tmp_path / "night.zarr")
    for item in fields(Night):
        before, after = getattr(night, item.name), getattr(again, item.name)
        if isinstance(before, np.ndarray):
            np.testing.assert_array_equal(after, before)
            assert after.dtype == before.dtype
        else:
            assert after == before


def test_xarray_opens_the_store(tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    night = night_with()
    night.save(tmp_path / "night.zarr")
    dataset = xarray.open_zarr(tmp_path / "night.zarr", chunks=None, consolidated=False)
    assert dict(dataset.sizes) == {"block": len(night.strehl)}
    np.testing.assert_array_equal(dataset["strehl"].values, night.strehl)
    assert dataset.attrs["labels"] == list(night.labels)


def test_anything_else_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no store")
    with pytest.raises(InputError, match="cannot be read as a night"):
        load_night(tmp_path / "file")
    zarr = pytest.importorskip("zarr")
    zarr.create_group(str(tmp_path / "other.zarr"), zarr_format=3)
    with pytest.raises(InputError, match="expected a night of format 1"):
        load_night(tmp_path / "other.zarr")


def test_cycles_begin_with_the_reference_and_with_sets() -> None:
    night = night_with()
    rows = np.flatnonzero(night.set_number < 2)
    cycle = night.cycle[rows]
    assert cycle.max() == 5  # 4 of the first set, 2 of the second
    first = np.flatnonzero(np.diff(cycle, prepend=-1))
    assert (night.method[rows][first] == night.reference).all()
    moved = replace(night, method=np.where(np.arange(len(night.strehl)) == 0, 1, night.method))
    assert moved.cycle[0] == 0  # a set that does not begin with the reference


def test_hours_include_settling() -> None:
    night = night_with()
    assert night.hours == pytest.approx(len(night.strehl) * 2.4 / 3600)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"strehl": np.zeros(3)}, "strehl: expected a value for each"),
        ({"reference": 99}, "reference: expected 0 to"),
        ({"labels": ("one",)}, "method: expected numbers from 0 to 0"),
        ({"set_names": ("one",)}, "set_number: expected numbers from 0 to 0"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        replace(night_with(), **changes)  # type: ignore[arg-type]
