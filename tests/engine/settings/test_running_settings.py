import gc
import json
import threading
import weakref
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.settings.running_settings import RunningSettings

LAYOUT = fs.Layout.grid((2, 3), pixels=8)
N = len(LAYOUT)
SETTINGS = fs.Settings(noise_std=0.5, keep_brightest=9)


def made(settings: fs.Settings) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, settings)


def history(live: RunningSettings[Any]) -> list[tuple[int, dict[str, Any], list[int] | None]]:
    """Return frame, new values and sub-apertures of the changes that took effect."""
    return [(frame, values, where) for frame, _, values, where in live.taken()]


@pytest.fixture
def live() -> RunningSettings[fs.SlopePipeline]:
    return RunningSettings(made, SETTINGS)


def test_changes_between_two_frames_build_on_each_other(live: RunningSettings[fs.SlopePipeline]) -> None:
    changes = [live.propose({"noise_std": 2.5})]
    changes += [live.propose({"keep_brightest": 20}, [1, 4]), live.propose({"noise_std": 3.0}, [0])]
    assert (live.frame_of(changes[0]), history(live)) == (None, [])
    pipeline = live.take(100)
    live.propose({"tolerance": 0.1})
    assert [live.frame_of(change) for change in changes] == [100] * 3
    assert history(live) == [
        (100, {"noise_std": 2.5}, None),
        (100, {"keep_brightest": 20}, [1, 4]),
        (100, {"noise_std": 3.0}, [0]),
    ]
    assert [number for _, number, _, _ in live.taken(after=1)] == [2, 3]
    np.testing.assert_array_equal(pipeline.settings.values("noise_std", N, 64), [3, 2.5, 2.5, 2.5, 2.5, 2.5])
    assert live.get(["keep_brightest"]) == {"keep_brightest": [9, 20, 9, 9, 20, 9]}


def test_an_unforeseen_fault_while_building_leaves_the_running_one() -> None:
    def faulty(settings: fs.Settings) -> fs.SlopePipeline:
        if settings.noise_std == 7:
            raise RuntimeError("no memory")
        return made(settings)

    live = RunningSettings(faulty, SETTINGS)
    with pytest.raises(RuntimeError):
        live.propose({"noise_std": 7})
    live.propose({"tolerance": 0.1})
    assert live.take(3).settings == SETTINGS.replace(tolerance=0.1)


def test_history_is_bounded_and_keeps_the_latest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("faintspot.engine.settings.running_settings.HISTORY_LENGTH", 3)
    live = RunningSettings(made, SETTINGS)
    changes = []
    for frame_number in range(5):
        changes.append(live.propose({"noise_std": 1.0 + frame_number}))
        live.take(frame_number)
    assert [frame for frame, _, _ in history(live)] == [2, 3, 4]
    assert [live.frame_of(change) for change in changes] == [0, 1, 2, 3, 4]


def test_pipelines_that_were_replaced_are_freed_without_the_collector(
    live: RunningSettings[fs.SlopePipeline],
) -> None:
    gc.disable()  # as it is while an engine runs
    try:
        replaced = []
        for value in range(1, 6):
            live.propose({"noise_std": value}, [0])
            replaced.append(weakref.ref(live.take(value)))
            live.let_go()
        assert [pipeline() is None for pipeline in replaced] == [True] * 4 + [False]
    finally:
        gc.enable()


def test_history_is_not_changed_from_outside(live: RunningSettings[fs.SlopePipeline]) -> None:
    values, where = {"noise_std": [1.0, 2.0]}, [0, 1]
    live.propose(values, where)
    live.take(5)
    values["noise_std"][0] = 9.0
    where.append(2)
    history(live)[0][1].clear()
    assert history(live) == [(5, {"noise_std": [1.0, 2.0]}, [0, 1])]


def test_many_threads_propose_while_frames_are_taken() -> None:
    """No change is lost or taken out of order."""
    live, each = RunningSettings(made, SETTINGS), 15

    def propose(place: int) -> None:
        for value in range(1, each + 1):
            live.propose({"noise_std": float(value)}, [place])

    proposers = [threading.Thread(target=propose, args=(place,)) for place in range(3)]
    for thread in proposers:
        thread.start()
    frame = 0
    while any(thread.is_alive() for thread in proposers):
        live.take(frame)
        frame += 1
    np.testing.assert_array_equal(
        live.take(frame).settings.values("noise_std", N, 64), [each] * 3 + [0.5] * 3
    )
    taken = history(live)
    assert [number for number, _, _ in taken] == sorted(number for number, _, _ in taken)
    for place in range(3):
        mine = [changes["noise_std"] for _, changes, where in taken if where == [place]]
        assert mine == [float(value) for value in range(1, each + 1)]


def test_what_is_being_prepared_is_said_and_nobody_waits_for_it() -> None:
    """Neither who reads the history nor the engine."""
    go_on, begun = threading.Event(), threading.Event()

    def slow(settings: fs.Settings) -> fs.SlopePipeline:
        if settings != SETTINGS:
            begun.set()
            go_on.wait(30)
        return made(settings)

    live = RunningSettings(slow, SETTINGS)
    proposer = threading.Thread(target=live.propose, args=({"noise_std": 2.0},))
    proposer.start()
    begun.wait(30)
    said = live.preparing
    assert said is not None
    assert said["changes"] == {"noise_std": 2.0}
    assert said["seconds"] >= 0
    assert (history(live), live.take(3).settings) == ([], SETTINGS)
    go_on.set()
    proposer.join()
    assert live.preparing is None
    assert live.take(4).settings.noise_std == 2.0


def test_get_is_plain_and_complete(live: RunningSettings[fs.SlopePipeline]) -> None:
    live.propose({"spot_fwhm_px": 2.0}, [0])
    live.take(0)
    values = json.loads(json.dumps(live.get(), allow_nan=False))
    assert values["noise_std"] == 0.5
    assert values["spot_fwhm_px"] == [2.0, None, None, None, None, None]
    assert values["estimator"] == "tv"
    assert set(live.get(["rule", "flux_e"])) == {"rule", "flux_e"}
    assert live.get(["tolerance", "max_iterations"]) == {"tolerance": 0.0, "max_iterations": 24}
    live.propose({"preset": "fast"})
    live.take(1)
    assert live.get(["tolerance", "max_iterations"]) == {"tolerance": 0.0, "max_iterations": 8}
    live.propose({"estimator": "weighted", "spot_fwhm_px": 2.0})
    live.take(2)
    assert live.get(["steps", "flux_e"]) == {"steps": 3, "flux_e": None}  # those of the preset "fast"
    with refused("noise_std"):  # of other estimators
        live.get(["noise_std"])
    with refused("settings"):
        live.propose({})
