"""Geometry and gaps of recorded loops."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import AIR, recorded
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.loop.control.identification import open_loop
from faintspot.loop.control.identification.layers import Identified
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import (
    measured_delay,
    open_loop_of,
    winds_of,
)
from faintspot.loop.control.identification.recording import Recording


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
    with pytest.raises(InputError, match="expected frames with most slopes measured"):
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


@pytest.mark.parametrize(("fitted", "used"), [(1.37, 1.37), (1.67, 1.67), (2.06, 2.0)])
def test_a_fitted_delay_is_used(fitted: float, used: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where a whole number is within its error; what is close to one is that number."""
    fits = SimpleNamespace(
        best=lambda: LoopDelay(fitted, 0.4, 0.9, 0.1), of=lambda delay: LoopDelay(delay, 0.0, 0.8, 0.1)
    )
    monkeypatch.setattr(open_loop, "DelayFits", lambda *loop: fits)
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
    with pytest.raises(InputError, match=r"centroid gain: cannot be known .* keep the integrator"):
        measured_delay(still)
