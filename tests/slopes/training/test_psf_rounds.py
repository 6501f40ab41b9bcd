"""Sub-apertures without a spot of their own are left out of what is learnt from frames, and it is said."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

from faintspot import Calibration, Layout, learn_psf
from faintspot.slopes.simulate import Detector, sensor_frames
from faintspot.slopes.training.psf_rounds import usable_subapertures

LAYOUT = Layout.grid((6, 6), pixels=12)
CAMERA = Calibration(read_noise_e=2.0)
DARK = [0, 14, 21]
USED = ~np.isin(np.arange(len(LAYOUT)), DARK)


def frames(flux_e: float = 300.0, n: int = 20) -> NDArray[np.float32]:
    """Frames whose sub-apertures `DARK` have no spot."""
    images, _ = sensor_frames(
        LAYOUT,
        n,
        flux_e=flux_e * USED,
        detector=Detector(read_noise_e=2.0),
        rng=np.random.default_rng(1),
    )
    return images


def test_dark_ones_are_found() -> None:
    usable, line = usable_subapertures(frames(), LAYOUT, CAMERA)
    np.testing.assert_array_equal(usable, USED)
    assert line == "left out 3 of 36 sub-apertures: dark"


def test_nothing_is_left_out_of_frames_too_faint_to_tell() -> None:
    assert usable_subapertures(frames(3.0, 2), LAYOUT, CAMERA)[1] == ""


def test_nothing_but_bad_pixels() -> None:
    with refused("left out 36 of 36 sub-apertures: bad pixels"):
        usable_subapertures(np.full((2, *LAYOUT.frame_shape), np.nan), LAYOUT, CAMERA)


@pytest.mark.slow
def test_psf_is_that_of_the_others() -> None:
    """Bit for bit, and dark sub-apertures get one of the PSFs."""
    kinds = np.arange(len(LAYOUT)) % 2
    with pytest.warns(UserWarning, match="PSF: left out 3 of 36 sub-apertures: dark"):
        found = learn_psf(frames(), LAYOUT, CAMERA, scope=kinds, rounds=4, rng=np.random.default_rng(2))
    options: dict[str, Any] = {"scope": kinds[USED], "rounds": 4}
    expected = learn_psf(frames(), LAYOUT[USED], CAMERA, rng=np.random.default_rng(2), **options)
    np.testing.assert_array_equal(found.samples, expected.samples)
    assert found.index is not None
    np.testing.assert_array_equal(found.index[USED], kinds[USED])
