from __future__ import annotations

import numpy as np
import pytest
from tests.loop.experiment_cases import small

from faintspot.errors import InputError
from faintspot.loop.arms import (
    ARM_NAMES,
    PARAMETERS,
    arm_label,
    arm_named,
    default_arms,
    kept_pixels,
    mean_pixel_noise_e,
    tuned_parameters,
)
from faintspot.loop.simulation import simulate_loop


def first_choice(name: str) -> dict[str, float]:
    return {key: parameter.coarse[0] for key, parameter in tuned_parameters(name).items()}


@pytest.mark.parametrize("name", ARM_NAMES)
def test_every_arm_closes_the_loop(name: str) -> None:
    """Not for long and not well, but better than no correction: Strehl ratio 0.17 then."""
    configuration = small().replace("camera", photons_per_subaperture=1000.0)
    record = simulate_loop(configuration, [arm_named(name, configuration, first_choice(name))])
    assert record.labels == (arm_label(name),)
    assert np.isfinite(record.slopes_px).all()
    assert record.mean_strehl() > 0.35


def test_labels_differ() -> None:
    assert len({arm_label(name) for name in ARM_NAMES}) == len(ARM_NAMES)


def test_defaults_suit_the_configuration() -> None:
    usual = default_arms(small())
    assert {"brightest", "tv", "map", "trained", "trained_predicted"} <= set(usual)
    assert not any(name.endswith("_uncorrected") for name in usual)
    elongated = default_arms(small().replace("sensor", spot_elongation=1.2, samples=12))
    assert set(usual) - set(elongated) == {"trained", "trained_predicted"}
    assert "tv_uncorrected" in default_arms(small().replace("control", mode="open"))


@pytest.mark.parametrize("name", PARAMETERS)
def test_coarse_values_are_among_all(name: str) -> None:
    parameter = PARAMETERS[name]
    assert set(parameter.coarse) <= set(parameter.values)
    assert list(parameter.values) == sorted(set(parameter.values))


def test_unknown_arm_and_missing_value() -> None:
    with pytest.raises(InputError, match="arm = 'kog'"):
        tuned_parameters("kog")
    with pytest.raises(InputError, match="expected a value for 'kept' of the arm 'tv'"):
        arm_named("tv", small(), {"gain": 0.5})


def test_fractions_become_pixels() -> None:
    assert kept_pixels(small(), 0.25) == 16
    assert kept_pixels(small(), 1.0) == 63
    assert kept_pixels(small(), 0.0) == 4


def test_noise_of_a_mean_pixel() -> None:
    """Read noise after multiplication, a quarter of the photon noise with its excess."""
    assert mean_pixel_noise_e(small()) == pytest.approx(np.sqrt(1 + 0.25 * 100 / 64))
    multiplied = small().replace("camera", em_gain=100.0, read_noise_e=30.0)
    assert mean_pixel_noise_e(multiplied) == pytest.approx(np.sqrt(0.3**2 + 0.25 * 100 / 64))
