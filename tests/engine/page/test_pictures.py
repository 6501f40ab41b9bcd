import numpy as np
from tests.engine.page.cases import LAYOUT, N, records, unpacked

from faintspot.engine.page.page import FrameDrawing
from faintspot.engine.page.page_state import Picture


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
