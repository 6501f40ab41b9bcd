"""Quantities measured from telemetry: intervals, and quantities that are not known."""

import math

import pytest

from faintspot.base.text_files import plain_values
from faintspot.loop.control.identification.open_loop import Measured, outer_scale_and_r0
from faintspot.loop.turbulence_strength import TurbulenceStrength


def test_intervals_are_of_95_per_cent() -> None:
    assert Measured("tilt", "px", -1.0, 0.5).interval == pytest.approx((-1.98, -0.02))
    assert Measured("noise", "px", 1.0, 0.8).interval == pytest.approx((-0.568, 2.568))
    low, high = Measured("r0", "m", 1.0, 0.8, is_positive=True).interval
    assert low * high == pytest.approx(1.0)
    assert plain_values(Measured("r0", "m", remark="why").as_values()) == {
        "name": "r0",
        "unit": "m",
        "remark": "why",
        **dict.fromkeys(("value", "error", "low", "high")),
    }


def test_slopes_of_noise_alone_tell_no_r0() -> None:
    outer, r0 = outer_scale_and_r0(TurbulenceStrength(math.nan, math.nan, math.nan, math.nan))
    assert math.isnan(outer.value)
    assert math.isnan(r0.value)
    assert "no more than their noise" in r0.remark
