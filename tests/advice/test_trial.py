"""Advice on a running loop: telescope, engine and its control channel in this process."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import pytest
from tests.cli.cli_cases import Commands

pytest.importorskip("hcipy")
pytest.importorskip("pyshmem")
pytest.importorskip("zarr")

from tests.realtime.closed_loop import CONFIGURATION, PATIENCE_S, Sky, configured, make_engine

from faintspot.advice import trial, watching
from faintspot.advice.advising import Advice, apply, loop_of, write_journal
from faintspot.advice.known import Known
from faintspot.advice.proposals import Proposal
from faintspot.advice.trial import Loop, Verdict, compared, settings_of, try_on
from faintspot.base.errors import InputError
from faintspot.experiments.statistics import Estimate
from faintspot.io.telemetry import Telemetry
from faintspot.realtime.commands import LENGTHY, commands_of
from faintspot.realtime.control import ControlServer
from faintspot.realtime.private_socket import socket_path

SECONDS, RATE_HZ = (6.0, 12.0, 24.0, 48.0), 150.0


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Loop, Sky, Path]]:
    """A loop with a gain of 0.05 at 150 frames/s, of which every fifth leaves images."""
    folder = tmp_path_factory.mktemp("bench")
    path, control = configured(folder)
    name = f"fs_test_{uuid4().hex[:12]}"
    sky = Sky(name, CONFIGURATION.slowed_to(RATE_HZ))
    engine = make_engine(name, path, control)
    engine._images_every = 5
    stop = threading.Event()
    seeing = threading.Thread(target=lambda: sky.telescope.run(None, stop), daemon=True)
    try:
        sky.start(engine)
        with ControlServer(socket_path(name), commands_of(engine), lengthy=LENGTHY):
            sky.loop.gain = 0.05
            sky.loop.close()
            seeing.start()
            yield loop_of(path, name)[0], sky, path
    finally:
        stop.set()
        seeing.join(PATIENCE_S)
        sky.close()


@pytest.fixture(autouse=True)
def _short_turns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trial, "_TURN_FRAMES", 50)


def decided(loop: Loop, proposal: Proposal) -> Verdict:
    """Try it until it is decided: on a busy machine few frames come in some seconds."""
    for seconds in SECONDS:
        verdict = try_on(loop, proposal, seconds, threading.Event())
        if verdict.difference.decided:
            break
    return verdict


def test_a_better_gain_is_kept_and_a_worse_one_taken_back(running: tuple[Loop, Sky, Path]) -> None:
    """200 photons and 1 e-: an integrator with 0.05 leaves several times as much as with 0.4."""
    loop, sky, _ = running
    better = decided(loop, Proposal({}, 0.4, ""))
    assert better.kept, better
    assert better.difference.value < 0 < better.left
    assert "kept" in better.in_words(loop.unit)
    assert sky.loop.gain == 0.4
    worse = decided(loop, Proposal({}, 0.05, ""))
    assert not worse.kept, worse
    assert worse.difference.value > 0
    assert worse.worse
    assert sky.loop.gain == 0.4


def test_settings_take_turns_and_what_does_harm_is_taken_back(running: tuple[Loop, Sky, Path]) -> None:
    """A window so narrow that it sees no spot that is off: its slopes are small, and its loop is poor."""
    loop, sky, _ = running
    before = loop.settings()
    change = {"estimator": "window", "window_fwhm_px": 0.8, "centroid_gain": 1.0, "flux_e": 200.0}
    verdict = decided(loop, Proposal(change, None, ""))
    assert not verdict.kept, verdict
    assert verdict.difference.value > 0
    assert loop.settings() == before
    assert loop.ask("status")["arms"] == ["set"]
    assert sky.loop.closed


@pytest.mark.parametrize("proposal", [Proposal({"keep_brightest": 25}, None, ""), Proposal({}, 0.3, "")])
def test_a_trial_ends_when_the_proposal_is_worse(
    running: tuple[Loop, Sky, Path], proposal: Proposal, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the third of a hundred looks, long before its time; a better one is not kept before."""
    loop, sky, _ = running
    before, gain, frames = loop.settings(), sky.loop.gain, list[int]()

    def told(loop: Loop, telemetry: Telemetry, settings: object) -> Verdict:
        frames.append(len(telemetry.frame))
        value = 1.0 if len(frames) >= 3 else -1.0
        return Verdict(Estimate(value, 0.1), 10.0, value < 0)

    monkeypatch.setattr(trial, "_compared", told)
    monkeypatch.setattr(watching, "_QUESTIONS", 100)
    verdict = try_on(loop, proposal, PATIENCE_S, threading.Event())
    assert verdict.worse
    assert verdict.in_words("nm").endswith("worse beyond the error, taken back")
    assert len(frames) == 4  # and the verdict on all of it
    assert frames == sorted(frames)
    assert frames[-1] < RATE_HZ * PATIENCE_S / 2
    assert (loop.settings(), sky.loop.gain) == (before, gain)
    assert loop.ask("status")["arms"] == ["set"]


