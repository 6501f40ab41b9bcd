from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.camera.frame_checks import (
    LargestValues,
    MeanFrame,
    find_hot_pixels,
    misread,
    mosaic_contrast,
)
from faintspot.slopes.simulate import Detector, sensor_frames


def test_hot_pixels_among_spots_are_found_and_spots_are_not() -> None:
    layout = fs.Layout.grid((6, 6), pixels=16)
    hot = [(5, 5, 200.0), (34, 46, 400.0), (95, 0, 150.0), (60, 23, 300.0)]
    frames, _ = sensor_frames(
        layout,
        1,
        flux_e=3000.0,
        detector=Detector(read_noise_e=3.0, hot_pixels=hot),
        rng=np.random.default_rng(4),
    )
    found = {(int(row), int(column)) for row, column in find_hot_pixels(frames[0])}
    assert found == {(row, column) for row, column, _ in hot}


@pytest.mark.parametrize("step", [(0, 1), (1, 0), (1, 1), (1, -1)])
@pytest.mark.parametrize("second", [0.2, 1.0])
def test_pairs_of_hot_pixels_are_found(step: tuple[int, int], second: float) -> None:
    image = np.random.default_rng(2).normal(100, 3, (30, 30))
    pair = np.array([[12, 17], [12 + step[0], 17 + step[1]]])
    image[tuple(pair.T)] += [900.0, 900.0 * second]
    found = find_hot_pixels(image)
    assert sorted(map(tuple, found.tolist())) == sorted(map(tuple, pair.tolist()))


