from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.result_cases import made_up_magnitude
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.loop.simulation.record import MAGNITUDE_FILE, holds_loop_results, make_folder


def assert_equal(one: Any, other: Any) -> None:
    assert type(one) is type(other)
    for name, value in vars(one).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(value, getattr(other, name))
            assert value.dtype == getattr(other, name).dtype
        else:
            assert value == getattr(other, name)


def test_magnitude_is_read_as_written(tmp_path: Path) -> None:
    result = made_up_magnitude()
    result.strehl[1, 2, 3] = np.nan
    assert not holds_loop_results(tmp_path)
    result.save(tmp_path / MAGNITUDE_FILE)
    assert holds_loop_results(tmp_path)
    assert_equal(MagnitudeResult.load(tmp_path / MAGNITUDE_FILE), result)
    assert [path.name for path in tmp_path.iterdir()] == [MAGNITUDE_FILE]


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    with pytest.raises(InputError, match="no such file"):
        MagnitudeResult.load(path)
    path.write_bytes(b"nothing")
    with refused("expected a magnitude experiment"):
        MagnitudeResult.load(path)


def test_folders_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist: create it first"):
        make_folder(tmp_path / "a" / "b")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be made"):
        make_folder(tmp_path / "file")
