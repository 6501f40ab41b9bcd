from dataclasses import replace

import numpy as np
import pytest
from tests.experiments.experiment_cases import small
from tests.refusals import refused

import faintspot as fs
from faintspot.experiments.closed_loop.results import LOOP_GAIN, NOISE_SCALE, tuned_values, with_choice
from faintspot.loop.control.base import CONTROLS, INTEGRATOR
from faintspot.loop.control.identification.loop_delay import LoopDelay
from faintspot.loop.control.identification.open_loop import open_loop_of
from faintspot.loop.simulation import LoopConfiguration, Method, simulate_loop
from faintspot.loop.simulation.engine_files import fixed_window
from faintspot.loop.simulation.learning import learnt_control, recorded_loop
from faintspot.loop.simulation.methods import PRIOR
from faintspot.loop.simulation.telescope import prepare

LEARNT = [kind for kind in CONTROLS if kind != INTEGRATOR]
FAINT = (
    small()
    .replace("camera", photons_per_subaperture=40.0, read_noise_e=2.0)
    .replace("control", telemetry_frames=400)
    .replace("run", frames=300, settle_frames=50)
)
MAP = fs.Settings("map", prior_std_px=0.5)


def _method(control: str = INTEGRATOR, gain: float = 0.4) -> Method:
    return Method("map", MAP, gain, variants=("predicted",), control=control)


def test_the_integrator_is_the_recursion() -> None:
    """To the last bit: every command is the one before and what the reconstructor makes of the slopes."""
    configuration = FAINT.replace("run", frames=80, settle_frames=20)
    method = Method("plain", fs.Settings("brightest", keep_brightest=20), gain=0.35)
    record = simulate_loop(configuration, [method])
    reconstructor, latest = prepare(configuration).reconstructor, np.zeros(record.commands.shape[1])
    for frame in range(record.frames - 2):
        measured = reconstructor(record.slopes_px[frame].astype(np.float64) / record.centroid_gain[0])
        latest = (1 - 0.01) * latest - 0.35 * measured
        np.testing.assert_array_equal(record.commands[frame + 2], latest.astype(np.float32))


@pytest.mark.slow
def test_never_below_the_integrator() -> None:
    """The same slopes on the same air, of 250 scored frames: differences are paired.

    Of a run they scatter by 0.008.
    """
    plain = max(simulate_loop(FAINT, [_method(gain=gain)]).mean_strehl() for gain in (0.4, 0.6))
    for kind in LEARNT:
        assert simulate_loop(FAINT, [_method(kind)]).mean_strehl() > plain - 0.025


@pytest.mark.slow
def test_the_filter_s_certainty_is_the_estimator_s_prior() -> None:
    method, learnt = learnt_control(FAINT, _method("kalman"), 1, simulate_loop)
    assert learnt is not None
    assert learnt.expected_std_px is not None
    prior = getattr(method.settings, PRIOR)
    np.testing.assert_allclose(
        np.square(prior), np.square(learnt.expected_std_px).reshape(2, -1).mean(axis=0)
    )
    assert learnt_control(FAINT, _method("kalman"), 1, simulate_loop)[1] is learnt  # learnt once
    assert learnt_control(FAINT, _method(), 1, simulate_loop)[1] is None


@pytest.mark.slow
def test_telemetry_knows_what_was_expected() -> None:
    """Of an estimator whose prior is so narrow that it gives nothing else: open-loop slopes are -I latest."""
    method = replace(_method(), settings=fs.Settings("map", prior_std_px=1e-3))
    record = simulate_loop(FAINT.replace("run", frames=350, settle_frames=20), [method])
    telemetry = open_loop_of(recorded_loop(record, method), LoopDelay(2.0, 0.0, 1.0, 0.0)).telemetry
    assert np.isfinite(telemetry.open_loop_px).all()
    assert telemetry.trust.max() < 0.1


def test_control_needs_a_closed_loop_and_the_whole_run() -> None:
    with refused("method.control = 'kalman'", "'integrator'"):
        simulate_loop(FAINT.replace("control", mode="open"), [_method("kalman")])
    with refused("methods", "integrator"):
        simulate_loop(FAINT, [_method(), _method("kalman")], [0] * 30 + [1] * 30)
    with refused("method.control = 'pid'"):
        _method("pid")


@pytest.mark.slow
def test_true_slopes_have_no_prior() -> None:
    short = FAINT.replace("run", frames=60, settle_frames=20)
    record = simulate_loop(short, [replace(_method("kalman"), variants=("true",))])
    assert np.isfinite(record.commands).all()
    assert record.mean_strehl() > 0.5


@pytest.mark.slow
def test_the_centroid_gain_is_learnt() -> None:
    """From telemetry, within 20 % of that measured on typical spots; slopes of the run are divided by it."""
    loop = FAINT.replace("camera", photons_per_subaperture=200.0)
    method = Method("window", fixed_window(loop), control="kalman")
    with refused("telemetry_frames = 300"):
        simulate_loop(loop.replace("control", telemetry_frames=300), [method])
    loop = loop.replace("control", telemetry_frames=1500)
    _, learnt = learnt_control(loop, method, loop.run.seed, simulate_loop)
    record = simulate_loop(loop, [method])
    assert learnt is not None
    assert learnt.centroid_gain == pytest.approx(float(record.centroid_gain[0]), rel=0.2)
    assert learnt.centroid_gain < 0.9
    assert record.mean_strehl() > simulate_loop(loop, [replace(method, control=INTEGRATOR)]).mean_strehl()
    uncorrected = replace(method, variants=("uncorrected",))
    _, learnt = learnt_control(loop, uncorrected, loop.run.seed, simulate_loop)
    assert learnt is not None
    assert learnt.centroid_gain == 1.0


def test_names_of_methods_say_their_control() -> None:
    for name in ("map+kalman", "brightest+kalman", "ml+weighted+kalman"):
        assert Method.named(name).name == name
    assert Method.named("map+integrator").name == "map"
    named = Method.named("map+kalman")
    assert named.is_predicted
    assert "predictive Kalman filter" in named.label
    tuned = tuned_values(named, FAINT)
    assert {LOOP_GAIN, NOISE_SCALE} <= set(tuned)
    assert PRIOR not in tuned
    method = with_choice(named, FAINT, {name: each.first[0] for name, each in tuned.items()})
    assert (method.control, method.noise_scale) == ("kalman", tuned[NOISE_SCALE].first[0])
    with refused("method 'map+lqg' = 'lqg'"):
        Method.named("map+lqg")
    with refused("method = 'map+kalman+weighted'"):
        Method.named("map+kalman+weighted")


def test_assumed_winds_are_of_the_configuration() -> None:
    changed = FAINT.replace("control", winds="assumed")
    assert LoopConfiguration.from_text(changed.to_text()).control == changed.control
    with refused("control.winds"):
        FAINT.replace("control", winds="guessed")
