from typing import Any

import numpy as np
from numpy.typing import NDArray
from tests.engine.page.cases import unpacked

from faintspot.engine.page.page import packed


def test_message_holds_values_and_arrays_as_they_were() -> None:
    arrays: dict[str, NDArray[Any]] = {
        "odd": np.arange(5, dtype=np.uint8),
        "none": np.zeros((0, 3), np.float32),
        "table": np.arange(6.0).reshape(2, 3),
        "strided": np.arange(8, dtype=np.int32)[::2],
    }
    kind, values, found = unpacked(packed("now", {"é": 1, "missing": float("nan")}, arrays))
    assert (kind, values) == ("now", {"é": 1, "missing": None})
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
