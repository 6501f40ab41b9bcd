"""Mean of the finite values of each pixel."""

import numpy as np

from faintspot.slopes.camera.frame_checks import MeanFrame


def test_blocks_and_pixels_that_are_not_finite() -> None:
    frames = np.random.default_rng(1).normal(100, 5, (7, 3, 4))
    frames[2, 0, 0], frames[5, 0, 0], frames[:, 1, 1] = np.nan, np.inf, np.nan
    mean = MeanFrame((3, 4))
    mean.add(frames[:3])
    mean.add(frames[3:])
    expected = frames.mean(axis=0)
    expected[0, 0] = frames[[0, 1, 3, 4, 6], 0, 0].mean()
    np.testing.assert_allclose(mean.mean, expected, rtol=1e-12)
    assert np.isnan(mean.mean[1, 1])
