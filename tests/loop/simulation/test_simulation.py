import numpy as np
import pytest
from tests.loop.simulation.best_fit import BestFit
from tests.loop.simulation.loop_cases import PLAIN, faint, plain, quiet
from tests.refusals import refused
from tests.shared_data import skip_without

import faintspot as fs
from faintspot.loop.simulation import LoopRecord, Method, load_loop, simulate_loop
from faintspot.loop.simulation.atmosphere import make_atmosphere
from faintspot.loop.simulation.simulation import measure_gains
from faintspot.loop.simulation.telescope import make_pipeline, prepare

skip_without("hcipy")


@pytest.fixture(scope="module")
def record() -> LoopRecord:
    return simulate_loop(faint(), [plain()])


def test_shapes_and_units(record: LoopRecord) -> None:
    assert record.slopes_px.shape == (200, 72)
    assert record.valid.shape == (200, 36)
    assert record.standard_error_px.shape == (200, 72)
    assert record.commands.shape == (200, 54)
    assert record.interaction_matrix.shape == (72, 54)
    assert record.scored.sum() == 160
    assert all(np.isfinite(values).all() for values in (record.slopes_px, record.commands, record.strehl))
    np.testing.assert_array_equal(record.commands[:2], 0)  # two frames of delay
    assert np.any(record.commands[2])


def test_the_loop_closes_and_stays_closed(record: LoopRecord) -> None:
    """At 200 photons and 1 e-, r0 0.15 m, the H-band Strehl ratio is 0.5 to 0.75."""
    assert record.strehl[0] < 0.2
    assert 0.5 < record.mean_strehl() < 0.75
    assert record.strehl[40:].min() > 0.25
    assert record.residual_nm[40:].max() < 350


def test_runs_repeat_bit_for_bit(record: LoopRecord) -> None:
    told: list[tuple[int, int]] = []
    short = faint().replace("run", frames=5, settle_frames=1)
    again = simulate_loop(short, [plain()], progress=lambda *counts: told.append(counts))
    np.testing.assert_array_equal(again.slopes_px, record.slopes_px[:5])
    np.testing.assert_array_equal(again.strehl, record.strehl[:5])
    assert told == [(done, 5) for done in range(1, 6)]
    assert not np.array_equal(simulate_loop(short, [plain()], realisation=1).strehl, record.strehl[:5])


def test_methods_see_the_same_atmosphere_and_photons(record: LoopRecord) -> None:
    both = [plain(), Method("tv", fs.Settings(noise_std=1.0, keep_brightest=80))]
    schedule = np.repeat([0, 1], 20)
    mixed = simulate_loop(faint().replace("run", frames=40, settle_frames=10), both, schedule)
    np.testing.assert_array_equal(mixed.slopes_px[:20], record.slopes_px[:20])
    np.testing.assert_array_equal(mixed.strehl[:22], record.strehl[:22])  # commands act two frames later
    assert not np.array_equal(mixed.slopes_px[20], record.slopes_px[20])
    assert mixed.mean_strehl(1) == pytest.approx(mixed.strehl[20:].mean())
    assert mixed.labels == ("plain", "tv")


@pytest.mark.slow
def test_a_run_goes_on_where_another_ended() -> None:
    loop = faint().replace("control", mode="open")
    whole, end = (loop.replace("run", frames=frames, settle_frames=1) for frames in (12, 5))
    record = simulate_loop(whole, [plain()])
    later = simulate_loop(end, [plain()], first_frame=7)
    np.testing.assert_array_equal(later.slopes_px, record.slopes_px[7:])
    np.testing.assert_array_equal(later.r0_m, record.r0_m[7:])
    numbers = [0, 1, 2, 9, 11]
    parts = simulate_loop(end, [plain()], first_frame=numbers)  # frames between them are left out
    np.testing.assert_array_equal(parts.slopes_px, record.slopes_px[numbers])
    for wrong in (-1, [0, 1], [0, 1, 3, 2, 4]):
        with refused("first_frame"):
            simulate_loop(end, [plain()], first_frame=wrong)


@pytest.mark.slow
def test_the_static_error_lowers_strehl_ratios_alone() -> None:
    loop = faint().replace("run", frames=8, settle_frames=1)
    record = simulate_loop(loop, [plain()])
    worse = simulate_loop(loop.replace("science", static_error_nm=100.0), [plain()])
    factor = np.exp(-((2 * np.pi * 100.0 / 1650.0) ** 2))
    np.testing.assert_allclose(worse.strehl, factor * record.strehl, rtol=1e-12)
    np.testing.assert_array_equal(worse.commands, record.commands)


def test_slopes_follow_the_interaction_matrix() -> None:
    """Pseudo-open loop: residual slopes are those of the air plus those of the mirror.

    With true slopes; the interaction matrix is measured by centres of gravity, which differ by a few
    per cent from the mean gradient in partly lit sub-apertures.
    """
    loop = quiet().replace("run", frames=60)
    record = simulate_loop(loop, [Method("true", PLAIN, variants=("true",))], seed=4)
    atmosphere, sensor = make_atmosphere(loop, 4), prepare(loop).sensor
    frames = np.arange(20, 40)
    expected = np.array([sensor.mean_slopes_px(atmosphere.wavefront_nm((k + 0.5) / 250)) for k in frames])
    open_loop = record.slopes_px[frames] - record.commands[frames] @ record.interaction_matrix.T
    assert np.std(open_loop - expected) < 0.02 * np.std(expected)


