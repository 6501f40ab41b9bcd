"""What a recording of a loop tells: within its errors of a truth that is known, and what it does not tell."""

import math
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.loop.control.driven import driven, oscillator
from tests.loop.telemetry.loop_cases import AIR, LOOP_GAIN, NOISE_PX, RATE_HZ, recorded
from tests.refusals import refused

from faintspot.base.text_files import parse_json, to_json
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import Measured, open_loop_of
from faintspot.loop.control.identification.vibrations import Vibration
from faintspot.loop.telemetry.choices import AS_RUN, BEST, FILTER
from faintspot.loop.telemetry.page import page_of_loop
from faintspot.loop.telemetry.report import LoopReport, Part, _noise, _vibrations, report_of_loop

FRAMES = 1300


@pytest.fixture(scope="module")
def report() -> LoopReport:
    """Report of a loop that lost frames 1000 to 1019."""
    loop: Any = recorded().part(slice(0, FRAMES))
    kept = np.delete(np.arange(len(loop.slopes)), slice(1000, 1020))
    return report_of_loop(
        replace(loop, slopes=loop.slopes[kept], frame=loop.frame[kept], commands=loop.commands[kept])
    )


def value(report: LoopReport, part: str, name: str) -> Measured:
    return next(each for each in report.parts[part].values if each.name == name)


def numbers(values: Any) -> Iterator[dict[str, Any]]:
    """Yield every measured value within plain values."""
    if isinstance(values, dict):
        if "low" in values:
            yield values
        for each in values.values():
            yield from numbers(each)
    elif isinstance(values, list):
        for each in values:
            yield from numbers(each)


@pytest.mark.slow
def test_what_is_measured_is_true_within_its_errors(report: LoopReport) -> None:
    """Noise to 5 %: turbulence within two frames is no parabola; winds to 1 m/s.

    r0 within three errors, as ten seconds hold few independent wavefronts.
    """
    assert value(report, "frames", "lost frames").value == value(report, "frames", "longest gap").value == 20
    assert value(report, "frames", "duration").value == pytest.approx(FRAMES / RATE_HZ)
    delay = value(report, "loop", "delay")
    assert abs(delay.value - 2) < 3 * delay.error < 0.8
    assert value(report, "loop", "actuators that reached a limit").value == 0
    assert value(report, "noise", "noise of a slope").value == pytest.approx(NOISE_PX, rel=0.05)
    assert report.noise_px == pytest.approx(np.full(50, NOISE_PX), rel=0.2)
    r0 = value(report, "turbulence", "r0 at 500 nm")
    assert abs(r0.value - AIR.r0_m) < 3 * r0.error < 0.1
    for number, wind in enumerate(AIR.wind_m_per_s, 1):
        speed = value(report, "turbulence", f"layer {number}: speed").value
        direction = math.radians(value(report, "turbulence", f"layer {number}: direction").value)
        np.testing.assert_allclose([speed * math.cos(direction), speed * math.sin(direction)], wind, atol=1.0)
    found = list(numbers(parse_json(to_json(report.as_values(), exact=True))))
    assert len(found) > 40
    for each in found:
        assert each["value"] is None or each["low"] <= each["value"] <= each["high"]


def test_an_uncertain_delay_makes_the_noise_uncertain() -> None:
    """By as much as the noise differs for a delay that is earlier by its error."""
    loop: Any = recorded()
    loop, found = loop.part(slice(0, 1200)), []
    for delay, error in ((1.6, 0.0), (2.0, 0.0), (2.0, 0.4)):
        report = LoopReport(loop, defaultdict(lambda: Part("")))
        _noise(report, LoopDelay(delay, error, 1.0, 0.0))
        found.append(value(report, "noise", "noise of a slope"))
    earlier, known, uncertain = found
    assert uncertain.value == known.value
    assert uncertain.error == pytest.approx(math.hypot(known.error, known.value - earlier.value))
    assert uncertain.error > 2 * known.error


def test_a_fast_vibration_is_no_noise() -> None:
    """A tip of 90 Hz at 250 frames/s is no parabola within five frames."""
    loop: Any = recorded()
    slopes = loop.slopes.copy()
    slopes[:, :25] += 0.6 * np.sin(2 * np.pi * 90 / RATE_HZ * loop.frame)[:, None]
    known = LoopDelay(2.0, 0.0, 1.0, 0.0)
    noise = np.sqrt(open_loop_of(replace(loop, slopes=slopes), known).variance)
    assert noise == pytest.approx(np.full(50, NOISE_PX), rel=0.2)
    assert np.sqrt(np.square(noise).mean()) == pytest.approx(NOISE_PX, rel=0.03)


