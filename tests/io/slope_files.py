"""Slopes to be written and checked, and the formats that are tested."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

from faintspot.base.flags import VARIABLES
from faintspot.io import SlopeWriter, create_writer, read_slopes

pytest.importorskip("astropy")
pytest.importorskip("zarr")

NAMES = ["slopes.npz", "slopes.zarr", "slopes.fits", "slopes.csv"]
ATTRIBUTES = {
    "fingerprint": "abc",
    "configuration": 'title = "é"\n[sensor]\npixels = 16\n',
    "sources": ["a.fits", "b.fits"],
    "faintspot_version": "0.1.0",
    "number": np.float32(0.5),
}
OTHER_RUN = {**ATTRIBUTES, "fingerprint": "other"}


def result(n_frames: int = 50, n_subapertures: int = 7) -> dict[str, NDArray[Any]]:
    generator = np.random.default_rng(3)
    shape = (n_frames, n_subapertures)
    return {
        "x": generator.normal(size=shape).astype(np.float32),
        "y": generator.normal(size=shape).astype(np.float32) * np.float32(1e-7),
        "flux": generator.exponential(1e5, shape).astype(np.float32),
        "valid": generator.random(shape) > 0.2,
        "flags": generator.integers(0, 255, shape).astype(np.uint8),
        "iterations": generator.integers(0, 90_000, shape).astype(np.int32),
        "bad_pixels": generator.integers(0, 9, shape).astype(np.int32),
        "standard_error_x": generator.exponential(0.1, shape).astype(np.float32),
        "standard_error_y": np.where(generator.random(shape) > 0.2, 0.1, np.inf).astype(np.float32),
        "covariance_xy": generator.normal(scale=1e-3, size=shape).astype(np.float32),
    }


def part(whole: Mapping[str, NDArray[Any]], start: int, stop: int) -> dict[str, NDArray[Any]]:
    return {name: array[start:stop] for name, array in whole.items()}


def writer_for(path: Path, n_frames: int = 50, n_subapertures: int = 7, **changes: Any) -> SlopeWriter:
    arguments: dict[str, Any] = {
        "attributes": ATTRIBUTES,
        "coordinates": {
            "centre_x": np.arange(n_subapertures) + 0.5,
            "centre_y": np.arange(n_subapertures) * 2.0,
        },
    }
    return create_writer(path, n_frames=n_frames, n_subapertures=n_subapertures, **(arguments | changes))


def write(path: Path, whole: Mapping[str, NDArray[Any]], step: int = 8, **changes: Any) -> None:
    """Write from wherever the writer stands to the end."""
    n_frames, n_subapertures = whole["x"].shape
    with writer_for(path, n_frames, n_subapertures, **changes) as writer:
        for start in range(writer.finished(), n_frames, step):
            append_copy(writer, start, part(whole, start, min(start + step, n_frames)))


def append_copy(writer: SlopeWriter, start: int, block: Mapping[str, NDArray[Any]]) -> None:
    """Append a block in arrays that are then used again, as who measures may do."""
    copies = {name: values.copy() for name, values in block.items()}
    writer.append(start, copies)
    for values in copies.values():
        values[:] = 0


def begin(path: Path, n_frames: int, **changes: Any) -> None:
    """Write the first frames of `result` and stop."""
    with writer_for(path, **changes) as writer:
        writer.append(0, part(result(), 0, n_frames))


def store_of(path: Path) -> Path:
    """Return the store with the slopes of an unfinished run."""
    return path if path.suffix == ".zarr" else path.with_name(f"{path.name}.partial.zarr")


def assert_stored(path: Path, whole: Mapping[str, NDArray[Any]]) -> None:
    stored = read_slopes(path)
    assert stored.complete
    assert stored.n_finished == len(whole["x"])
    assert set(stored.variables) == set(VARIABLES)
    for name, array in whole.items():
        assert stored.variables[name].dtype == array.dtype, name
        np.testing.assert_array_equal(stored.variables[name], array, err_msg=name)
    if path.suffix != ".csv":
        assert stored.attributes == {**ATTRIBUTES, "number": 0.5}
        np.testing.assert_array_equal(stored.coordinates["centre_x"], np.arange(whole["x"].shape[1]) + 0.5)


def assert_alone(path: Path, whole: Mapping[str, NDArray[Any]]) -> None:
    """Check the content of a file with nothing beside it."""
    assert_stored(path, whole)
    assert [entry.name for entry in path.parent.iterdir()] == [path.name]


def assert_refused(path: Path, *parts: str, **changes: Any) -> None:
    with refused(*parts):
        writer_for(path, **changes)
