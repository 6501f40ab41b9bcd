from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

from faintspot.loop.simulation import LoopConfiguration, load_loop, shipped_loops

REGIMES = {"canary", "emccd", "camera_3e", "laboratory_16e", "window_10", "diffraction_limit"}
REGIMES |= {"elongated_3e", "elongated_10e", "open_loop", "eight_metre"}


def test_shipped_configurations_read_and_write() -> None:
    assert set(shipped_loops()) == REGIMES
    for name in REGIMES:
        loop = load_loop(name)
        assert loop.name == name
        assert loop == load_loop(f"{name}.toml")
        assert LoopConfiguration.from_text(loop.to_text()) == loop
        assert hash(loop) == hash(load_loop(name))
        assert loop.run.photons_per_subaperture


def test_a_file_goes_before_a_shipped_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("canary.toml").write_text('name = "mine"\n[camera]\nphotons_per_subaperture = 3\n')
    assert load_loop("canary.toml").name == "mine"
    (tmp_path / "canary").mkdir()  # as of results
    assert load_loop("canary").name == "canary"


def test_flux_by_magnitude() -> None:
    loop = LoopConfiguration().replace("camera", photons_per_subaperture=None, magnitude=11.0)
    assert loop.photons == pytest.approx(float(loop.photometry.electrons(11.0)))
    assert 100 < loop.photons < 500

    known = loop.replace("camera", zero_point=1e10, throughput=0.5, quantum_efficiency=0.8)
    side_m, rate_hz = 0.6, known.control.frame_rate_hz
    assert known.photons == pytest.approx(1e10 * 10**-4.4 * side_m**2 / rate_hz * 0.5 * 0.8)


def test_what_estimators_know() -> None:
    """Of an EMCCD: noise before the multiplication, which doubles the variance of photons."""
    camera = {"read_noise_e": 30.0, "em_gain": 20.0, "background_e": 0.3, "dark_e": 0.2}
    loop = LoopConfiguration().replace("camera", **camera).replace("sensor", spot_elongation=2.0, samples=24)
    scene = loop.scene
    assert (scene.flux_e, scene.read_noise_e, scene.background_e) == (100.0, 1.5, 0.5)
    assert (scene.excess_noise, scene.elongation) == (2.0, 2.0)
    assert scene.diffraction_px == pytest.approx(2.0)
    assert scene.spot_fwhm_px == pytest.approx(0.886 * 2.0 * np.sqrt(2.0))  # geometric mean
    r0_m = 0.15 * (loop.sensor.wavelength_m / 500e-9) ** 1.2
    assert scene.d_over_r0 == pytest.approx(0.6 / r0_m)
    plain = LoopConfiguration()
    assert (plain.scene.excess_noise, plain.subaperture_m) == pytest.approx((1.0, 0.6))
    assert plain.spot_width_px == pytest.approx(2.0)


BAD = [
    ("sensor", {"subaperture_m": 5.0}, "telescope.diameter_m = 4.2"),
    ("sensor", {"subaperture_m": 0.3}, "sensor.subapertures"),
    ("sensor", {"samples": 6}, "sensor.samples = 6"),
    ("sensor", {"spot_elongation": 8.0}, "sensor.samples"),
    ("atmosphere", {"fraction": (1.0,)}, "fraction"),
    ("atmosphere", {"fraction": (0.0, 0.0, 0.0, 0.0)}, "fraction"),
    ("atmosphere", {"r0_m": (0.2, 0.1)}, "r0_m"),
    ("camera", {"magnitude": 10.0}, "photons_per_subaperture"),
    ("camera", {"photons_per_subaperture": None}, "photons_per_subaperture"),
    ("run", {"settle_frames": 2000}, "run.settle_frames = 2000"),
    ("run", {"frame": 3}, "run.frame"),
    ("engine", {}, "engine"),
]


def test_impossible_values_are_refused_in_one_line() -> None:
    for section, values, message in BAD:
        changed: Any = values
        with refused(message):
            LoopConfiguration().replace(section, **changed)
    with refused("nothing.toml", "canary"):
        load_loop("nothing.toml")


def test_slowed_loops_are_the_same_in_frames() -> None:
    loop = LoopConfiguration()
    slowed = loop.slowed_to(loop.control.frame_rate_hz / 5)
    now, before = (
        np.divide(each.atmosphere.wind_speed_m_per_s, each.control.frame_rate_hz) for each in (slowed, loop)
    )
    np.testing.assert_allclose(now, before)
    assert slowed.photons == loop.photons
    with refused("frame_rate_hz"):
        loop.slowed_to(0.0)