@pytest.mark.slow
def test_noise_free_loop_lies_between_fitting_error_and_its_budget() -> None:
    """Never better than the best fit; worse by servo lag and aliasing.

    Lag: the mirror fits the wavefront of 2 frames and a little earlier, so the difference of wavefronts 1 to
    6 frames apart brackets it (an integrator of gain 0.5 lags like a pure delay of 2 + 1 / 0.5 frames).
    Aliasing adds up to 0.4 of the fitting variance (Rigaut, Veran & Lai 1998, SPIE 3353, 1038).
    """
    loop = quiet()
    record = simulate_loop(loop, [Method("true", PLAIN, variants=("true",), gain=0.5)])
    optics, atmosphere = prepare(loop), make_atmosphere(loop, loop.run.seed)
    fit = BestFit.of(optics.mirror, optics.pupil)
    fitting, lag = [], []
    for frame in range(40, 200, 5):
        now, before, long_before = (atmosphere.wavefront_nm((frame + 0.5 - late) / 250) for late in (0, 1, 6))
        left = fit.residual(now)
        fitting.append(optics.pupil.rms(left) ** 2)
        lag.append(
            [optics.pupil.rms(now - old - fit.residual(now - old)) ** 2 for old in (before, long_before)]
        )
    low, high = np.mean(lag, axis=0)
    variance = np.mean(record.residual_nm[40:] ** 2)
    assert np.mean(fitting) + low < variance < 1.4 * np.mean(fitting) + high
    marechal = np.exp(-variance * (2 * np.pi / 1650) ** 2)
    assert record.mean_strehl() == pytest.approx(marechal, abs=0.02)


@pytest.mark.slow
def test_open_loop_control() -> None:
    loop = load_loop("open_loop").replace("run", frames=50, settle_frames=25)
    settings = fs.Settings("brightest", keep_brightest=150)
    bright = loop.replace("camera", photons_per_subaperture=2000.0)
    corrected = simulate_loop(bright, [Method("corrected", settings)])
    not_corrected = simulate_loop(bright, [Method("not", settings, variants=("uncorrected",))])
    assert corrected.mean_strehl() > 0.5
    assert corrected.mean_strehl() > not_corrected.mean_strehl()
    assert corrected.loop.control.mode == "open"
    # The sensor sees the whole wavefront: slopes do not shrink when the mirror acts.
    assert np.std(corrected.slopes_px[30:]) > 0.7 * np.std(corrected.slopes_px[:3])


@pytest.mark.slow
def test_centroid_gain_falls_with_noise_and_brightest_pixels() -> None:
    loop, gains = faint(), []
    for photons, noise, kept in ((1e5, 0.0, 255), (200.0, 1.0, 80), (200.0, 3.0, 20)):
        camera = {"photons_per_subaperture": photons, "read_noise_e": noise}
        case = loop.replace("camera", **camera)
        method = Method("k", fs.Settings("brightest", keep_brightest=kept))
        pipeline = make_pipeline(case, prepare(case).sensor, method)
        gains.append(measure_gains(case, [pipeline], seed=1)[0])
    assert gains[0] == pytest.approx(0.93, abs=0.06)  # wings beyond the window
    assert gains[0] > gains[1] > gains[2] > 0.05


@pytest.mark.slow
def test_gain_correction_makes_a_loop_of_low_gain_as_fast() -> None:
    loop = faint().replace("camera", read_noise_e=3.0, photons_per_subaperture=400.0)
    loop = loop.replace("run", frames=100, settle_frames=40)
    settings = fs.Settings("brightest", keep_brightest=80)
    corrected, not_corrected = (
        simulate_loop(loop, [Method("k", settings, gain=0.3, variants=variants)])
        for variants in ((), ("uncorrected",))
    )
    assert corrected.centroid_gain[0] < 0.8
    assert corrected.mean_strehl() > not_corrected.mean_strehl()


@pytest.mark.slow
def test_invalid_sub_apertures_do_no_harm() -> None:
    loop = faint().replace("run", frames=60)
    method = Method("nothing", fs.Settings(estimator="thresholded", threshold_e=1e6))
    record = simulate_loop(loop, [method])
    assert not record.valid.any()
    np.testing.assert_array_equal(record.commands, 0)


def test_impossible_runs_are_refused() -> None:
    for methods, schedule, word in (
        ([], None, "methods"),
        ([plain()], [0, 1], "schedule = 1"),
        ([plain()], [[0]], "schedule"),
        ([plain()] * 2, [0.5], "whole number"),
    ):
        with refused(word):
            simulate_loop(faint(), methods, schedule)
    with refused("commands", "72 slopes"):
        prepare(quiet().replace("mirror", actuators=12))


@pytest.mark.slow
def test_eight_metres_are_made() -> None:
    """The optics of a large telescope, with fewer sub-apertures so that it takes seconds."""
    loop = load_loop("eight_metre").replace("sensor", subapertures=16, pixels=6)
    assert len(prepare(loop).sensor.layout) > 150
