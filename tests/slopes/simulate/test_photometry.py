from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintspot.slopes.simulate.photometry import ZERO_POINTS, Photometry

FLUX = Photometry(area_m2=0.36, frame_time_s=0.004)


@given(st.floats(-5, 25))
def test_magnitude_is_the_inverse_of_electrons(magnitude: float) -> None:
    assert float(FLUX.magnitude(FLUX.electrons(magnitude))) == pytest.approx(magnitude, abs=1e-9)


def test_electrons_are_those_of_the_formula() -> None:
    expected = ZERO_POINTS["R"] * 10**-4.0 * 0.36 * 0.004 * 0.4 * 0.9
    assert float(FLUX.electrons(10.0)) == pytest.approx(expected)


def test_zero_point_of_v_is_the_textbook_one() -> None:
    """About 1000 photons / s / cm^2 / angstrom over 880 angstrom: 8.8e9 / s / m^2; 3 % for its rounding."""
    assert ZERO_POINTS["V"] == pytest.approx(8.8e9, rel=0.03)


def test_own_zero_point_replaces_the_bands() -> None:
    lossless: dict[str, Any] = {"throughput": 1.0, "quantum_efficiency": 1.0}
    assert Photometry(1.0, 1.0, band="V", zero_point=1e9, **lossless).electrons_at_zero == 1e9
