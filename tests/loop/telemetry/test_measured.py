"""What telemetry tells: of images flux, noise and spots, of slopes the air; and what it does not."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.loop.telemetry.advice_cases import LAYOUT, seen_with_truth
from tests.loop.telemetry.test_centroid_gain import frames

import faintspot as fs
from faintspot.loop.simulation.configuration.configuration import ARCSEC
from faintspot.loop.telemetry.measured import Measured, of_atmosphere, of_images


def test_images_tell_flux_noise_and_width() -> None:
    """20 frames of 36 spots: the flux to its stated error, the noise to some per cent."""
    flux, noise, width = of_images(frames(300.0), LAYOUT, fs.Calibration(dark=0.0, read_noise_e=1.0))
    # What diffraction throws out of windows of 8 pixels is not seen: some per cent.
    assert 300.0 * 0.9 < flux.value < 300.0 + 3 * flux.error
    assert 0 < flux.error < 3.0
    assert noise.value == pytest.approx(1.0, abs=0.2)
    assert 1.5 < width.value < 2.5


def test_too_few_images_tell_nothing() -> None:
    found = of_images(frames(300.0, 3), LAYOUT, fs.Calibration(dark=0.0))
    assert all("not known (3 images" in each.in_words() for each in found)


def test_slopes_tell_r0_and_wind() -> None:
    """Of simulated air with 0.15 m and 6 to 22 m/s; for one layer, a speed among theirs.

    Two seconds hold few independent wavefronts: r0 to 25 %. Winds three times as fast look so to a factor.
    """
    pytest.importorskip("hcipy")
    from benchmarks.advice import seen_in_record
    from tests.loop.simulation.loop_cases import faint, plain

    from faintspot.loop.simulation import simulate_loop
    from faintspot.loop.simulation.telescope.model import prepare

    run = faint().replace("run", frames=450, settle_frames=50)
    winds = run.atmosphere.wind_speed_m_per_s
    speeds = []
    for factor in (1 / 3, 1.0):
        blown = run.replace("atmosphere", wind_speed_m_per_s=tuple(factor * each for each in winds))
        seen, _ = seen_in_record(simulate_loop(blown, [plain()]), [plain()], 0)
        layout = replace(
            prepare(run).sensor.layout,
            subaperture_m=run.subaperture_m,
            pixel_scale_arcsec=run.pixel_scale_rad / ARCSEC,
        )
        found = {each.name: each for each in of_atmosphere(seen, layout)}
        speeds.append(found["wind"].value)
    r0 = found["r0 at 500 nm"]
    assert r0.value == pytest.approx(0.15, rel=0.25)
    assert 0 < r0.error < 0.03
    assert 6.0 < speeds[1] < 22.0
    assert 1.7 < speeds[1] / speeds[0] < 5.0
    unknown = {each.name: each for each in of_atmosphere(seen, prepare(run).sensor.layout)}
    assert "subaperture_m" in unknown["wind"].in_words()
    assert "not known" in unknown["r0 at 500 nm"].in_words()


def test_vibrations_stand_out_or_do_not() -> None:
    """Along x, 0.1 px at 40 Hz: rms 0.071; the resolution is 0.4 Hz."""
    calm, _ = seen_with_truth(frames=2400, segment=2400)
    none = [each for each in of_atmosphere(calm, LAYOUT) if each.name.startswith("vibration")]
    assert [each.value for each in none] == [0.0]
    assert "none with an rms above" in none[0].in_words()
    shaken, _ = seen_with_truth(frames=2400, segment=2400, vibration=(0.1, 40.0))
    found = [each for each in of_atmosphere(shaken, LAYOUT) if each.name == "vibration"]
    assert len(found) == 1
    assert found[0].value == pytest.approx(40.0, abs=0.4)
    assert "along x, rms 0.07" in found[0].in_words()
    short, _ = seen_with_truth(frames=400)
    assert "60 frames without a gap" in of_atmosphere(short, LAYOUT)[-1].in_words()


def test_in_words() -> None:
    assert Measured("r0", "m", 0.1534, 0.0123, "so").in_words() == "r0: 0.153 +- 0.012 m (so)"
    assert Measured("gain", "", 0.9, 0.1).in_words() == "gain: 0.9 +- 0.1"
