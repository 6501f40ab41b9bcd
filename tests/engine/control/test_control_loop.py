"""A mirror never gets a command that is not a finite number, whatever the files of [control] hold."""

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from tests.loop.control.control_cases import FRAME_S, INTERACTION, PLANT, TURBULENCE, telemetry
from tests.patience import examples

from faintspot.base.errors import InputError
from faintspot.engine.control.control_loop import ControlLoop
from faintspot.engine.frames.workers import SlopePrior
from faintspot.loop.control import integrator
from faintspot.loop.control.base import CONTROLS, INTEGRATOR
from faintspot.loop.control.configuration import Control
from faintspot.loop.control.identification.learning import learn_controller
from faintspot.loop.control.identification.model import Kalman
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.kernels.products import add_slopes
from faintspot.slopes.pipeline.slopes import RESULT_TYPES, Slopes
from faintspot.slopes.sensor.layout import Layout

LAYOUT = Layout.grid((3, 3), pixels=8)
N, COMMANDS = len(LAYOUT), INTERACTION.shape[1]
FRAMES = 12
EXTREMES = (0.0, 5e-324, 1e-160, 1e-30, 1e-8, 1e-3, 0.1, 2.0, 1e3, 1e6, 1e12, 1e160, 1e308)


@cache
def learnt() -> Kalman:
    return learn_controller(PLANT, telemetry(200, 0.3), TURBULENCE, 1 / FRAME_S)


def scaled(draw: Any, array: np.ndarray) -> np.ndarray:
    """Return an array as it is, with another size, or with an element or a row replaced by an extreme."""
    how = draw(st.sampled_from(["same"] * 6 + ["all", "one", "row"]))
    value = draw(st.sampled_from(EXTREMES))
    result = np.array(array, np.float64)
    sign = draw(st.sampled_from([1.0, -1.0]))
    with np.errstate(over="ignore"):
        if how == "all":
            result = np.nan_to_num(result * value * sign)
        elif how == "one":
            result.flat[draw(st.integers(0, result.size - 1))] = value * sign
        elif how == "row":
            result[...] = np.where(np.arange(result.size).reshape(result.shape) % 5, result, value * sign)
    return result


@st.composite
def controls(draw: Any) -> Control:
    """Return control with extreme numbers in its matrix, options and model; or refuse it in one line."""
    kind = draw(st.sampled_from(list(CONTROLS)))
    model = None
    if kind != INTEGRATOR:
        own = learnt()
        arrays = {name: scaled(draw, array) for name, array in own.arrays.items()}
        gain, factor = (draw(st.sampled_from([usual] * 20 + [*EXTREMES])) for usual in (0.4, 1.0))
        left = draw(st.sampled_from([(1.0, 2.0), (2.0, 1.0)]))
        model = Kalman(arrays, gain, factor, left, scaled(draw, own.phase_of_commands))
    options = {
        "controller": kind,
        "gain": draw(st.sampled_from([0.4, 0.0, 2.0])),
        "leak": draw(st.sampled_from([0.01, 0.0, 1.0])),
        "delay_frames": draw(st.sampled_from([1, 2, 5])),
        "largest_command": draw(st.sampled_from([*[None] * 4, *[10.0] * 4, 1e-300, 1e30, 1e300])),
        "largest_condition": draw(st.sampled_from([30.0, 1.0, 1e6])),
        "centroid_gain": draw(st.sampled_from([1.0, 0.01, 100.0])),
        "guard_frames": draw(st.sampled_from([50, 1_000_000])),
        "most_at_limit": 1.0,
        "largest_residual_px": draw(st.sampled_from([*[1e30] * 8, None, 1e300])),
    }
    return Control(scaled(draw, INTERACTION), None, ControlOptions(**options), model)


def no_slopes() -> Slopes:
    return Slopes(*(np.zeros(N, kind) for kind in RESULT_TYPES))


