from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.experiment_cases import HERE, StopsAfter, assert_same_files, small
from tests.refusals import refused
from tests.shared_data import skip_without

from faintspot.experiments.night.protocol import Night, NightPlan
from faintspot.experiments.night.simulated import r0_of_slopes, run_night
from faintspot.experiments.running import WorkerPool
from faintspot.loop.simulation import simulate_loop
from faintspot.loop.simulation.record import slope_turbulence

skip_without("hcipy")
pytest.importorskip("zarr")

SETS: dict[str, Any] = {"strengths": (2, 3), "em_fractions": (1.0, 0.75), "repeats": (2, 1)}
PLAN = NightPlan(block_frames=60, settle_in_block=20, gap_frames=0, strongest=1.0, keep_brightest=12, **SETS)
LOOP = small().replace("atmosphere", r0_m=(0.1, 0.2), drift_time_s=2.0).replace("camera", em_gain=100.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a night that was not interrupted."""
    folder = tmp_path_factory.mktemp("night")
    night = run_night(LOOP, folder, plan=PLAN, pool=HERE)
    np.testing.assert_array_equal(Night.load(folder / "night.npz").strehl, night.strehl)
    return folder


@pytest.mark.slow
def test_a_night_is_what_the_loop_does(whole: Path) -> None:
    night = Night.load(whole / "night.npz")
    assert len(night.strehl) == 2 * 3 + 4
    assert night.labels == ("no TV", "TV 0 e-", "TV 1 e-", "TV 0.5 e-")
    np.testing.assert_array_equal(night.method, [0, 1, 2, 0, 1, 2, 0, 1, 3, 2])
    np.testing.assert_array_equal(night.set_number, [0] * 6 + [1] * 4)
    rate = LOOP.control.frame_rate_hz
    np.testing.assert_allclose(night.start_s, (60 * np.arange(10) + 20) / rate)
    np.testing.assert_array_equal(night.strength, [np.nan, 0, 1, np.nan, 0, 1, np.nan, 0, 0.5, 1])
    np.testing.assert_allclose(night.duration_s, 40 / rate)
    assert night.hours == pytest.approx(600 / rate / 3600)
    assert night.paired_strehl[6] == night.strehl[6]  # the first of the second set
    assert night.paired_strehl[5] != night.strehl[5]
    # The first block of the reference has seen nothing else, so that it is the reference's own run.
    assert night.paired_strehl[0] == night.strehl[0]
    first = PLAN.configuration(LOOP, 0).replace("run", frames=60)
    alone = simulate_loop(first, PLAN.made(first, 0)[:1])
    assert night.strehl[0] == pytest.approx(alone.strehl[20:].mean())
    assert night.true_r0_m[0] == pytest.approx(np.mean(alone.r0_m[20:] ** (-5 / 3)) ** (-3 / 5))
    phase = (2e-9 * np.pi / night.wavelength_m) ** 2 * np.square(alone.residual_nm[20:])
    assert night.phase_rad2[0] == pytest.approx(phase.mean())
    pieces = alone.strehl[20:].reshape(10, 4).mean(axis=1)
    assert night.strehl_error[0] == pytest.approx(pieces.std(ddof=1) / np.sqrt(10))
    pieces = (2e-9 * np.pi / night.wavelength_m) ** 2 * np.square(alone.residual_nm[20:].reshape(10, 4))
    assert night.phase_error_rad2[0] == pytest.approx(pieces.mean(axis=1).std(ddof=1) / np.sqrt(10))
    # The same turbulence without the mirror: 40 frames and other noise, 0.5 % apart; 25 % if added to it.
    seen = simulate_loop(first.replace("control", mode="open"), PLAN.made(first, 0)[:1])
    site = slope_turbulence(first, seen.cells)
    slopes = seen.slopes_px[20:] / seen.centroid_gain[0]
    r0_m, _ = r0_of_slopes(slopes, slopes, site, first.atmosphere.outer_scale_m)
    assert night.r0_m[0] == pytest.approx(r0_m, rel=0.05)
    # The second set goes on where the first ended.
    second = PLAN.configuration(LOOP, 1).replace("run", frames=60)
    later = simulate_loop(second, PLAN.made(second, 1)[:1], first_frame=360)
    assert night.strehl[6] == pytest.approx(later.strehl[20:].mean())
    assert np.isfinite(night.r0_m).sum() >= 8
    assert ((night.r0_m > 0.3 * night.true_r0_m) & (night.r0_m < 3 * night.true_r0_m))[
        np.isfinite(night.r0_m)
    ].all()


@pytest.mark.slow
def test_an_interrupted_night_goes_on(tmp_path: Path, whole: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_night(LOOP, tmp_path, plan=PLAN, pool=WorkerPool(0, StopsAfter(500)))
    assert not (tmp_path / "night.zarr").exists()
    run_night(LOOP, tmp_path, plan=PLAN, pool=HERE)
    assert_same_files(whole, tmp_path)
    with refused("--overwrite"):
        run_night(LOOP, tmp_path, plan=replace(PLAN, keep_brightest=9), pool=HERE)


@pytest.mark.slow
def test_in_open_loop(tmp_path: Path) -> None:
    loop = LOOP.replace("control", mode="open")
    night = run_night(loop, tmp_path, plan=replace(PLAN, repeats=(1, 1)), pool=HERE)
    assert np.isfinite(night.strehl).all()
