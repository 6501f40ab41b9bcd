"""Sections of a recording of the engine, from a store whose differences are known."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from tests.cli.cli_cases import Commands
from tests.slopes.recorded.recorded_cases import Page

from faintspot.base.report.page import Report
from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.engine.telemetry.ring import image_type, layout_values, record_type
from faintspot.io.telemetry import Telemetry, read_telemetry
from faintspot.loop.telemetry.engine_sections import latency_figure, quantities, with_engine
from faintspot.loop.telemetry.turns import compared_methods
from faintspot.slopes.sensor.layout import Layout

LAYOUT = Layout.grid((4, 4), pixels=8)
N = len(LAYOUT)
EVERY, FRAMES = 5, 2000
LOST = slice(700, 712)
RMS_PX, FLUX_E = {0: 0.20, 1: 0.16}, {0: 300.0, 1: 280.0}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Make a store of 2000 frames at 1 kHz, twelve of them lost, with two methods in turns of five frames."""
    rng = np.random.default_rng(3)
    records = np.zeros(FRAMES, record_type(N))
    number = np.arange(FRAMES)
    method = number // EVERY % 2
    records["frame"], records["method"] = number + 10, method
    records["last_row_time_ns"] = 1_000_000 * number
    records["published_time_ns"] = records["last_row_time_ns"] + 50_000 + 10_000 * method
    # Of the air, the same in both methods; taken off over many turns.
    wave = 0.3 + np.sin(number / 300)[:, None]
    for axis in "xy":
        records[axis] = 0.5 + np.vectorize(RMS_PX.get)(method)[:, None] * rng.normal(size=(FRAMES, N))
        records[f"standard_error_{axis}"] = 0.1
    records["flux"] = np.vectorize(FLUX_E.get)(method)[:, None] + 50 * wave
    attributes = {
        "name": "bench",
        "layout": layout_values(LAYOUT),
        "settings": '[estimator]\nname = "tv"\n',
        "methods": ["none", "tv"],
        "dropped_records": 3,
    }
    kinds = record_type(N), image_type(LAYOUT.frame_shape, N, LAYOUT.window)
    store = TelemetryStore(tmp_path / "night.zarr", *kinds, attributes)
    changes = [{"frame": 510, "number": 1, "changes": {"noise_std": 2.5}, "where": [1, 2]}]
    kept = np.delete(records, LOST)
    store.append(kept, np.empty(0, kinds[1]), {"changes": changes, "ended_because": "seconds"})
    return store.path


@pytest.fixture
def night(path: Path) -> Telemetry:
    return read_telemetry(path)


def test_methods_in_turn_differ_as_they_were_made(night: Telemetry) -> None:
    values = quantities(night)
    for known in values.values():
        known[::7] = np.nan
    rms, flux = (
        compared_methods(night.method, ("none", "tv"), values[name])
        for name in ("rms of slopes about their mean (px)", "flux (e-)")
    )
    assert [method.method for method in rms] == ["none", "tv"]
    assert rms[0].difference is None
    for compared, true in ((rms, RMS_PX[1] - RMS_PX[0]), (flux, FLUX_E[1] - FLUX_E[0])):
        difference = compared[1].difference
        assert difference is not None
        assert difference.high < 0
        # 5 % of it: 200 turns of 5 frames of 32 slopes have 0.5 %, the wave of the air differs between turns.
        assert difference.value == pytest.approx(true, rel=0.05)
    known = np.nanmean(values["flux (e-)"][night.method == 1])
    assert flux[1].mean.value == pytest.approx(known, rel=1e-4)
    # The wave is common to both methods: in the difference it hardly counts, in the means it does.
    assert flux[1].difference.standard_error < 0.2 * flux[1].mean.standard_error  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn_pictures")
def test_the_page_has_every_part_and_the_numbers_of_each_method(path: Path, run: Commands) -> None:
    """The methods have 0.20 and 0.16 px of noise; together they would have 0.18."""
    page = Page(with_engine(Report("", {}, []), path))
    assert page.ids == ["engine", "numbers", "flux", "slopes", "wavefront", "configuration"]
    for words in ("50.0", "noise_std = 2.5", "3 frames were overwritten", "Engine bench", "less 'none'"):
        assert words in page.text
    numbers = page.text[page.text.index("method noise (px)") :]
    noise = [float(numbers.split(f" {name} ", 1)[1].split()[0]) for name in ("none", "tv")]
    assert noise == pytest.approx([RMS_PX[0], RMS_PX[1]], rel=0.05)
    run.refused("report", str(path), naming=("faintspot telemetry",))


def test_latencies_of_a_short_record_are_drawn(night: Telemetry) -> None:
    arrays = {field.name: getattr(night, field.name) for field in fields(night)}
    for frames in (1, 7, 99):
        short = {
            name: value[:frames] if np.shape(value)[:1] == (len(night.frame),) else value
            for name, value in arrays.items()
        }
        axes = latency_figure(Telemetry(**short)).figure.axes[1]
        assert all(np.size(line.get_xdata()) >= min(frames, 20) for line in axes.lines)
        assert all(line.get_marker() == "o" for line in axes.lines)