def test_refused_interrupted_and_opened(running: tuple[Loop, Sky, Path]) -> None:
    loop, sky, _ = running
    refused = try_on(loop, Proposal({"keep_brightest": -3}, None, ""), 1.0, threading.Event())
    assert "the engine refuses it: keep_brightest" in refused.remark
    stopped = threading.Event()
    stopped.set()
    for proposal in (Proposal({"keep_brightest": 25}, None, ""), Proposal({}, 0.3, "")):
        gain = sky.loop.gain
        assert try_on(loop, proposal, 60.0, stopped).remark == "interrupted; taken back"
        assert (loop.settings().keep_brightest, sky.loop.gain) != (25, 0.3)
        assert sky.loop.gain == gain

    def diverges() -> None:
        sky.loop.closed, sky.loop.opened_because = False, "diverged: so"

    for opening, closed in ((diverges, True), (sky.loop.open, False)):
        opens = threading.Timer(0.3, opening)
        opens.start()
        opened = try_on(loop, Proposal({"keep_brightest": 25}, None, ""), 20.0, threading.Event())
        opens.join(PATIENCE_S)
        assert "the loop was opened" in opened.remark
        assert ("closed again" in opened.remark) == closed == sky.loop.closed
        assert loop.ask("status")["arms"] == ["set"]
    with pytest.raises(InputError, match="expected a closed loop, it is open: asked to"):
        try_on(loop, Proposal({}, 0.3, ""), 1.0, threading.Event())
    sky.loop.close()


def test_advice_from_the_command_line(
    running: tuple[Loop, Sky, Path], run: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop, _, path = running
    monkeypatch.setattr("faintspot.advice.advising.new_estimators", lambda *arguments: [])
    for seconds in (4, 8, 16, 32):  # again until there are enough frames
        told = run("realtime", "advise", "--name", loop.name, "-c", path, "--seconds", seconds)
        if told.code == 0:
            break
    assert told.code == 0, told.err
    lines = told.out.splitlines()
    assert lines[0].endswith("frames with brightest")
    for name in ("light", "read noise", "width of the spots", "centroid gain", "r0", "wind", "vibrations"):
        assert any(line.startswith(f"  {name}") for line in lines), told.out
    assert loop.ask("status")["advice"] == lines[:-1]
    with pytest.raises(InputError, match="lines = 3: expected a list of texts"):
        loop.ask("advice", lines=3)
    journal = json.loads(path.with_suffix(".advice.json").read_text())
    assert journal[-1]["name"] == loop.name
    known = {each["name"]: each for each in journal[-1]["known"]}
    # 200 photons for sub-apertures that are half lit or more, and what 16 pixels hold of speckled spots.
    assert 120 < known["light"]["value"] < 200
    assert known["read noise"]["value"] == pytest.approx(1.0, abs=0.2)
    recorded = path.parent / "night.zarr"
    run.ok("realtime", "record", recorded, "--name", loop.name, "--seconds", 2 * seconds)
    again = run.ok("realtime", "advise", "--from", recorded, "-c", path)
    assert "frames with brightest" in again.out
    run.refused(
        "realtime", "advise", "--from", recorded, "--apply", "-c", path, naming=("expected one of them",)
    )


def test_proposals_are_tried_one_after_the_other(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    verdict = Verdict(Estimate(-2.0, 0.5), 10.0, True)
    monkeypatch.setattr("faintspot.advice.advising.try_on", lambda *arguments: verdict)
    advice = Advice(500, [Known("light", "e-", 3.0, 0.1)], [Proposal({}, 0.3, "less"), Proposal({}, 0.2, "")])
    loop: Any = type("Stub", (), {"unit": "nm"})
    said: list[str] = []
    apply(loop, advice, 5.0, threading.Event(), said.append)
    assert said[0] == "trying gain 0.3 for at most 5 s"
    assert said[1] == "  leaves -2 +- 0.5 (nm)^2 of 10: kept"
    assert len(advice.verdicts) == 2
    config = tmp_path / "faintspot.toml"
    for _ in range(2):
        place = write_journal(config, advice.entry("one", "nm"))
    written = json.loads(place.read_text())
    assert len(written) == 2
    assert written[0]["proposals"][0]["tried"]["kept"] is True
    place.write_text("{}")
    with pytest.raises(InputError, match="expected a journal of advice"):
        write_journal(config, {})


def test_what_cannot_be_compared_is_taken_back() -> None:
    from tests.advice.advice_cases import LAYOUT, seen_with_truth

    from faintspot.advice.residual import wavefront_modes

    modes, _ = wavefront_modes(LAYOUT)
    seen, _ = seen_with_truth(extra_px=(0.1, 0.0))
    assert compared(seen, modes, [None, None], same_settings=True).kept
    assert compared(seen, modes, [Estimate(1.0, 0.01)] * 2).kept
    little, _ = seen_with_truth(extra_px=(0.1, 0.08), frames=7200)
    assert compared(little, modes, [None, None], same_settings=True).kept
    hardly = compared(little, modes, [Estimate(1.0, 1e-6)] * 2)
    assert not hardly.kept
    assert hardly.difference.decided == -1
    assert "less than estimators may seem to differ" in hardly.remark
    assert compared(little, modes, [Estimate(1.0, 1e-6)] * 2, same_estimator=True).kept
    unsure = compared(seen, modes, [Estimate(1.0, 0.01), None])
    assert not unsure.kept
    assert "centroid gains" in unsure.remark
    same = replace(seen, arm=np.zeros_like(seen.arm))
    assert not compared(same, modes, [Estimate(1.0, 0.01)] * 2).kept
    assert settings_of({"estimator": "map", "prior_std_px": None, "flux_e": 4.0}).flux_e == 4.0
