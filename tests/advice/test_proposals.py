"""Proposals: the light, the loop gain that would have left least, the planner's estimator and the window."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.advice.advice_cases import LAYOUT, seen_with_truth
from tests.advice.test_centroid_gain import PSF, frames

import faintspot as fs
from faintspot.advice import proposals
from faintspot.advice.centroid_gain import shifted_gain
from faintspot.advice.proposals import Proposal, Sensor, new_estimators, new_gain, new_light
from faintspot.advice.residual import wavefront_modes
from faintspot.control.configuration import Control

MODES, UNIT = wavefront_modes(LAYOUT)
# Each command moves two slopes; nothing that the air does is beyond the mirror.
PLANT = Control(np.kron(np.eye(len(LAYOUT)), np.ones((2, 1)))).plant
SENSOR = Sensor(LAYOUT, fs.Calibration(dark=0.0, read_noise_e=1.0), PSF, None, None)


def test_the_light() -> None:
    told = fs.Settings("window", flux_e=100.0)
    proposal = new_light(told, 55.0, 1.0)
    assert proposal is not None
    assert (proposal.text, proposal.promise) == ("flux_e=55", "the light is 55 +- 1 e-")
    assert new_light(told, 95.0, 1.0) is None
    assert new_light(told, 55.0, 20.0) is None
    assert new_light(fs.Settings("centroid"), 55.0, 1.0) is None


def test_noise_wants_a_lower_gain() -> None:
    """The air of slow waves without noise is followed fast; behind 30 times the noise, slowly."""
    gains = []
    for noise in (0.02, 0.6):
        seen, _ = seen_with_truth(noise_px=(noise, noise), frames=900, turn=900)
        proposal = new_gain(seen, PLANT, MODES, 0.55, UNIT)
        assert proposal is not None
        assert proposal.gain is not None
        assert proposal.text == f"gain {proposal.gain:g}"
        assert "would have left" in proposal.promise
        assert proposal.gain is not None
        gains.append(proposal.gain)
    assert gains[1] < gains[0]
    seen, _ = seen_with_truth(noise_px=(0.6, 0.6), frames=900, turn=900)
    assert new_gain(seen, PLANT, MODES, gains[1], UNIT) is None
    few, _ = seen_with_truth(frames=100)
    assert new_gain(few, PLANT, MODES, 0.3, UNIT) is None


def test_estimators_of_the_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(proposals, "_SPOTS", 256)
    told = fs.Settings("brightest", keep_brightest=60)
    found = new_estimators(told, SENSOR, frames(60.0), 60.0, PSF, 0.3, centroid_gain=0.5)
    changes = {each.changes["estimator"]: each for each in found}
    assert "window" in changes
    assert "brightest" not in changes
    for each in found:
        assert "px in simulated spots, brightest at its best" in each.promise
        SENSOR.pipeline(told.replace(**each.changes))  # they fit
    window = changes["window"].changes
    alone = told.replace(**{**window, "centroid_gain": 1.0})
    gain = shifted_gain(SENSOR.pipeline(alone), frames(60.0))
    assert gain is not None
    assert window["centroid_gain"] == pytest.approx(gain.value / 0.5, rel=0.01)
    assert window["flux_e"] == 60.0
    assert (
        new_estimators(told, Sensor(LAYOUT, fs.Calibration(), PSF, None, None), frames(60.0), 60.0, None, 0.3)
        == []
    )


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"estimator": "map", "prior_std_px": 1.23456}, "estimator=map+prior_std_px=1.235"),
        ({"keep_brightest": 20, "adaptive": True}, "keep_brightest=20+adaptive=true"),
        ({"a": np.array([0.5, 1.0])}, "a=0.5,1"),
    ],
)
def test_text(changes: dict[str, Any], text: str) -> None:
    assert Proposal(changes, None, "").text == text