@st.composite
def frames(draw: Any) -> list[Slopes]:
    """Return slopes as estimators give them, with numbers as large as float32 holds and flags at random."""
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    made = []
    for _ in range(FRAMES):
        slopes = no_slopes()
        size = draw(st.sampled_from([1.0, 1.0, 0.0, 1e-30, 1e4, 1e38]))
        for array in (slopes.x, slopes.y):
            array[:] = size * rng.uniform(-1, 1, N)
        for array in (slopes.standard_error_x, slopes.standard_error_y):
            array[:] = draw(st.sampled_from([0.3, 0.3, 0.0, 1e-38, 1e38, np.inf, np.nan]))
        slopes.flags[:] = rng.integers(0, 2, N) * draw(st.sampled_from([0, 0, 1, 2]))
        made.append(slopes)
    return made


def any_control(data: st.DataObject) -> None:
    """Control that cannot be computed is refused in one line; else the loop opens and the mirror stays."""
    try:
        control = data.draw(controls())
        loop = ControlLoop(control, LAYOUT, prior=SlopePrior(N))
    except InputError as error:
        event("refused")
        said = str(error)
    else:
        said = run(loop, control.options.largest_command or 1e30, data.draw(frames()))
        event(f"ran, {control.options.controller}")
    assert "\n" not in said


@pytest.mark.slow
def test_what_is_not_finite_never_reaches_the_mirror() -> None:
    examples(40)(given(st.data())(any_control))()


def test_a_command_that_is_begun_while_rows_arrive_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """With lost frames, changed flags and slopes that are not finite; the tolerance is that of float32."""
    monkeypatch.setattr(integrator, "_LEAST_BYTES", 0)
    options = ControlOptions(centroid_gain=0.8, largest_residual_px=1e30, most_invalid=1.0)
    whole, begun = (ControlLoop(Control(INTERACTION, None, options), LAYOUT, threads=2) for _ in range(2))
    assert not begun.begin_product()  # the loop is open
    for loop in (whole, begun):
        loop.close()
    assert not begun.begin_product()
    rng = np.random.default_rng(4)
    for number in (0, 1, 2, 5, 6, 7):
        slopes = no_slopes()
        slopes.x[:], slopes.y[:] = rng.standard_normal((2, N))
        slopes.x[number % N] = np.nan
        parts = begun.begin_product()
        assert len(parts) == (2 if number else 0)
        for thread, part in enumerate(parts):
            add_slopes(part, slopes.x, slopes.y, slopes.flags, 5 * thread, 5 * thread + 4)
        slopes.flags[2] = 1
        sent = [loop.follow(slopes, number).copy() for loop in (whole, begun)]
        np.testing.assert_allclose(sent[1], sent[0], atol=1e-6)
        for loop in (whole, begun):
            loop.look_after(slopes.flux)
    assert np.abs(sent[0]).max() > 0.1
    begun.open()
    assert not begun.begin_product()


def frame_of(rng: np.random.Generator) -> Slopes:
    slopes = no_slopes()
    slopes.x[:], slopes.y[:] = 0.1 * rng.standard_normal((2, N))
    return slopes


def closed(**options: Any) -> ControlLoop:
    """Return a closed loop whose guard tolerates any slopes."""
    loop = ControlLoop(
        Control(INTERACTION, None, ControlOptions(largest_residual_px=1e30, **options)), LAYOUT
    )
    loop.close()
    return loop


def test_commands_are_minus_the_gain_times_the_wavefront_of_true_slopes() -> None:
    loop, rng = closed(gain=0.3, leak=0.02, centroid_gain=0.5), np.random.default_rng(5)
    expected = np.zeros(COMMANDS)
    for number in range(3):
        slopes = frame_of(rng)
        measured = np.concatenate([slopes.x, slopes.y]) / 0.5
        gain = loop.gain = 0.3 if number < 2 else 0.15
        expected = 0.98 * expected - gain * loop.control.reconstructor.matrix @ measured
        np.testing.assert_allclose(loop.follow(slopes, number), expected, atol=1e-5)
        loop.look_after(slopes.flux)
        rms = np.sqrt(np.mean(measured**2))
        assert number > 0 or loop.guard.residual_px == pytest.approx(rms, rel=1e-5)


