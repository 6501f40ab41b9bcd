from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import faintspot as fs
from faintspot.slopes.kernels.cuda.availability import simulated

LAYOUT = fs.Layout.grid((1, 2), pixels=(4, 5))
SETTINGS = fs.Settings(noise_std=1.0, keep_brightest=6, max_iterations=4)


def frames(count: int, dtype: Any = np.uint16) -> Any:
    return np.random.default_rng(4).poisson(5.0, (count, *LAYOUT.frame_shape)).astype(dtype)


def pipeline(**changes: Any) -> fs.SlopePipeline:
    return fs.SlopePipeline(LAYOUT, SETTINGS, fs.Calibration(read_noise_e=1.0), device="cuda", **changes)


def assert_equal(found: Any, expected: fs.Slopes) -> None:
    for field in fields(expected):
        assert np.array_equal(getattr(found, field.name), getattr(expected, field.name)), field.name


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_a_stream_measures_as_the_pipeline_does(dtype: Any) -> None:
    from faintspot.slopes.pipeline.device_stream import FrameStream

    work = pipeline()
    stream = FrameStream(work, dtype)
    assert stream.captured != simulated()
    for frame in frames(2, dtype):
        stream.frame[:] = frame
        stream.submit()
        slopes = stream.wait()
        assert slopes.x.shape == (2,)
        assert slopes.flags.dtype == np.uint8
        assert_equal(slopes, work(frame))


def test_steps_without_a_graph() -> None:
    from faintspot.slopes.pipeline.device_stream import FrameStream

    work = pipeline()
    stream = FrameStream(work, capture=False)
    assert not stream.captured
    stream.frame[:] = frames(1)[0]
    stream.submit()
    assert_equal(stream.wait(), work(frames(1)[0]))


def test_sensors_do_not_disturb_each_other() -> None:
    from faintspot.slopes.pipeline.device_stream import FrameStream

    first, second = pipeline(), pipeline(reference=np.full((2, 2), 0.25))
    streams = [FrameStream(first), FrameStream(second)]
    for stream, frame in zip(streams, frames(2), strict=True):
        stream.frame[:] = frame
        stream.submit()
    assert_equal(streams[0].wait(), first(frames(2)[0]))
    assert_equal(streams[1].wait(), second(frames(2)[1]))


def test_what_a_stream_cannot_measure() -> None:
    from faintspot.slopes.pipeline.device_stream import FrameStream

    with pytest.raises(fs.InputError, match='expected one made with device="cuda"'):
        FrameStream(fs.SlopePipeline(LAYOUT, SETTINGS))
    with pytest.raises(fs.InputError, match="dtype = int8: expected uint16 or float32"):
        FrameStream(pipeline(), np.int8)
    automatic = fs.Settings(noise_std="auto", spot_fwhm_px=2.4)
    work = fs.SlopePipeline(LAYOUT, automatic, fs.Calibration(read_noise_e=1.0), device="cuda")
    with pytest.raises(fs.InputError, match=r"settings.flux_e: expected the flux per sub-aperture"):
        FrameStream(work)


@pytest.mark.parametrize("count", [0, 2])
def test_frames_on_the_gpu(count: int) -> None:
    from numba import cuda

    work = pipeline()
    stack = frames(max(count, 1), np.float32)
    given = stack if count else stack[0]
    measured = work.on_device.measure(cuda.to_device(given))  # type: ignore[union-attr]
    expected = work(given)
    for field in fields(expected):
        found = getattr(measured, field.name).copy_to_host()
        assert found.shape == (max(count, 1), 2)
        assert np.array_equal(found.squeeze(), getattr(expected, field.name).squeeze())


def test_images_of_a_stack_each_with_its_own_settings() -> None:
    from numba import cuda

    rng = np.random.default_rng(6)
    images = rng.poisson(6.0, (5, 4, 5)).astype(np.float32)
    settings = fs.Settings(
        noise_std=[0.0, 0.5, 1.0, 1.5, 9.0], keep_brightest=[3, 4, 5, 6, 7], max_iterations=5
    )
    corners = np.column_stack([4 * np.arange(5), np.zeros(5, int)])
    layout = fs.Layout((20, 5), (4, 5), corners)
    work = fs.SlopePipeline(layout, settings, device="cuda")
    measured = work.on_device.measure(cuda.to_device(images.reshape(20, 5)))  # type: ignore[union-attr]
    expected = fs.measure_images(images, settings)
    beside = ~np.uint8(fs.SubapertureFlag.AT_SEARCH_LIMIT)  # which is found on the host
    assert np.array_equal(measured.flags.copy_to_host()[0], expected.flags & beside)
    assert np.allclose(measured.x.copy_to_host()[0], expected.x, atol=1e-5)
    assert np.allclose(measured.y.copy_to_host()[0], expected.y, atol=1e-5)


def test_what_cannot_be_measured_on_the_gpu() -> None:
    from numba import cuda

    work = pipeline().on_device
    assert work is not None
    with pytest.raises(fs.InputError, match="expected an array on the GPU, got ndarray"):
        work.measure(np.zeros(LAYOUT.frame_shape, np.float32))
    with pytest.raises(fs.InputError, match="frames: expected shape"):
        work.measure(cuda.to_device(np.zeros((3, 3), np.float32)))
    with pytest.raises(fs.InputError, match="expected uint16 or float32 on the GPU, got float64"):
        work.measure(cuda.to_device(np.zeros(LAYOUT.frame_shape)))
