"""A night from a recording: what differs between methods is found, and what cannot be used is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.night.recorded_cases import BEGIN_S, write_recording
from tests.loop.telemetry.alternation_cases import (
    DELAY,
    LOOP_GAIN,
    MATRIX,
    PIXEL_ARCSEC,
    RATE_HZ,
    SIDE,
    SUBAPERTURE_M,
    KnownLoop,
    alternating,
)
from tests.refusals import refused

from faintspot.base.report.page import Table
from faintspot.experiments.night import recorded as from_recording
from faintspot.experiments.night.analysis import differences
from faintspot.experiments.night.recorded import recorded_night, text_of_recording
from faintspot.experiments.night.recorded_methods import MeasuredStrehl, read_strehl
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.sensor.layout import Layout

pytest.importorskip("zarr")

LAYOUT = Layout.grid((SIDE, SIDE), pixels=8, pixel_scale_arcsec=PIXEL_ARCSEC, subaperture_m=SUBAPERTURE_M)
OPTIONS = ControlOptions(gain=LOOP_GAIN, delay_frames=DELAY)
SETTLE = DELAY + 8  # and 3 / 0.4 frames, rounded up
METHODS = ("none", "tv:0.6")


def stored(folder: Path, known: KnownLoop, methods: tuple[str, ...] = METHODS, **options: Any) -> Path:
    folder.mkdir(exist_ok=True)
    loop, path, layout = known.loop, folder / "night.zarr", options.pop("layout", LAYOUT)
    measured = loop.slopes, loop.commands, loop.method, methods
    return write_recording(path, layout, *measured, MATRIX, rate_hz=RATE_HZ, options=OPTIONS, **options)


def drifting_strehl(frames: int, effect: float, seed: int) -> MeasuredStrehl:
    """Return Strehl ratios of frames in seeing that drifts over seconds; method 1 adds `effect`."""
    rng = np.random.default_rng(seed)
    walk = np.zeros(frames // 50)
    for block in range(1, len(walk)):
        walk[block] = 0.97 * walk[block - 1] + 0.02 * rng.standard_normal()
    turn = np.repeat(walk, 50)
    method = np.arange(frames) // 50 % 2
    strehl = 0.4 + turn + effect * method + 0.02 * rng.standard_normal(frames)
    return MeasuredStrehl(
        np.asarray(BEGIN_S + (np.arange(frames) - 1.5) / RATE_HZ, np.float64),
        np.clip(strehl, 0.0, 1.0).astype(np.float64),
        np.full(frames, 1 / RATE_HZ),
    )


def test_the_difference_of_residual_phase_is_found(tmp_path: Path) -> None:
    known = alternating(4000, noise_px=(0.15, 0.05))
    path = stored(tmp_path, known, ("integrator", "set+integrator"))
    assert from_recording.alternates(path)
    recorded = recorded_night(path)
    night = recorded.night
    assert night.labels == ("integrator", "set+integrator")
    assert recorded.settle_frames == (SETTLE, SETTLE)
    assert recorded.gains.gain.tolist() == [1.0, 1.0]  # the same slopes, other controllers
    assert not recorded.methods.leaning
    assert recorded.turns == 80
    scored = np.arange(4000) % 50 >= SETTLE
    wave = (2 * np.pi / night.wavelength_m) ** 2
    true = [wave * known.phase_m2[scored & (known.loop.method == method)].mean() for method in (0, 1)]
    (found,) = from_recording.phase_differences(recorded)
    assert found.measured.low < true[1] - true[0] < found.measured.high < 0
    # Not only in difference; fitting and aliasing, which slopes do not show, are added.
    unseen = 0.36 * (SUBAPERTURE_M / night.r0_m) ** (5 / 3) * (500e-9 / night.wavelength_m) ** 2
    seen = night.phase_rad2 - unseen
    for method in (0, 1):
        of_method = seen[night.method == method]
        error = night.phase_error_rad2[night.method == method]
        assert abs(of_method.mean() - true[method]) < 4 * np.sqrt(np.square(error).sum()) / len(error)
    np.testing.assert_allclose(night.strehl, np.exp(-night.phase_rad2))
    np.testing.assert_allclose(night.strehl_error, night.strehl * night.phase_error_rad2)
    together = recorded.turns_in_block
    np.testing.assert_allclose(night.duration_s, together * (50 - SETTLE) / RATE_HZ, rtol=1e-6)
    assert night.overhead_s == pytest.approx(together * SETTLE / RATE_HZ)
    assert night.hours == pytest.approx(4000 / RATE_HZ / 3600)
    # A block's middle is the mean of its frames: of turns 0, 2, ... and of turns 1, 3, ...
    middle_s = np.arange(2) * 50 / RATE_HZ + ((together - 1) * 50 + 0.5 * (SETTLE + 49)) / RATE_HZ
    np.testing.assert_allclose(night.middle_s[:2], middle_s - SETTLE / RATE_HZ, atol=1e-6)
    np.testing.assert_array_equal(night.r0_m[::2], night.r0_m[1::2])  # of all methods together
    summary = from_recording.summary_of_recording(recorded)
    json.dumps(summary, allow_nan=False)
    assert summary["settle_frames"] == {"integrator": SETTLE, "set+integrator": SETTLE}
    assert "estimated from slopes" in text_of_recording(recorded)


@pytest.mark.slow
def test_measured_strehl_ratios(tmp_path: Path) -> None:
    known, effect = alternating(3000), 0.03
    path = stored(tmp_path, known)
    measured = drifting_strehl(3000, effect, 4)
    recorded = recorded_night(path, strehl=measured)
    night = recorded.night
    assert night.strength.tolist() == pytest.approx([np.nan, 0.6] * (len(night.strehl) // 2), nan_ok=True)
    found = differences(night)[0].measured
    assert found.low < effect < found.high
    assert 0.05 * effect < found.standard_error < effect / 3
    first = night.strehl[0] * recorded.turns_in_block
    turns = [
        measured.strehl[100 * cycle + SETTLE : 100 * cycle + 50] for cycle in range(recorded.turns_in_block)
    ]
    assert first == pytest.approx(np.sum([turn.mean() for turn in turns]), abs=0.01 * len(turns))
    assert "were measured" in text_of_recording(recorded)


@pytest.mark.slow
def test_intervals_hold_in_drifting_seeing(tmp_path: Path) -> None:
    """Of 12 nights 11.4 +- 0.8 are expected to hold; 8 or fewer have a probability of 0.2 %."""
    path = stored(tmp_path, alternating(2000))
    held = 0
    for seed in range(12):
        night = recorded_night(path, strehl=drifting_strehl(2000, 0.03, seed)).night
        found = differences(night)[0].without_r0
        held += found.low < 0.03 < found.high
    assert held >= 9


@pytest.mark.slow
def test_slopes_of_other_centroid_gains_tell_the_same_phase(tmp_path: Path) -> None:
    """Method 1 sees 0.8 of a displacement: unnoticed, its phase would come out 36 % smaller."""
    known = alternating(4000, 25, gains=(1.0, 0.8), noise_px=(0.03, 0.03))
    recorded = recorded_night(stored(tmp_path, known), settle_frames=10)
    night, ratio = recorded.night, recorded.gains.gain[1]
    assert ratio == pytest.approx(0.8, rel=0.1)
    wave = (2 * np.pi / night.wavelength_m) ** 2
    unseen = 0.36 * (SUBAPERTURE_M / night.r0_m) ** (5 / 3) * (500e-9 / night.wavelength_m) ** 2
    scored = np.arange(4000) % 25 >= 10
    # The mean gain, of the logarithms, is the one that [control] states: 1.
    for method, gain in ((0, 1 / np.sqrt(ratio)), (1, np.sqrt(ratio))):
        true = wave * known.phase_m2[scored & (known.loop.method == method)].mean()
        found = (night.phase_rad2 - unseen)[night.method == method].mean()
        assert found == pytest.approx(true * ((1.0, 0.8)[method] / gain) ** 2, rel=0.05)
    shared = recorded.shared_phase_error_rad2[night.method == 1]
    seen = (night.phase_rad2 - unseen)[night.method == 1]
    np.testing.assert_allclose(shared, 2 * seen * recorded.gains.error[1] / ratio, rtol=1e-6)
    assert night.shared_error is not None
    other = night.method == 1
    np.testing.assert_allclose(night.shared_error[other], shared * night.strehl[other])
    assert not night.shared_error[~other].any()


def test_conditions_make_sets(tmp_path: Path) -> None:
    changes = [
        {"frame": 0, "number": 0, "changes": {"loop": "closed", "gain": 0.4}, "where": None},
        {"frame": 900, "number": 1, "changes": {"flux_e": 12.0}, "where": None},
        {"frame": 1500, "number": 2, "changes": {"keep_brightest": 9}, "where": None},
        {"frame": 2000, "number": 2, "changes": {"loop": "closed", "gain": 0.2}, "where": None},
    ]
    recorded = recorded_night(stored(tmp_path, alternating(3000), changes=changes))
    assert recorded.night.set_names == ("as begun", "keep_brightest = 9", "gain = 0.2")
    assert recorded.settle_frames == (DELAY + 15,) * 2  # 3 / 0.2
    assert recorded_night(tmp_path / "night.zarr", settle_frames=5).settle_frames == (5, 5)


@pytest.mark.slow
def test_slopes_that_lean_on_a_prediction(tmp_path: Path) -> None:
    path = stored(tmp_path, alternating(6000, 150), ("map+integrator", "map+kalman"))
    recorded = recorded_night(path)
    assert recorded.settle_frames == (SETTLE, 100)
    assert recorded.methods.leaning == ("map+kalman",)
    assert "too small a residual" in text_of_recording(recorded)


@pytest.mark.slow
def test_page_of_a_night_lists_its_blocks(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    page = from_recording.page_of_recording(recorded_night(stored(tmp_path, alternating(3000))))
    assert [section.name for section in page.sections][-2:] == ["phase", "blocks"]
    blocks = page.sections[-1]
    assert "60 turns" in str(blocks.parts)
    (table,) = (part for part in blocks.parts if isinstance(part, Table))
    assert [row[0] for row in table.rows] == list(METHODS)


def test_what_cannot_be_compared(tmp_path: Path) -> None:
    known = alternating(600)
    path = stored(tmp_path, known)
    with refused("settle_frames = 0"):
        recorded_night(path, settle_frames=0)
    with refused("night.zarr: none: 0 turns", "--every"):
        recorded_night(path, settle_frames=48)
    wrong_times = MeasuredStrehl(np.arange(9.0), np.full(9, 0.3), np.zeros(9))
    with refused("no exposure lies within", "Unix times"):
        recorded_night(path, strehl=wrong_times)
    assert not from_recording.alternates(stored(tmp_path / "open", known, loop=1))
    unknown = stored(tmp_path / "unknown", known, layout=Layout.grid((SIDE, SIDE), pixels=8))
    with refused("subaperture_m or diameter_m: unknown", "--system"):
        recorded_night(unknown)
    system = tmp_path / "system.toml"
    system.write_text("subaperture_m = 0.6\npixel_scale_arcsec = 0.1\nscience_wavelength_m = 2.2e-6\n")
    assert recorded_night(unknown, system=system).night.wavelength_m == pytest.approx(2.2e-6)


def test_file_of_strehl_ratios(tmp_path: Path) -> None:
    path = tmp_path / "times.csv"
    path.write_text("time_s,strehl\n12,0.3\n10,0.25\n")
    found = read_strehl(path)
    assert (found.time_s.tolist(), found.strehl.tolist()) == ([10.0, 12.0], [0.25, 0.3])
    path.write_text("10,0.25,2\n13,0.3,2\n")
    assert read_strehl(path).of_interval(8.5, 14.5).tolist() == [0.25, 0.3]
    assert read_strehl(path).of_interval(9.5, 14.5).tolist() == [0.3]  # the first exposure began before
    for text in ("", "10\n", "10,1.3\n", "10,nan\n", "10,0.3,-1\n", "1,2,3,4\n"):
        path.write_text(text)
        with refused("times.csv"):
            read_strehl(path)
    with refused("absent.csv"):
        read_strehl(tmp_path / "absent.csv")
