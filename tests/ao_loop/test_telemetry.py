from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.result_cases import small_interleaved

from faintspot.ao_loop.pseudo_open_loop import open_loop_slopes
from faintspot.ao_loop.telemetry import analyse_telemetry

pytest.importorskip("hcipy")


def test_recorded_telemetry_is_analysed_without_a_simulation() -> None:
    record = small_interleaved().records[0]
    whole = record.illumination > 0
    values: dict[str, Any] = {
        "cells": record.cells[whole],
        "subaperture_m": record.subaperture_m,
        "pixel_scale_rad": record.pixel_scale_rad,
        "outer_scale_m": 25.0,
        "frame_rate_hz": record.frame_rate_hz,
        "segment_s": 0.5,
    }
    found = analyse_telemetry(
        record.slopes_px, record.commands, record.interaction_matrix, delay_frames=0, **values
    )
    assert found.slopes_px.shape == record.slopes_px.shape
    assert len(found.segments) == len(found.time_s) == 4
    assert found.time_s[0] == pytest.approx(0.25)
    assert found.seeing.frames == record.frames
    # Commands as computed from each frame act `delay` frames later.
    delay = record.delay_frames
    computed = np.concatenate([record.commands[delay:], np.zeros((delay, record.commands.shape[1]))])
    later = analyse_telemetry(
        record.slopes_px, computed, record.interaction_matrix, delay_frames=delay, **values
    )
    np.testing.assert_allclose(later.slopes_px, found.slopes_px[delay:])
    assert open_loop_slopes(record).shape == found.slopes_px.shape


def test_the_example_of_the_manual_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    small_interleaved().save(tmp_path / "canary")
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).resolve().parents[2] / "docs" / "guide" / "closed_loop.md").read_text(
        encoding="utf-8"
    )
    script = re.search(r"```python\n(.*?analyse_telemetry.*?)```", text, re.DOTALL)
    assert script is not None
    names: dict[str, Any] = {}
    exec(script[1], names)
    assert 0.05 < names["analysis"].seeing.r0_m < 0.5
