import numpy as np
import pytest
from tests.engine.page.cases import LAYOUT, N, records, unpacked

from faintspot.base.flags import SubapertureFlag
from faintspot.engine.page import page_state as page_state_module
from faintspot.engine.page.page import FrameDrawing
from faintspot.engine.page.page_state import Batch, PageState, Picture, flag_names

pytest.importorskip("zarr")


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


def test_truth_that_comes_before_its_frame_counts_for_it() -> None:
    page_state = PageState(["none", "tv"])
    for turn in range(40):
        first = 10 * turn
        truth = (first + 10, 0.2 + 0.4 * ((turn + 1) % 2), 100.0)  # of the next turn's first frame
        page_state.add(Batch(records(first, 10, method=turn % 2), truth=truth))
    none, tv = page_state.methods_compared()
    assert none["figures"]["Strehl ratio"]["mean"] == pytest.approx(0.2)
    assert tv["figures"]["Strehl ratio"]["mean"] == pytest.approx(0.6)


def test_lost_frames_are_counted_once_and_a_camera_that_begins_anew_loses_none() -> None:
    page_state = PageState([])
    page_state.add(Batch(records(0, 5)))
    page_state.add(Batch(records(8, 5), missed=2))
    page_state.add(Batch(records(0, 5)))
    assert page_state.lost == 3
    assert page_state.missed == 2


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
    assert page_state.figures()["frames"] <= 300
    assert len(page_state.now()[1]["strip"]) <= 2


def test_sensor_without_a_valid_slope_has_no_figures_that_are_wrong() -> None:
    page_state = PageState([])
    made = records(0, 10)
    made["flags"] = SubapertureFlag.NO_FLUX
    page_state.add(Batch(made))
    values, arrays = page_state.now()
    strip = dict(zip(values["strip"], arrays["strip"][0], strict=True))
    assert np.isnan(strip["flux_e"])
    assert np.isnan(strip["rms_px"])
    assert page_state.figures()["frames"] == 10


def test_legend_names_every_flag() -> None:
    names = flag_names()
    assert [flag["bit"] for flag in names if flag["invalid"]] == [1, 2, 4, 128]
    assert sum(flag["bit"] for flag in names) == 255


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


def test_what_is_no_subaperture_is_nothing() -> None:
    picture = Picture(0, np.zeros(LAYOUT.frame_shape, np.float32), np.zeros((N, *LAYOUT.window), np.float32))
    _, _, arrays = unpacked(FrameDrawing(LAYOUT).message(picture, None))
    assert "x" not in arrays
    assert (arrays["denoised"] == 0).sum() == arrays["denoised"].size - N * LAYOUT.pixels


def test_sensor_says_where_everything_is() -> None:
    kind, values, arrays = unpacked(FrameDrawing(LAYOUT).sensor())
    assert kind == "sensor"
    assert values == {"frame_shape": list(LAYOUT.frame_shape), "window": [8, 8], "subapertures": N}
    assert arrays["outlines"].shape == (N, 4, 2)
    np.testing.assert_allclose(arrays["centres"], LAYOUT.centres)
