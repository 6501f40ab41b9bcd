from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from faintspot.errors import InputError
from faintspot.loop.running import Unit, UnitStore, Workplace, run_units

UNITS = [Unit(f"unit {number}", (number,), 10) for number in range(4)]


def double(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    advance(5)
    advance(50)  # more than was expected
    return {"twice": np.asarray(2 * number)}


def never(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    raise AssertionError


def impossible(number: int, advance: Callable[[int], None]) -> dict[str, NDArray[Any]]:
    raise InputError(f"number = {number}: refused")


def test_units_are_run_once(tmp_path: Path) -> None:
    counts: list[tuple[int, int]] = []
    place = Workplace(workers=0, progress=lambda *count: counts.append(count))
    results = run_units(double, UNITS, UnitStore(tmp_path / "a", "kind", "same"), place)
    assert [int(result["twice"]) for result in results.values()] == [0, 2, 4, 6]
    assert counts[0] == (0, 40)
    assert counts[1] == (5, 40)
    assert counts[-1] == (40, 40)
    counts.clear()
    again = run_units(never, UNITS, UnitStore(tmp_path / "a", "kind", "same"), place)
    assert [int(result["twice"]) for result in again.values()] == [0, 2, 4, 6]
    assert not counts


def test_another_experiment_is_refused_or_replaced(tmp_path: Path) -> None:
    place = Workplace(workers=0)
    run_units(double, UNITS, UnitStore(tmp_path, "kind", "one"), place)
    with pytest.raises(InputError, match="another configuration or version"):
        UnitStore(tmp_path, "kind", "other")
    assert UnitStore(tmp_path, "different", "other").fresh
    store = UnitStore(tmp_path, "kind", "other", overwrite=True)
    assert store.fresh
    assert not any(store.done(unit.key) for unit in UNITS)
    (tmp_path / "units" / "kind.json").write_text("nothing", encoding="utf-8")
    with pytest.raises(InputError, match="another configuration or version"):
        UnitStore(tmp_path, "kind", "other")


def test_remains_of_a_killed_program_are_removed(tmp_path: Path) -> None:
    store = UnitStore(tmp_path, "kind", "one")
    partial = store.path("a").with_name(".kind-a.npz.partial")
    partial.touch()
    UnitStore(tmp_path, "kind", "one")
    assert not partial.exists()


def test_workers_give_the_same(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    pytest.importorskip("xarray")
    said: list[str] = []
    counts: list[tuple[int, int]] = []
    place = Workplace(1, None, lambda *count: counts.append(count), said.append)
    results = run_units(double, UNITS, UnitStore(tmp_path, "kind", "one"), place)
    assert [int(results[unit.key]["twice"]) for unit in UNITS] == [0, 2, 4, 6]
    assert counts[-1] == (40, 40)
    assert said[0].startswith("Dask scheduler tcp://")
    with pytest.raises(InputError, match="refused"):
        run_units(impossible, UNITS[:1], UnitStore(tmp_path, "other", "one"), place)


def test_number_of_workers_is_checked() -> None:
    with pytest.raises(InputError, match="workers"):
        Workplace(workers=-1)
