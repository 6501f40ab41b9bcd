import asyncio
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.engine.page.cases import LAYOUT, N, records, unpacked

import faintspot as fs
from faintspot.base.flags import SubapertureFlag
from faintspot.engine.page import page_state as page_state_module
from faintspot.engine.page.page import FrameDrawing, LatestMessages, packed, settings_rows
from faintspot.engine.page.page_state import Batch, PageState, Picture
from faintspot.slopes.pipeline.settings import SharedOptions

pytest.importorskip("zarr")


def test_message_holds_values_and_arrays_as_they_were() -> None:
    arrays: dict[str, NDArray[Any]] = {
        "odd": np.arange(5, dtype=np.uint8),
        "none": np.zeros((0, 3), np.float32),
        "table": np.arange(6.0).reshape(2, 3),
        "strided": np.arange(8, dtype=np.int32)[::2],
    }
    kind, values, found = unpacked(packed("now", {"é": 1, "missing": float("nan")}, arrays))
    assert (kind, values) == ("now", {"é": 1, "missing": None})
    for name, array in arrays.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_only_the_newest_message_of_each_kind_is_kept() -> None:
    async def check() -> None:
        latest_messages = LatestMessages()
        for number in range(100):
            latest_messages.post("now", b"now %d" % number)
            if number == 50:
                latest_messages.post("sensor", b"sensor")
        messages = await latest_messages.newer(0)
        assert [text for _, text in messages] == [b"sensor", b"now 99"]
        waiting = asyncio.ensure_future(latest_messages.newer(messages[-1][0]))
        await asyncio.sleep(0)
        assert not waiting.done()
        latest_messages.post("now", b"next")
        assert [text for _, text in await waiting] == [b"next"]

    asyncio.run(check())


def test_every_setting_is_a_row_of_the_form() -> None:
    """Values of sub-apertures by their ends, where they are many."""
    values = {"estimator": "tv", "noise_std": 2.5, "rule": "subtract_next", "flux_e": None}
    values |= {"search_range_px": [1.0, 2.5], "keep_brightest": list(range(36)), "tolerance": [2.0] * 36}
    rows = {row["name"]: row for row in settings_rows(values)}
    assert list(rows) == list(values)
    assert "ml" in rows["estimator"]["choices"]
    assert rows["noise_std"]["value"] == "2.5"
    assert "noise" in rows["noise_std"]["meaning"]
    assert rows["rule"]["choices"][0] == "subtract_next"
    texts = [rows[name]["value"] for name in list(values)[3:]]
    assert texts == ["none", "1,2.5", "(36 values, 0 to 35)", "2"]


def test_what_an_engine_answers_can_be_set_again() -> None:
    """The form's texts, parsed as `realtime send` parses them, are the settings."""
    from faintspot.base.tables import parse_changes

    settings = fs.Settings(estimator="ml", search_range_px=2.5)
    names = [*settings.estimator.declared(), *SharedOptions.declared()]
    values = {name: getattr(settings, name) for name in names}
    rows = settings_rows({"estimator": "ml", **values})
    changes = parse_changes([f"{row['name']}={row['value']}" for row in rows])
    assert fs.Settings(**changes) == settings


