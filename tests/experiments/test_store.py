"""The store of finished units: whole ones or none, and nobody else's."""

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

from faintspot.experiments.store import UnitStore, ZarrStore, kind_of_store

pytest.importorskip("zarr")

RESULT = {
    "number": np.asarray(3.5),
    "image": np.arange(6, dtype=np.float32).reshape(2, 3),
    "count": np.asarray(7),
    "text": np.asarray('keep_brightest = "auto"'),
    "names": np.array(["a", "bcd"]),
    "flags": np.array([True, False]),
}


def assert_equal(found: Any, expected: dict[str, NDArray[Any]]) -> None:
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert found[name].shape == values.shape
        assert found[name].dtype.kind == values.dtype.kind
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    stores: tuple[UnitStore, ...] = {}, ZarrStore(path, "study", "one", ["a", "b/c"])
    for store in stores:
        assert "b/c" not in store
        store["b/c"] = RESULT
        assert "b/c" in store
        assert "a" not in store
        assert_equal(store["b/c"], RESULT)
    again = ZarrStore(path, "study", "one", ["a", "b/c"])
    assert "b/c" in again
    assert_equal(again["b/c"], RESULT)


def test_more_units_later(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    ZarrStore(path, "study", "one", ["a"])["a"] = RESULT
    store = ZarrStore(path, "study", "one", ["b", "a"])
    assert "a" in store
    store["b"] = {**RESULT, "number": np.asarray(1.0)}
    fewer = ZarrStore(path, "study", "one", ["b"])
    assert fewer["b"]["number"] == 1.0
    assert_equal(fewer["a"], RESULT)


def test_what_belongs_to_others_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    ZarrStore(path, "study", "one", ["a"], attributes={"name": "mine"})
    with refused("s.zarr", "'mine'"):
        ZarrStore(path, "study", "other", ["a"])
    with refused("s.zarr", "of a loop"):
        ZarrStore(path, "loop", "one", ["a"], overwrite=True)
    ZarrStore(path, "study", "other", ["a"], overwrite=True)
    assert kind_of_store(path) == "study"
    assert "a" not in ZarrStore(path, "study", "other", ["a"])
    folder = tmp_path / "folder"
    folder.mkdir()
    with refused("folder", "of a study"):
        ZarrStore(folder, "study", "one", ["a"], overwrite=True)
    with refused("does not exist"):
        ZarrStore(tmp_path / "no" / "s.zarr", "study", "one", ["a"])


def test_a_damaged_store_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.zarr"
    store = ZarrStore(path, "study", "one", ["a"])
    store["a"] = RESULT
    for chunk in (path / "image" / "c").rglob("*"):
        if chunk.is_file():
            chunk.write_bytes(b"rubbish")
    with refused("damaged"):
        ZarrStore(path, "study", "one", ["a"])["a"]
    metadata = json.loads((path / "done" / "zarr.json").read_text())
    metadata["shape"] = "many"
    (path / "done" / "zarr.json").write_text(json.dumps(metadata))
    with refused("damaged"):
        ZarrStore(path, "study", "one", ["a"])


@pytest.mark.slow
def test_killed_while_it_writes(tmp_path: Path) -> None:
    """Whatever is done is whole after SIGKILL; remains are removed."""
    program = """
        import sys, numpy as np
        from faintspot.experiments.store import ZarrStore
        store = ZarrStore(sys.argv[1], "study", "one", [str(i) for i in range(1000)])
        print("ready", flush=True)
        for i in range(1000):
            store[str(i)] = {"a": np.full(500, float(i)), "b": np.asarray(str(i))}
            print(i, flush=True)
    """
    path = tmp_path / "s.zarr"
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(program), str(path)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    while process.stdout.readline() != "5\n":
        assert process.poll() is None
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    (path / "a" / "c" / "0" / "0.abc.partial").parent.mkdir(parents=True, exist_ok=True)
    (path / "a" / "c" / "0" / "0.abc.partial").write_bytes(b"half")
    store = ZarrStore(path, "study", "one", [str(i) for i in range(1000)])
    assert not list(path.rglob("*.partial"))
    done = [i for i in range(1000) if str(i) in store]
    assert len(done) >= 6
    for i in done:
        found = store[str(i)]
        np.testing.assert_array_equal(found["a"], float(i))
        assert str(found["b"]) == str(i)
