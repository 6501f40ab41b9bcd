from typing import Any

import numpy as np
import pytest
from tests.patience import mostly_slow

from faintspot.slopes.kernels.gather import Frames, gather_raw
from faintspot.slopes.kernels.host import aligned_zeros, lanes_for


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
@pytest.mark.parametrize("width", mostly_slow(1, [8, 16, 4]))
@pytest.mark.parametrize("window", [(16, 16), (8, 8), (10, 10), (7, 9), (5, 20), (2, 2), (1, 1)])
def test_gathered_windows_equal_slices(window: tuple[int, int], width: int, dtype: Any) -> None:
    """Also of windows that SIMD lanes stick out of, in the last corner of the last frame."""
    ny, nx = window
    rng = np.random.default_rng(1)
    frames = rng.integers(0, 60_000, (2, 31, 33)).astype(dtype)
    lanes = lanes_for(np.float32, width)
    rows, columns = rng.integers(0, 32 - ny, width), rng.integers(0, 34 - nx, width)
    rows[0], columns[0] = 31 - ny, 33 - nx
    for frame in range(2):
        image, block = (aligned_zeros(ny * nx * width, np.float32) for _ in range(2))
        gather_raw(lanes, Frames.of(frames), frame, rows * 33 + columns, ny, nx, block, image)
        for lane in range(width):
            expected = frames[frame, rows[lane] : rows[lane] + ny, columns[lane] : columns[lane] + nx]
            assert np.array_equal(image.reshape(ny, nx, width)[:, :, lane], expected)