def test_newest_frame_and_strip_charts() -> None:
    page_state = PageState([])
    page_state.add(Batch(records(0, 10)))
    late = records(10, 10)
    late["published_time_ns"][3] += 9_950_000
    late["flags"][:, 0] = SubapertureFlag.NO_FLUX
    late["flux"][:, 0] = 1e6  # of what is not valid nothing counts
    page_state.add(Batch(late, truth=(19, 0.5, 120.0)))
    values, arrays = page_state.now()
    strip = {name: arrays["strip"][:, place] for place, name in enumerate(values["strip"])}
    assert values["frame"] == 19
    assert values["seen"] == 20
    np.testing.assert_array_equal(arrays["x"], late["x"][-1])
    np.testing.assert_allclose(strip["time_s"], [-0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(strip["latency_us"], [50.0, 50.0], rtol=1e-6)
    np.testing.assert_allclose(strip["longest_us"], [50.0, 10_000.0], rtol=1e-6)
    np.testing.assert_allclose(strip["flux_e"], 100.0)
    np.testing.assert_allclose(strip["strehl"], [np.nan, 0.5])
    # x is +-0.5 px about its mean, y is 0: along one axis 0.5 / sqrt 2.
    np.testing.assert_allclose(strip["rms_px"], 0.5 / np.sqrt(2), rtol=1e-6)


def test_flux_is_that_of_the_star_whatever_methods_keep() -> None:
    """35 electrons of a spot over a background of 2; the method keeps 100 and 60 of what it sees."""
    page_state = PageState(["none", "tv"])
    image = np.full((N, 8, 8), 2.0, np.float32)
    image[:, 3:5, 3:5] += np.array([10.0, 5.0, 10.0, 10.0]).reshape(2, 2)
    for turn in range(10):
        made = records(10 * turn, 10, method=turn % 2)
        made["flux"] = [100.0, 60.0][turn % 2]
        noise = np.random.default_rng(turn).normal(0, 0.3, image.shape).astype(np.float32)
        page_state.add(Batch(made, picture=Picture(10 * turn, np.zeros((24, 24), np.float32), image + noise)))
    values, arrays = page_state.now()
    assert values["flux_of"] == "of the star"
    assert values["strip_methods"] == {0: "none", 1: "tv"}
    np.testing.assert_allclose(arrays["flux"], 35.0, atol=6.0)  # 64 pixels of .1, twice for the background
    strip = arrays["strip"][:, values["strip"].index("flux_e")]
    np.testing.assert_allclose(strip, 35.0, atol=6.0)
    assert page_state.methods_compared()[0]["figures"]["flux kept (e-)"]["mean"] == pytest.approx(100.0)


def test_methods_of_one_read_have_a_row_each_in_the_strip_charts() -> None:
    page_state = PageState(["none", "tv"])
    made = np.concatenate([records(0, 10, method=1), records(10, 10, method=0)])
    made["flux"][10:] = 60.0
    page_state.add(Batch(made, missed=2))
    values, arrays = page_state.now()
    strip = {name: arrays["strip"][:, place] for place, name in enumerate(values["strip"])}
    np.testing.assert_array_equal(strip["method"], [1, 0])
    np.testing.assert_allclose(strip["time_s"], [-0.1, 0.0], atol=1e-6)
    np.testing.assert_allclose(strip["flux_e"], [100.0, 60.0])
    np.testing.assert_array_equal(strip["lost"], [0, 2])
    page_state.add(Batch(records(23, 5)))
    page_state.add(Batch(records(0, 5)))  # the camera has begun anew
    assert (page_state.lost, page_state.missed) == (3, 2)


def test_truth_that_comes_before_its_frame_counts_for_it() -> None:
    page_state = PageState(["none", "tv"])
    for turn in range(40):
        first = 10 * turn
        truth = (first + 10, 0.2 + 0.4 * ((turn + 1) % 2), 100.0)  # of the next turn's first frame
        page_state.add(Batch(records(first, 10, method=turn % 2), truth=truth))
    none, tv = page_state.methods_compared()
    assert none["figures"]["Strehl ratio"]["mean"] == pytest.approx(0.2)
    assert tv["figures"]["Strehl ratio"]["mean"] == pytest.approx(0.6)


def test_figures_are_those_of_numpy() -> None:
    page_state = PageState([])
    made = records(0, 1000)
    latency_us = np.random.default_rng(1).lognormal(4.0, 0.5, 1000).round(3)
    made["published_time_ns"] = made["last_row_time_ns"] + np.round(1e3 * latency_us)
    page_state.add(Batch(made))
    figures = page_state.figures()
    expected = np.percentile(latency_us, (50, 99, 99.9))
    np.testing.assert_allclose(list(figures["percentiles_us"].values()), expected, rtol=1e-6)
    assert figures["rate_hz"] == pytest.approx(100.0)
    assert figures["longest_us"] == pytest.approx(latency_us.max())
    assert figures["histogram"]["counts"].sum() == 1000
    assert page_state.methods_compared() == []


def test_methods_in_turn_are_compared_with_the_first() -> None:
    """The second method has 10 e- more, without noise: the difference is known exactly."""
    page_state = PageState(["none", "tv"])
    for turn in range(40):
        made = records(50 * turn, 50, method=turn % 2)
        made["flux"] += 10.0 * (turn % 2)
        page_state.add(Batch(made))
    none, tv = page_state.methods_compared()
    assert (none["method"], tv["method"], none["frames"]) == ("none", "tv", 1000)
    flux = tv["figures"]["flux kept (e-)"]
    assert flux["mean"] == pytest.approx(110.0)
    assert flux["difference"] == pytest.approx(10.0)
    assert flux["decided"] == 1
    assert tv["figures"]["latency (µs)"]["decided"] == 0
    assert "Strehl ratio" not in tv["figures"]


def test_methods_of_an_earlier_interleaving_are_not_compared() -> None:
    page_state = PageState(["none", "tv"])
    for turn in range(6):
        page_state.add(Batch(records(50 * turn, 50, method=turn % 2)))
    change = {
        "frame": 300,
        "number": 1,
        "changes": {"methods": ["ml", "set"], "first_method": 2, "every": 50},
    }
    for turn in range(6, 12):
        made = records(50 * turn, 50, method=2 + turn % 2)
        page_state.add(Batch(made, changes=[change] if turn == 6 else []))
    assert [row["method"] for row in page_state.methods_compared()] == ["ml", "set"]


def test_only_the_last_minute_is_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_state_module, "FRAMES_S", 2.0)
    monkeypatch.setattr(page_state_module, "STRIP_S", 1.0)
    page_state = PageState([])
    for second in range(10):
        page_state.add(Batch(records(100 * second, 100)))
    nothing = records(1000, 10)
    nothing["flags"] = SubapertureFlag.NO_FLUX  # no valid slope: figures are not wrong, but missing
    page_state.add(Batch(nothing))
    values, arrays = page_state.now()
    strip = dict(zip(values["strip"], arrays["strip"][-1], strict=True))
    assert np.isnan([strip["flux_e"], strip["rms_px"]]).all()
    assert page_state.figures()["frames"] <= 300
    assert len(page_state.now()[1]["strip"]) <= 2


def test_pictures_are_bytes_between_the_values_that_are_said() -> None:
    rng = np.random.default_rng(2)
    raw = rng.normal(100.0, 5.0, LAYOUT.frame_shape).astype(np.float32)
    raw[0, 0] = 1e9  # a hot pixel does not darken the rest
    raw[0, 1] = np.nan
    denoised = rng.uniform(1.0, 9.0, (N, *LAYOUT.window)).astype(np.float32)
    record = records(5, 1)[0]
    kind, values, arrays = unpacked(FrameDrawing(LAYOUT).message(Picture(5, raw, denoised), record))
    assert (kind, values["frame"]) == ("pictures", 5)
    low, high = values["raw_adu"]
    assert arrays["raw"][0, 0] == 255
    assert arrays["raw"][0, 1] == 0
    shown = low + (high - low) / 255 * arrays["raw"][2:]
    inside = (raw[2:] > low) & (raw[2:] < high)
    assert np.max(np.abs(shown - raw[2:])[inside]) <= (high - low) / 255
    top, left = LAYOUT.corners[3]
    low, high = values["denoised_e"]
    shown = low + (high - low) / 255 * arrays["denoised"][top : top + 8, left : left + 8]
    inside = (denoised[3] > low + 0.1) & (denoised[3] < high)
    assert np.max(np.abs(shown - denoised[3])[inside]) <= (high - low) / 255
    np.testing.assert_array_equal(arrays["x"], record["x"])
    outside = np.ones(LAYOUT.frame_shape, bool)
    for top, left in LAYOUT.corners:
        outside[top : top + 8, left : left + 8] = False
    assert not arrays["denoised"][outside].any()


def test_sensor_says_where_everything_is() -> None:
    kind, values, arrays = unpacked(FrameDrawing(LAYOUT).sensor())
    assert kind == "sensor"
    assert values == {"frame_shape": list(LAYOUT.frame_shape), "window": [8, 8], "subapertures": N}
    assert arrays["outlines"].shape == (N, 4, 2)
    np.testing.assert_allclose(arrays["centres"], LAYOUT.centres)