@pytest.mark.parametrize("lost", [0, 1, 2, 7])
def test_commands_act_after_their_delay_also_if_frames_are_lost(
    lost: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mirror moves on in lost frames, for which there was no other command."""
    loop, rng = closed(delay_frames=3), np.random.default_rng(6)
    sent: list[np.ndarray] = []
    seen: list[np.ndarray] = []
    update = loop.controller.update

    def watched(*frame: Any) -> None:
        seen.append(loop._line.acting.copy())
        update(*frame)

    monkeypatch.setattr(loop.controller, "update", watched)
    for number in (0, 1, 2, 3 + lost, 4 + lost):
        sent += [sent[-1]] * (number - len(sent)) if sent else []
        slopes = frame_of(rng)
        sent.append(loop.follow(slopes, number).copy())
        loop.look_after(slopes.flux)
        for line, acts in ((seen[-1], number - 3), (loop._line.acting, number + 1 - 3)):
            expected = sent[acts] if acts >= 0 else np.zeros(COMMANDS)
            np.testing.assert_array_equal(line, expected)


def test_a_new_controller_follows_slopes_divided_by_its_own_centroid_gain() -> None:
    loop, rng = closed(centroid_gain=0.5), np.random.default_rng(7)
    taken: list[Any] = []
    new: Any = SimpleNamespace(is_settling=True, ready=SimpleNamespace(centroid_gain=0.4))
    new.follow = lambda _, *frame: taken.append([None if part is None else part.copy() for part in frame])
    slopes = frame_of(rng)
    slopes.standard_error_x[:], slopes.standard_error_y[:] = rng.uniform(0.1, 0.3, (2, N))
    slopes.covariance_xy[:] = rng.uniform(0.0, 0.01, N)
    loop.follow(slopes, 0)
    loop._successor = new
    loop.look_after(slopes.flux)
    [(vector, errors, covariance, _, prior)] = taken
    np.testing.assert_allclose(vector, slopes.vector / 0.4, rtol=1e-6)
    standard = np.concatenate([slopes.standard_error_x, slopes.standard_error_y])
    np.testing.assert_allclose(errors, standard / 0.4, rtol=1e-6)
    np.testing.assert_allclose(covariance, slopes.covariance_xy / 0.4**2, rtol=1e-6)
    assert prior is None


@pytest.mark.parametrize("step", ["begin_product", "update"])
def test_a_controller_that_fails_opens_the_loop(step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing raises in the frame path, and the mirror keeps what it has."""
    loop, rng = closed(), np.random.default_rng(8)
    held = loop.follow(frame_of(rng), 0).copy()

    def fail(*_: Any) -> None:
        raise ArithmeticError("no product")

    monkeypatch.setattr(loop.controller, step, fail)
    assert not loop.begin_product()
    for number in (1, 2):
        np.testing.assert_array_equal(loop.follow(frame_of(rng), number), held)
    assert not loop.closed
    assert "no product" in loop.opened_because


def run(loop: ControlLoop, stroke: float, taken: list[Slopes]) -> str:
    """Close a loop again and again, and return why it has opened."""
    reasons = ""
    loop.close()
    for number, slopes in enumerate(taken):
        before = np.zeros(COMMANDS) if loop._flattened else loop._line.latest.copy()
        with np.errstate(all="ignore"):
            sent = loop.follow(slopes, number).copy()
            failed = not loop.closed
            loop.look_after(slopes.flux)
        assert np.isfinite(sent.astype(np.float32)).all()
        assert np.abs(sent).max() <= stroke
        if failed:
            np.testing.assert_array_equal(sent, before)
        if not loop.closed:
            event("opened")
            assert loop.opened_because
            reasons += loop.opened_because
            loop.close()
    return reasons