@pytest.mark.slow
def test_numbers_that_follow_from_others(report: LoopReport) -> None:
    def turbulence(name: str) -> Measured:
        return value(report, "turbulence", name)

    noise, tilt = (value(report, "noise", name) for name in ("noise of a slope", "tilt over a sub-aperture"))
    to_nm = np.deg2rad(0.2 / 3600) * 0.6 * 1e9  # px of 0.2 arcsec, over 0.6 m
    assert (tilt.value, tilt.error) == pytest.approx((to_nm * noise.value, to_nm * noise.error))
    r0, seeing = turbulence("r0 at 500 nm"), turbulence("seeing at 500 nm")
    assert seeing.value == pytest.approx(0.98 * np.rad2deg(500e-9 / r0.value) * 3600)
    assert seeing.error / seeing.value == pytest.approx(r0.error / r0.value)
    layers = [(turbulence(f"layer {k}: speed"), turbulence(f"layer {k}: share")) for k in (1, 2)]
    mean = sum(share.value * speed.value ** (5 / 3) for speed, share in layers) ** 0.6
    wind = turbulence("wind speed, mean for the coherence time")
    assert wind.value == pytest.approx(mean)
    parts = []
    for speed, share in layers:
        ratio = speed.value / mean
        of_speed = share.value * ratio ** (2 / 3) * speed.error
        parts.append((of_speed, 0.6 * mean * (ratio ** (5 / 3) - 1) * share.error))
    assert wind.error == pytest.approx(np.linalg.norm(parts), rel=0.2)  # of 1000 draws
    time = turbulence("coherence time at 500 nm")
    assert time.value == pytest.approx(1e3 * 0.314 * r0.value / mean)
    assert time.error / time.value == pytest.approx(np.hypot(r0.error / r0.value, wind.error / mean))


@pytest.mark.slow
def test_strehl_ratios_are_those_of_the_whole_residual(report: LoopReport) -> None:
    """Fitting 0.28 and aliasing 0.08 rad^2 at r0 = the sub-aperture's side, at 500 nm."""
    r0 = value(report, "turbulence", "r0 at 500 nm")
    unseen_nm2 = (500 / (2 * np.pi)) ** 2 * 0.36 * (0.6 / r0.value) ** (5 / 3)
    for choice in report.choices:
        residual, total = choice.residual, choice.total
        if not math.isfinite(residual.value):
            continue
        assert total.value**2 == pytest.approx(residual.value**2 + unseen_nm2)
        assert choice.strehl.value == pytest.approx(np.exp(-((2 * np.pi * total.value / 1650) ** 2)))
        # In variance: of the replay, and of the fitting error by its coefficient (0.04) and by r0.
        of_fitting = unseen_nm2 * np.hypot(0.04 / 0.36, 5 / 3 * r0.error / r0.value)
        variance_error = np.hypot(2 * residual.value * residual.error, of_fitting)
        assert 2 * total.value * total.error == pytest.approx(variance_error, rel=1e-6)


@pytest.mark.slow
def test_vibrations_in_nm_are_those_of_the_wavefront(report: LoopReport) -> None:
    """A tip of slope s over a round pupil of diameter D has an rms of s D / 4; y slopes do not move."""
    found: Any = replace(report, parts=dict(report.parts))
    lines = [Vibration(mode, 40.0, 0.01, 0.1, 0.2, 0.02) for mode in ("tip", "focus")]
    found.parts["vibrations"] = Part("")
    _vibrations(found, replace(found.turbulence, vibrations=tuple(lines)))
    tip, focus = (value(found, "vibrations", f"rms of {mode}") for mode in ("tip", "focus"))
    unit = found.loop.unit  # in which slopes have an rms of 1
    rms_nm = np.sqrt(2) * 0.1 * unit * np.deg2rad(0.2 / 3600) * 3.0 / 4 * 1e9
    assert (tip.value, tip.error) == pytest.approx((rms_nm, 0.2 * rms_nm))
    assert (focus.value, focus.error) == pytest.approx((0.1 * unit, 0.02 * unit))
    assert (tip.unit, focus.unit) == ("nm", "px")


@pytest.mark.slow
def test_filter_leaves_less_than_the_best_integrator(report: LoopReport) -> None:
    """The filter leaves less than the best integrator; an integrator of the loop's gain leaves as much."""
    found = {each.name: each for each in report.choices if each.name != "integrator"}
    assert found[FILTER].residual.value < found[BEST].residual.value
    curve = [each for each in report.choices if each.name == "integrator"]
    like = min(curve, key=lambda each: abs(each.gain - LOOP_GAIN))
    assert like.residual.value == pytest.approx(found[AS_RUN].residual.value, rel=0.1)
    assert 0 < found[FILTER].strehl.value < 1


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn_pictures")
def test_dead_and_rarely_measured_sub_apertures() -> None:
    """They have no noise, for a reason that is given, and what the others show stays."""
    loop: Any = recorded().part(slice(0, 1200))
    slopes = loop.slopes.copy()
    slopes[:, [3, 28]] = np.nan
    slopes[np.arange(len(slopes)) % 50 > 0, 7] = np.nan
    found: Any = report_of_loop(replace(loop, slopes=slopes))
    assert np.flatnonzero(np.isnan(found.noise_px)).tolist() == [3, 7, 28]
    assert value(found, "noise", "noise of a slope").value == pytest.approx(NOISE_PX, rel=0.05)
    assert {choice.name for choice in found.choices} >= {AS_RUN, BEST, FILTER}
    plain = parse_json(to_json(found.as_values()))
    assert [k for k, noise in enumerate(plain["noise"]["of_slopes"]) if noise is None] == [3, 7, 28]
    assert "five consecutive frames" in plain["noise"]["of_slopes_unknown"]
    assert all(math.isfinite(each["value"]) for each in numbers(plain["choices"]))
    assert "5 % intervals" in page_of_loop(found).html()


