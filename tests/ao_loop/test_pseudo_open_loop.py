from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintspot.ao_loop.pseudo_open_loop import pseudo_open_loop_slopes
from faintspot.base.errors import InputError


@given(st.integers(0, 3), st.integers(0, 2**32 - 1), st.floats(0.2, 1.5))
def test_the_mirror_is_taken_out_of_the_slopes(delay: int, seed: int, gain: float) -> None:
    rng = np.random.default_rng(seed)
    atmosphere, computed, matrix = rng.normal(size=(20, 8)), rng.normal(size=(20, 3)), rng.normal(size=(8, 3))
    held = np.concatenate([rng.normal(size=(delay, 3)), computed[: 20 - delay]])
    measured = gain * (atmosphere + held @ matrix.T)
    found = pseudo_open_loop_slopes(measured, computed, matrix, centroid_gain=gain, delay_frames=delay)
    np.testing.assert_allclose(found, atmosphere[delay:], atol=1e-12)


def test_each_frame_may_have_its_own_gain() -> None:
    slopes = np.ones((3, 2))
    found = pseudo_open_loop_slopes(slopes, np.zeros((3, 1)), np.ones((2, 1)), centroid_gain=[1.0, 0.5, 0.25])
    np.testing.assert_allclose(found[:, 0], [1, 2, 4])


def test_inputs_stay_as_they_are() -> None:
    slopes, commands, matrix = np.ones((4, 2)), np.ones((4, 1)), np.ones((2, 1))
    pseudo_open_loop_slopes(slopes, commands, matrix)
    assert (slopes == 1).all()
    assert (commands == 1).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"commands": np.zeros((5, 2))}, "commands: expected 4 frames"),
        ({"interaction_matrix": np.zeros((6, 3))}, "interaction_matrix: expected shape"),
        ({"delay_frames": -1}, "delay_frames = -1"),
        ({"delay_frames": 4}, "delay_frames = 4"),
        ({"centroid_gain": 0.0}, "centroid_gain = 0"),
        ({"centroid_gain": [1.0, 1.0]}, "centroid_gain: expected one number or 4"),
        ({"slopes_px": np.zeros(6)}, "slopes_px: expected"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(changes: dict[str, object], words: str) -> None:
    values: dict[str, object] = {
        "slopes_px": np.zeros((4, 6)),
        "commands": np.zeros((4, 2)),
        "interaction_matrix": np.zeros((6, 2)),
    }
    with pytest.raises(InputError, match=words) as error:
        pseudo_open_loop_slopes(**{**values, **changes})  # type: ignore[arg-type]
    assert "\n" not in str(error.value)
