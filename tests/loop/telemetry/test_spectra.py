"""Turned and stretched slopes are told from those of wavefronts."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import recorded
from tests.patience import mostly_slow

from faintspot.loop.control.identification.layers import Identification
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import Measured, open_loop_of
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.control.identification.vibrations import MODES
from faintspot.loop.telemetry.spectra import OTHERS, modal_spectra, recorded_discrepancy


def found_in_still_air(loop: Recording) -> list[Measured]:
    """Return rotation and gain, with winds that are not known."""
    seen = open_loop_of(loop, LoopDelay(2.0, 0.0, 1.0, 0.0))
    identified = Identification(seen.telemetry, loop.site, loop.frame_rate_hz)
    return recorded_discrepancy(loop, seen, identified.of_winds(np.zeros((1, 2))))


def found(change: np.ndarray, missing: float = 0.0) -> list[Measured]:
    """Return rotation and gain of a loop whose x and y slopes were changed by a matrix (2, 2)."""
    loop: Any = recorded().part(slice(0, 1500))
    whole = np.kron(change, np.eye(len(loop.cells)))
    slopes = loop.slopes @ whole.T
    slopes[:, np.random.default_rng(1).random(slopes.shape[1]) < missing] = np.nan
    loop = replace(loop, slopes=slopes, interaction_matrix=whole @ loop.interaction_matrix)
    return found_in_still_air(loop)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "gain", "missing"), mostly_slow(1, [(0.0, 1.0, 0.0), (5.0, 1.0, 0.1), (0.0, 1.2, 0.0)])
)
def test_rotation_and_gain(degrees: float, gain: float, missing: float) -> None:
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turned, stretched = found(np.diag([gain, 1.0]) @ turn, missing)
    assert abs(turned.value - degrees) < 3 * turned.error < 2
    assert abs(stretched.value - gain) < 3 * stretched.error < 0.2


def test_too_few_slopes() -> None:
    """Of a single sub-aperture, all slopes are those of a wavefront."""
    loop = recorded()
    slopes = np.full_like(loop.slopes, np.nan)
    slopes[:, [0, 25]] = loop.slopes[:, [0, 25]]
    for each in found_in_still_air(replace(loop, slopes=slopes)):
        assert not np.isfinite(each.value)
        assert "too few" in each.remark


@pytest.mark.slow
def test_noise_hides_both() -> None:
    loop = recorded().part(slice(0, 500))
    noise = np.random.default_rng(1).normal(0.0, 1.0, loop.slopes.shape)
    for each in found_in_still_air(replace(loop, slopes=noise, commands=None)):
        assert not np.isfinite(each.value)
        assert each.remark


def test_a_spectrum_is_variance_by_frequency() -> None:
    """White noise of 0.2 px in four sub-apertures: modes have its variance up to half the rate."""
    loop = recorded().part(slice(0, 1500))
    seen = open_loop_of(loop, LoopDelay(2.0, 0.0, 1.0, 0.0)).telemetry
    noise = np.random.default_rng(1).normal(0.0, 0.2, seen.open_loop_px.shape)
    measured = np.tile(np.isin(np.arange(25), [6, 8, 16, 18]), 2)
    telemetry = replace(seen, open_loop_px=noise, variance_px2=np.where(measured, seen.variance_px2, np.inf))
    identified = Identification(telemetry, loop.site, loop.frame_rate_hz)
    spectra = modal_spectra(telemetry, identified.of_winds(np.zeros((1, 2))))
    for name in (*MODES, OTHERS):
        density = spectra.measured[name].mean()  # known to 4 % from 1500 frames
        assert density * loop.frame_rate_hz / 2 == pytest.approx(0.2**2, rel=0.15)
