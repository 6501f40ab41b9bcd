"""A short night from end to end: telescope, engine, recorder, and what telemetry says of the methods."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from tests.shared_data import skip_without

import faintspot as fs
from faintspot.engine.settings.interleaving import Interleaving
from faintspot.engine.telemetry.recorder import Recorder
from faintspot.experiments.night.recorded import recorded_night
from faintspot.experiments.night.recorded_methods import MeasuredStrehl
from faintspot.loop.simulation import Method, simulate_loop

pytest.importorskip("pyshmem")
pytest.importorskip("zarr")

from tests.engine.closed_loop import CONFIGURATION, Sky, configured, make_engine

skip_without("hcipy")

pytestmark = pytest.mark.slow

EVERY, TURNS = 30, 28
FRAMES = EVERY * TURNS
SETTLE = 2 + 6  # the delay, and 3 over the loop gain of 0.5


def test_a_night_agrees_with_the_simulation(sky: Sky, tmp_path: Path) -> None:
    """The recorded methods have the Strehl ratios of `simulate_loop` with the same turbulence and schedule.

    Estimated ones have the errors that are stated, and a scale that is good to 30 %: fitting and aliasing are
    from theory, and the centroid gain is stated.
    """
    settings = fs.Settings("tv", noise_std=1.0, keep_brightest=20)
    path, control = configured(tmp_path, settings)
    gain = float(control.options.gain / control.options.centroid_gain)
    without = fs.Settings("brightest", keep_brightest=20)
    made = [
        Method(label, each, gain=gain, variants=("uncorrected",))
        for label, each in (("none", without), ("tv:1", settings))
    ]
    run = CONFIGURATION.replace("run", frames=FRAMES, settle_frames=0)
    simulated = simulate_loop(run, made, np.arange(FRAMES) // EVERY % 2)
    engine = make_engine(sky.name, path, control, interleaving=Interleaving.parse("none,tv:1", EVERY))
    sky.start(engine)
    sky.loop.close()
    recorder = Recorder(sky.name, tmp_path / "night.zarr")
    recording = threading.Thread(target=recorder.run, kwargs={"n_frames": FRAMES})
    recording.start()
    truth = [sky.frame() for _ in range(FRAMES)]
    recording.join(60)
    assert not recording.is_alive()
    strehl = np.array([each["strehl"] for each in truth])
    scored = np.arange(FRAMES) % EVERY >= SETTLE
    of_method = [scored & (np.arange(FRAMES) // EVERY % 2 == method) for method in (0, 1)]
    for rows in of_method:
        assert strehl[rows].mean() == pytest.approx(simulated.strehl[rows].mean(), abs=0.02)
    exposure_s = 1 / CONFIGURATION.control.frame_rate_hz
    begun_s = np.array([each["begun_s"] for each in truth]) + time.time() - time.monotonic()
    measured = MeasuredStrehl(begun_s + exposure_s / 2, strehl, np.full(FRAMES, exposure_s))
    system = tmp_path / "system.toml"
    system.write_text(f"science_wavelength_m = {CONFIGURATION.science.wavelength_m}\n")
    found = recorded_night(tmp_path / "night.zarr", system=system, strehl=measured)
    assert found.night.labels == ("none", "tv:1")
    assert found.settle_frames == (SETTLE, SETTLE)
    assert found.turns == TURNS
    estimated = recorded_night(tmp_path / "night.zarr", system=system).night
    for method, rows in enumerate(of_method):
        of_blocks = found.night.method == method
        assert np.nanmean(found.night.strehl[of_blocks]) == pytest.approx(strehl[rows].mean(), abs=0.02)
        true = -np.log(strehl[rows].mean())
        assert np.mean(estimated.phase_rad2[of_blocks]) == pytest.approx(true, rel=0.3)
