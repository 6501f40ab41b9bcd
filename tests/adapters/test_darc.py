"""In DARC itself: slopes are Python's, modules and parameters change without a lost frame."""

import time
from pathlib import Path

import numpy as np
import pytest
from benchmarks.realtime.darc import DARK_ADU, Sensor, aligned, configuration_example, modules
from benchmarks.realtime.darc_process import Darc, Parameters, build, missing, parameters
from tests.adapters.library_cases import CACHE

import faintspot as fs

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(bool(missing()), reason=f"missing: {missing()}"),
]
LAYOUT = fs.Layout.grid((7, 7), pixels=16, outer_radius=3.5, inner_radius=0.5)


@pytest.fixture(scope="module")
def sensor(tmp_path_factory: pytest.TempPathFactory) -> Sensor:
    folder = tmp_path_factory.mktemp("frames")
    return Sensor.of(LAYOUT, folder, "sensor", library=CACHE)


@pytest.fixture(scope="module")
def built(sensor: Sensor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("darc"), sensor.libraries["tv"])


def environment(sensor: Sensor, folder: Path) -> dict[str, str]:
    return {"CAMERA_FRAMES": str(sensor.file), "RING": str(folder / "ring"), "CAMERA_PERIOD_US": "5000"}


def of_images(sensor: Sensor, built: Path, estimator: str) -> Parameters:
    bundle = sensor.libraries[estimator].bundle
    module = built / "libfaintspotslope.so"
    return configuration_example().slope_module(LAYOUT, module, bundle, images=True)  # type: ignore[no-any-return]


@pytest.mark.parametrize("threads", [1, 2])
def test_slopes_are_those_of_python_in_every_bit(sensor: Sensor, built: Path, threads: int) -> None:
    base = parameters(LAYOUT, built, DARK_ADU, threads)
    chosen = {name: each for name, each in modules(sensor, built).items() if each[1]}
    chosen |= {f"images, {name}": (of_images(sensor, built, name), name) for name in ("tv", "brightest")}
    with Darc(built, "faintspot_t_", base, environment(sensor, built)) as darc:
        for name, (values, estimator) in chosen.items():
            darc.switch(base | values)
            darc.next(3)
            numbers, slopes = darc.next(1000 if name.startswith("faintspot, TV") else 200)
            assert np.all(np.diff(numbers) == 1), name
            which = aligned(numbers, slopes, sensor)
            expected, python = sensor.expected(estimator), sensor.pipelines[estimator](sensor.frames)
            # Whole frames may show that a sub-aperture is dark, when DARC has its slope already.
            lit = np.repeat(python.flags & fs.SubapertureFlag.NO_FLUX == 0, 2, axis=1)
            assert np.array_equal(slopes[lit[which]], expected[which][lit[which]]), name


def test_modules_and_parameters_change_without_a_lost_frame(sensor: Sensor, built: Path) -> None:
    base, n = parameters(LAYOUT, built, DARK_ADU), len(LAYOUT)
    rng = np.random.default_rng(2)
    chosen = list(modules(sensor, built).values())
    tv = next(values for values, estimator in chosen if estimator == "tv")
    strength, limit = rng.uniform(1, 5, n).astype(np.float32), rng.integers(1, 30, n).astype(np.int32)
    changed = tv | {"fsStrength": strength, "fsIterations": limit, "fsTolerance": np.float32(0.001)}
    pipeline = sensor.pipelines["tv"]
    settings = pipeline.settings.replace(noise_std=strength, max_iterations=limit, tolerance=0.001)
    python = pipeline.with_settings(settings)(sensor.frames)
    expected = np.stack([python.x, python.y], axis=-1).reshape(len(sensor.frames), -1)
    with Darc(built, "faintspot_s_", base, environment(sensor, built)) as darc:
        begin = darc.slopes.number
        for step in range(20):
            darc.switch(base | chosen[step % len(chosen)][0])
            darc.next(2)
            darc.switch(base | changed)
            darc.next(3)
            numbers, slopes = darc.next(20)
            which = aligned(numbers, slopes, sensor)
            assert np.mean(slopes == expected[which]) > 0.99  # but for dark ones
        numbers, _ = darc.slopes.since(begin)
        assert np.array_equal(numbers, np.arange(begin + 1, numbers[-1] + 1))


def test_killed_and_started_again(sensor: Sensor, built: Path) -> None:
    base = parameters(LAYOUT, built, DARK_ADU)
    values = base | next(each for each, estimator in modules(sensor, built).values() if estimator == "window")
    for _ in range(2):
        with Darc(built, "faintspot_k_", values, environment(sensor, built)) as darc:
            numbers, _ = darc.next(50)
            assert np.all(np.diff(numbers) == 1)
            darc.kill()
            time.sleep(0.05)