@pytest.mark.parametrize("size", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("profile", ["diffraction", "gaussian"])
def test_no_noiseless_spot_is_a_hot_pixel(profile: str, size: float) -> None:
    positions = np.random.default_rng(0).uniform(-1, 1, (200, 2))
    for image in fs.slopes.simulate.spots(positions, profile=profile, size=size):
        assert len(find_hot_pixels(image)) == 0


def test_known_bad_pixels_are_left_out_and_the_frame_is_not_changed() -> None:
    frame = np.random.default_rng(1).normal(0, 1, (30, 30))
    frame[3, 4], frame[10, 10] = np.nan, 100.0
    before = frame.copy()
    assert find_hot_pixels(frame).tolist() == [[10, 10]]
    np.testing.assert_array_equal(frame, before)
    assert len(find_hot_pixels(np.full((5, 5), np.nan))) == 0


@pytest.mark.parametrize("shape", [(3,), (2, 3, 3)])
def test_hot_pixels_need_one_frame(shape: tuple[int, ...]) -> None:
    with refused("frame"):
        find_hot_pixels(np.zeros(shape))


SIDE = 160
ROW, COLUMN = np.mgrid[:SIDE, :SIDE]


def contrast(width_px: float, pitch_px: float, gains: tuple[float, float, float, float]) -> float:
    centres = 20.0 + pitch_px * np.arange(6)
    spots: NDArray[np.float64] = np.stack(np.meshgrid(centres, centres), axis=-1).reshape(-1, 2)
    image = sum(500 * np.exp(-0.5 * ((COLUMN - x) ** 2 + (ROW - y) ** 2) / width_px**2) for x, y in spots)
    image = image * np.tile(np.reshape(gains, (2, 2)), (SIDE // 2, SIDE // 2))
    image = image + np.random.default_rng(1).normal(100, 3, image.shape)
    image[40, 40] = np.nan
    return mosaic_contrast(image, spots, pitch_px, width_px)


@pytest.mark.parametrize("pitch_px", [20.0, 20.3])
@pytest.mark.parametrize("width_px", [1.2, 2.0, 3.0])
def test_the_contrast_is_that_of_the_gains(width_px: float, pitch_px: float) -> None:
    assert contrast(width_px, pitch_px, (0.6, 1.0, 1.0, 0.4)) == pytest.approx(2.5, rel=0.35)
    assert contrast(width_px, pitch_px, (1.0, 1.0, 1.0, 1.0)) == 1.0


@pytest.mark.parametrize("width_px", [0.5, 0.8, 1.0, 1.1])
def test_sharp_spots_at_the_same_place_of_their_pixels(width_px: float) -> None:
    assert contrast(width_px, 20.0, (1.0, 1.0, 1.0, 1.0)) == 1.0


def test_blocks_and_pixels_that_are_not_finite() -> None:
    frames = np.random.default_rng(1).normal(100, 5, (7, 3, 4))
    frames[2, 0, 0], frames[5, 0, 0], frames[:, 1, 1] = np.nan, np.inf, np.nan
    mean = MeanFrame((3, 4))
    mean.add(frames[:3])
    mean.add(frames[3:])
    expected = frames.mean(axis=0)
    expected[0, 0] = frames[[0, 1, 3, 4, 6], 0, 0].mean()
    np.testing.assert_allclose(mean.mean, expected, rtol=1e-12)
    assert np.isnan(mean.mean[1, 1])


def spots(seed: int, peak: float = 9000.0) -> NDArray[np.float64]:
    """Five frames of 36 spots whose peaks are from 0.3 of the largest, and noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:72, :72]
    mean = np.zeros((72, 72))
    for row in range(6):
        for column in range(6):
            away = (x - 12 * column - 6 - rng.uniform(-1, 1)) ** 2 + (y - 12 * row - 6) ** 2
            mean += rng.uniform(0.3, 1.0) * peak * np.exp(-away / 4.5)
    return np.asarray(rng.poisson(mean, (5, 72, 72)) + rng.normal(100.0, 4.0, (5, 72, 72)))


def level_of(*blocks: NDArray[Any]) -> float | None:
    values = LargestValues()
    for block in blocks:
        values.add(block)
    return values.saturation_adu


@pytest.mark.parametrize("bits", [10, 12, 14])
@pytest.mark.parametrize("step", [1, 2, 4])
@pytest.mark.parametrize("kind", ["u2", "f4", "i4"])
def test_clipped_frames_show_their_level(bits: int, step: int, kind: str) -> None:
    """Aligned right or left, whatever type holds them."""
    largest = 2**bits - 1
    clipped = np.rint(np.clip(spots(bits, 2.5 * largest), 0, largest)) * step
    assert level_of(clipped.astype(kind)) == largest * step


def test_the_limit_of_the_type_is_known_anyway() -> None:
    assert level_of(np.clip(8 * spots(1), 0, 65535).astype(np.uint16)) is None


@pytest.mark.parametrize("peak", [20.0, 200.0, 3000.0, 9000.0])
@pytest.mark.parametrize("kind", ["u2", "f4"])
def test_other_frames_have_none(peak: float, kind: str) -> None:
    for seed in range(5):
        frames = spots(seed, peak)
        frames[:, 7, 9] = 30000.0  # a hot pixel
        assert level_of(np.rint(frames).astype(kind)) is None


def test_a_largest_value_that_comes_later_replaces_others() -> None:
    low, high = spots(1, 2000.0).astype(np.uint16), np.clip(spots(2), 0, 4095).astype(np.uint16)
    assert level_of(low, high) == 4095
    assert level_of(high, low) == 4095


@pytest.mark.parametrize("frame", [np.zeros((1, 8, 8)), np.full((1, 8, 8), np.nan), np.eye(8)[None] * 7])
def test_frames_without_spots(frame: NDArray[np.float64]) -> None:
    assert level_of(frame) is None


def test_noise_free_frames_of_equal_spots() -> None:
    """All spots have the same largest value, and the same ones below it."""
    y, x = np.mgrid[:12, :12]
    spot = 1000.0 * np.exp(-((x - 5.5) ** 2 + (y - 5.5) ** 2) / 4.5)
    assert level_of(np.tile(spot, (3, 6, 6))) is None


LINE, PLACE = np.mgrid[:120, :120]


@pytest.mark.parametrize("peak", [300, 3000])
@pytest.mark.parametrize("offset", [300, 5000])
@pytest.mark.parametrize("std_px", [0.7, 1.6])
def test_order_of_bytes(peak: int, offset: int, std_px: float) -> None:
    """Right in 8 to 16 bits, aligned left or right; wrong where the bytes of 16 bits are taken apart."""
    spots = np.exp(-0.5 * (((LINE - 7.3) % 20 - 5) ** 2 + ((PLACE - 9.1) % 20 - 5) ** 2) / std_px**2)
    noise = np.random.default_rng(1).normal(offset, 3.0, spots.shape)
    right = (peak * spots + noise).round().clip(0, 65535).astype(np.uint16)
    eight = (right // 8).clip(0, 255)
    for frame in (
        right,
        right.clip(0, 4095) * 16,
        right.clip(0, 1023) * 64,
        eight * 256,
        eight.astype(np.uint8),
    ):
        assert not misread(frame.astype(np.uint16) if frame.dtype != np.uint8 else frame)
    assert not misread(right.astype(np.float32))
    assert misread(right.view(np.uint8))
    if np.ptp(right >> 8):  # else its bytes swapped are the same picture, 256 times as bright
        assert misread(right.byteswap())


def test_values_below_zero_that_wrapped_around_are_refused() -> None:
    """A dark subtracted in unsigned integers; saturated pixels beside dark ones are no sign of it."""
    rng = np.random.default_rng(3)
    light = rng.normal(0.0, 3.0, (40, 40))
    light[::8, ::8] += 500.0
    assert misread(light.round().astype(np.int32).astype(np.uint16))
    assert misread(light.round().astype(np.int32).astype(np.uint16).astype(np.float32))
    saturated = np.where(light > 400, 65535, np.abs(light)).astype(np.uint16)
    assert not misread(saturated)
