"""Geometry and gaps of recorded loops."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import AIR, recorded
from tests.refusals import refused

from faintspot.base.text_files import plain_values
from faintspot.loop.control.identification import open_loop
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import (
    Measured,
    freed_of_prior,
    measured_delay,
    open_loop_of,
    outer_scale_and_r0,
    winds_of,
)
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.turbulence_strength import TurbulenceStrength


def test_an_unknown_sub_aperture_is_the_unit_of_length() -> None:
    assert recorded().site.length_unit == "m"
    site = replace(recorded(), subaperture_m=None).site
    assert (site.subaperture_m, site.length_unit) == (1.0, "sub-apertures")


def test_winds_have_the_unit_of_length_per_second() -> None:
    turbulence = replace(AIR, length_unit="sub-apertures")
    found = Identified(turbulence, 1.0, (), 250.0, True, np.ones((2, 2)), np.ones(2), 0.0)
    assert [wind.speed.unit for wind in winds_of(found)] == ["sub-apertures/s"] * 2
    assert "8.5 sub-apertures/s to 21 degrees (70%)" in found.summary()


def test_frames_without_slopes_are_gaps() -> None:
    loop = recorded()
    slopes = loop.slopes.copy()
    slopes[150:2400] = np.nan
    with refused("326", "300", "1 gaps"):
        measured_delay(replace(loop, slopes=slopes))
    slopes[:] = np.nan
    with refused("slopes"):
        measured_delay(replace(loop, slopes=slopes))


@pytest.mark.slow
def test_lost_frames_here_and_there_change_neither_delay_nor_gain() -> None:
    """Of every 20 frames one is lost, and numbered; true are 2 frames and a gain of 1."""
    loop = recorded().part(slice(0, 1500))
    kept = np.ones(len(loop.slopes), np.bool_)
    kept[np.random.default_rng(1).permutation(len(kept))[: len(kept) // 20]] = False
    whole, _ = measured_delay(loop)
    found, used = measured_delay(loop.part(kept))
    assert found.delay_frames == pytest.approx(2, abs=0.2)
    assert found.gain == pytest.approx(whole.gain, abs=0.06)
    assert open_loop_of(loop.part(kept), used).telemetry.trust.any(axis=1).mean() > 0.88


def test_a_fitted_delay_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a whole number is within its error; what is close to one is that number."""
    for fitted, used in ((1.37, 1.37), (1.67, 1.67), (2.06, 2.0)):
        best = LoopDelay(fitted, 0.4, 0.9, 0.1)
        fits = SimpleNamespace(best=lambda best=best: best, of=lambda delay: LoopDelay(delay, 0.0, 0.8, 0.1))
        monkeypatch.setattr(open_loop, "DelayFits", lambda *loop, fits=fits: fits)
        found, chosen = measured_delay(recorded())
        assert (found.delay_frames, chosen.delay_frames) == (fitted, used)


def test_infinite_slopes_count_as_not_measured() -> None:
    loop = recorded()
    slopes = loop.slopes.copy()
    slopes[3, 7] = np.inf
    read = Recording(slopes, loop.commands, loop.interaction_matrix, loop.cells, 250.0)
    assert np.isnan(read.slopes[3, 7])
    assert np.isfinite(np.delete(read.slopes, 3, axis=0)).all()


@pytest.mark.slow
def test_a_gain_at_the_limit_is_not_known() -> None:
    """Commands act the other way round than the interaction matrix says."""
    loop = recorded()
    rng = np.random.default_rng(1)
    commands = rng.standard_normal((800, 36))
    slopes = 0.1 * rng.standard_normal((800, 50))
    slopes[2:] -= commands[:-2] @ loop.interaction_matrix.T
    still = replace(loop, slopes=slopes, commands=commands, frame=np.arange(800), delay_frames=2.0)
    with refused("centroid gain", "integrator"):
        measured_delay(still)


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


def test_slopes_that_were_expected_stay_without_the_prior() -> None:
    """What was expected is what the commands of two frames ago have added, and the latest takes away."""
    loop = replace(recorded().part(slice(0, 6)), delay_frames=2.0)
    sent = loop.commands @ loop.interaction_matrix.T
    slopes = np.vstack([np.zeros((2, 50)), [sent[k - 2] - sent[k - 1] for k in range(2, 6)]])
    loop = replace(loop, slopes=slopes, standard_errors=np.full(slopes.shape, 0.5), prior_std=np.ones(50))
    np.testing.assert_allclose(freed_of_prior(loop, is_predicted=True).slopes, slopes, atol=1e-12)
    # A posterior of a quarter of the prior's variance: the frame alone lies 4 / 3 as far from 0.
    np.testing.assert_allclose(freed_of_prior(loop, is_predicted=False).slopes, slopes * 4 / 3)


def test_slopes_of_noise_alone_tell_no_r0() -> None:
    outer, r0 = outer_scale_and_r0(TurbulenceStrength(math.nan, math.nan, math.nan, math.nan))
    assert math.isnan(outer.value)
    assert math.isnan(r0.value)
    assert "no more than their noise" in r0.remark
