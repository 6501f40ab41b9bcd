"""Control in recordings."""

import json

import numpy as np
import pytest
from tests.loop.telemetry.alternation_cases import MATRIX
from tests.refusals import refused

from faintspot.loop.control.configuration import Control
from faintspot.loop.control.options import ControlOptions
from faintspot.loop.control.recorded import packed_control, unpacked_control


def test_matrix_and_options_are_read_as_they_were_written() -> None:
    options = ControlOptions(gain=0.3, delay_frames=3, centroid_gain=0.8, largest_command=500.0)
    packed = json.loads(json.dumps(packed_control(Control(MATRIX, options=options))))
    found = unpacked_control({"control": packed})
    assert found is not None
    np.testing.assert_allclose(found.interaction, MATRIX, rtol=1e-6)
    assert found.options == options


def test_what_is_not_recorded() -> None:
    assert packed_control(None) is None
    assert unpacked_control({}) is None
    assert unpacked_control({"control": None}) is None
    large = Control(np.vstack([np.eye(400), np.zeros((400, 400))]))
    assert large.interaction.size * 4 > 1 << 20
    assert packed_control(large) is None


@pytest.mark.parametrize(
    "damage", [{"interaction_matrix": "?"}, {"shape": [3, 5]}, {"gain": 7}, {"unknown": 1}]
)
def test_damage_is_refused(damage: dict[str, object]) -> None:
    packed = packed_control(Control(MATRIX))
    assert packed is not None
    with refused("control: the recorded control is damaged"):
        unpacked_control({"control": {**packed, **damage}})