@pytest.mark.slow
def test_what_is_unknown_has_a_reason() -> None:
    found: Any = report_of_loop(replace(recorded().part(slice(0, 250)), pixel_scale_arcsec=None))
    unknown = [each for each in numbers(parse_json(to_json(found.as_values()))) if None in each.values()]
    assert {each["name"] for each in unknown} >= {"r0 at 500 nm", "delay"}
    assert all(each["remark"] for each in unknown)


def test_limits_of_actuators() -> None:
    loop: Any = recorded().part(slice(0, 150))
    limit = float(np.quantile(np.abs(loop.commands), 0.99))
    clipped = replace(loop, commands=np.clip(loop.commands, -limit, limit), largest_command=limit)
    found = value(report_of_loop(clipped), "loop", "actuators that reached a limit")
    assert found.value == np.count_nonzero((np.abs(loop.commands) >= limit).any(axis=0))


def test_what_is_missing_has_a_reason() -> None:
    """Without commands, of few frames; constant slopes are refused."""
    loop: Any = recorded().part(slice(0, 600))
    report = report_of_loop(replace(loop, commands=None, interaction_matrix=None))
    assert "no commands" in report.parts["turbulence"].missing
    assert not report.parts["turbulence"].values
    assert not report.choices
    report = report_of_loop(loop.part(slice(0, 50)))
    assert all("48 frames" in report.parts[name].missing for name in ("noise", "turbulence", "choices"))
    with refused("slopes"):
        report_of_loop(replace(loop, slopes=np.full_like(loop.slopes, 0.1)))


@pytest.mark.slow
def test_open_loop_has_noise_and_no_delay() -> None:
    """An open loop has no delay; its turbulence is known all the same."""
    loop: Any = recorded()
    held = np.zeros_like(loop.slopes)
    held[2:] = (loop.commands @ loop.interaction_matrix.T)[:-2]
    rows = slice(2, 602)
    still = replace(
        loop, slopes=(loop.slopes - held)[rows], frame=loop.frame[rows], commands=np.zeros((600, 36))
    )
    report = report_of_loop(still)
    assert "open" in report.parts["loop"].missing
    assert value(report, "noise", "noise of a slope").value == pytest.approx(NOISE_PX, rel=0.05)
    assert report.parts["turbulence"].values


@pytest.mark.slow
def test_large_slopes_not_measured() -> None:
    """Without the largest third of the slopes the others tell no turbulence."""
    loop: Any = recorded()
    loop = loop.part(slice(0, 600))
    large = np.abs(loop.slopes) > np.quantile(np.abs(loop.slopes), 0.67)
    report = report_of_loop(replace(loop, slopes=np.where(large, np.nan, loop.slopes)))
    for name in ("turbulence", "vibrations", "spectra", "choices"):
        assert "33% of the slopes" in report.parts[name].missing
    assert not report.parts["turbulence"].values


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn_pictures")
def test_a_single_sub_aperture() -> None:
    """Neither delay, winds nor r0 are known; vibrations and other choices are."""
    rng = np.random.default_rng(3)
    frames = 4000
    moving = [
        driven(rng, frames, 500.0, 2, oscillator(1.5, 0.5, 1.0), oscillator(20, 0.002, 0.4)) for _ in "xy"
    ]
    slopes, commands = 0.3 * rng.standard_normal((frames, 2)), np.zeros((frames, 2))
    for frame in range(frames):
        slopes[frame] += np.array(moving)[:, frame] + commands[max(frame - 2, 0)]
        commands[frame] = commands[frame - 1] - 0.2 * slopes[frame]
    loop = replace(
        recorded(),
        slopes=slopes,
        frame=np.arange(frames),
        cells=np.zeros((1, 2), np.int64),
        commands=commands,
        interaction_matrix=np.eye(2),
        frame_rate_hz=500.0,
    )
    found: Any = report_of_loop(loop)
    delay = value(found, "loop", "delay")
    assert abs(delay.value - 2) < 3 * delay.error < 0.6
    assert not found.parts["turbulence"].values
    assert found.parts["turbulence"].missing
    assert value(found, "vibrations", "frequency of tip").value == pytest.approx(20.0, abs=0.3)
    left = {each.name: each.residual for each in found.choices}
    assert left[FILTER].value + left[FILTER].error < left[BEST].value
    assert "Strehl ratio<" not in page_of_loop(found).html()
