"""Telemetry in files: what was written is read back, and what is not telemetry is refused."""

import json
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from tests.io.telemetry_files import (
    ATTRIBUTES,
    CHANGES,
    IMAGE,
    LATER,
    RECORD,
    SHAPE,
    SIZES,
    START_NS,
    N,
    images_of,
    records_of,
)
from tests.refusals import refused

from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.io import Telemetry, read_telemetry, write_aot
from faintspot.io.telemetry import LARGEST_GAP, all_left_out, item_type, left_out
from faintspot.slopes.sensor.layout import Layout

pytest.importorskip("zarr")

# A sensor alone has neither, of which the reader of AOT files complains.
pytestmark = [
    pytest.mark.filterwarnings("ignore:.AOT_(WAVEFRONT_CORRECTORS|LOOPS). .* contains no data"),
]


@pytest.fixture
def store(tmp_path: Path) -> TelemetryStore:
    """15 frames in two parts, with a gap, and two images."""
    store = TelemetryStore(tmp_path / "night.zarr", RECORD, IMAGE, ATTRIBUTES)
    store.append(records_of(10, 5), images_of(10), {})
    store.append(records_of(20, 10), images_of(25), {"changes": CHANGES, "complete": True})
    return store


def test_what_was_appended_is_read(store: TelemetryStore) -> None:
    telemetry = read_telemetry(store.path)
    written = np.concatenate([records_of(10, 5), records_of(20, 10)])
    for name in written.dtype.names or ():
        if name != "sequence":
            values = getattr(telemetry, name)
            assert np.array_equal(values, written[name])
            assert values.dtype == written[name].dtype
    assert np.array_equal(telemetry.raw, images_of(10, 25)["raw"])
    assert np.array_equal(telemetry.denoised, images_of(10, 25)["denoised"])
    assert telemetry.changes == CHANGES
    assert np.array_equal(telemetry.slopes, np.hstack([written["x"], written["y"]]))
    assert np.array_equal(telemetry.valid, written["flags"] == 0)
    assert np.all(telemetry.latency_s == 50e-6)
    # Unix time in float64 is good to a quarter of a microsecond.
    expected = START_NS / 1e9 + telemetry.frame / 1e3
    assert np.allclose(telemetry.unix_time_s, expected, rtol=0, atol=1e-6)
    shutil.rmtree(store.path / "covariance_xy")  # as in recordings without it
    assert np.array_equal(read_telemetry(store.path).covariance_xy, np.zeros((15, N)))
    assert Layout(**telemetry.attributes["layout"]).corners.shape == (N, 2)
    assert telemetry.attributes["complete"]
    without = read_telemetry(store.path, images=False)
    assert len(without.frame) == 15
    assert without.raw.shape == (0, *SHAPE)


def test_commands_are_read_and_stores_of_engines_without_a_loop_have_none(store: TelemetryStore) -> None:
    telemetry = read_telemetry(store.path)
    assert (telemetry.loop.tolist(), telemetry.commands.shape) == ([0] * 15, (15, 0))
    kind = item_type("frame", {**SIZES, "command": 5}, LATER[:3])
    records = np.zeros(4, kind)
    records["frame"], records["loop"] = np.arange(4), [1, 1, 2, 2]
    records["commands"] = np.arange(20).reshape(4, 5)
    with_loop = TelemetryStore(store.path.with_name("loop.zarr"), kind, IMAGE, ATTRIBUTES)
    with_loop.append(records, images_of(), {})
    telemetry = read_telemetry(with_loop.path)
    assert telemetry.loop.tolist() == [1, 1, 2, 2]
    assert np.array_equal(telemetry.commands, records["commands"])


def test_a_wall_clock_that_is_set_back_does_not_matter(tmp_path: Path) -> None:
    records = records_of(0, 4)
    records["clock_offset_ns"][2:] -= 3600 * 10**9
    store = TelemetryStore(tmp_path / "night.zarr", RECORD, IMAGE, ATTRIBUTES)
    store.append(records, images_of(), {})
    expected = START_NS / 1e9 + np.arange(4) / 1e3
    np.testing.assert_allclose(read_telemetry(store.path).unix_time_s, expected, rtol=0, atol=1e-6)


def test_xarray_reads_it(store: TelemetryStore) -> None:
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(store.path, consolidated=False) as data:
        assert data.x.dims == ("frame", "subaperture")
        assert data.x.attrs["units"] == "px"
        assert np.array_equal(data.x.sel(frame=25), records_of(20, 10)["x"][5])


def test_damage_is_said_and_never_read_as_other_telemetry(store: TelemetryStore) -> None:
    """One wrong bit in any chunk, or a chunk that is lost, also one that holds zeros only."""
    chunks = sorted(file for file in store.path.rglob("*") if file.is_file() and file.suffix != ".json")
    assert {file.relative_to(store.path).parts[0] for file in chunks} >= {"x", "flags", "iterations", "raw"}
    for chunk in chunks:
        content = chunk.read_bytes()
        place = len(content) // 2
        chunk.write_bytes(content[:place] + bytes([content[place] ^ 4]) + content[place + 1 :])
        with refused(store.path.name, "damaged"):
            read_telemetry(store.path)
        chunk.unlink()
        with refused(store.path.name, "lost"):
            read_telemetry(store.path)
        chunk.write_bytes(content)
    assert len(read_telemetry(store.path).frame) == 15
    shutil.rmtree(store.path / "flux")
    with refused(store.path.name):
        read_telemetry(store.path)


@pytest.mark.slow
def test_aot_is_read_back_by_aotpy(store: TelemetryStore, tmp_path: Path) -> None:
    aotpy = pytest.importorskip("aotpy")
    telemetry = read_telemetry(store.path)
    write_aot(tmp_path / "night.fits", telemetry, ao_mode="MOAO")
    assert not list(tmp_path.glob(".*"))
    system = aotpy.AOSystem.read_from_file(tmp_path / "night.fits")  # warns of anything odd
    assert (system.name, system.ao_mode) == ("bench", "MOAO")
    assert abs(system.date_beginning.timestamp() - telemetry.unix_time_s[0]) < 1e-3  # written to ms
    tables = {"estimator": {"name": "tv", "noise_std": 1.5}, "settings": {"flux_e": 30.0}}
    assert json.loads(system.config) == tables
    metadata = {each.key: each.value for each in system.metadata}
    assert [json.loads(metadata[key]) for key in ("CHG1", "CHG2")] == CHANGES
    assert (metadata["DROPPED"], metadata["METHODS"]) == (2, "none, tv")

    (sensor,) = system.wavefront_sensors
    assert (sensor.n_valid_subapertures, sensor.subaperture_size) == (N, 8)
    assert sensor.centroiding_algorithm == "tv"
    slopes = sensor.measurements
    assert (slopes.data.shape, slopes.unit) == ((15, 2, N), "pix")
    assert np.array_equal(slopes.data[:, 0][telemetry.valid], telemetry.x[telemetry.valid])
    assert np.array_equal(slopes.data[:, 1][telemetry.valid], telemetry.y[telemetry.valid])
    assert np.array_equal(np.isnan(slopes.data[:, 0]), ~telemetry.valid)
    assert list(slopes.time.frame_numbers) == list(telemetry.frame)
    assert np.array_equal(slopes.time.timestamps, telemetry.unix_time_s)
    assert np.array_equal(sensor.subaperture_intensities.data, telemetry.flux)
    assert sensor.subaperture_intensities.unit == "electron"
    assert np.array_equal(sensor.subaperture_mask.data, [[0, 1, 2], [3, -1, 4], [5, 6, 7]])
    assert np.allclose(sensor.ref_measurements.data, [[0.25] * N, [0.0] * N])
    pixels = sensor.detector.pixel_intensities
    assert np.array_equal(pixels.data, telemetry.raw)
    assert list(pixels.time.frame_numbers) == [10, 25]
    assert np.allclose(pixels.time.timestamps, telemetry.unix_time_s[[0, 10]])


@pytest.mark.slow
def test_aot_without_images_and_what_cannot_be_written(tmp_path: Path) -> None:
    aotpy = pytest.importorskip("aotpy")
    store = TelemetryStore(tmp_path / "night.zarr", RECORD, IMAGE, ATTRIBUTES)
    nothing: Telemetry = read_telemetry(store.path)
    with refused("frame"):
        write_aot(tmp_path / "nothing.fits", nothing)
    store.append(records_of(0, 2), images_of(), {})
    telemetry = read_telemetry(store.path)
    write_aot(tmp_path / "night.fits", telemetry)
    system = aotpy.AOSystem.read_from_file(tmp_path / "night.fits")
    assert system.wavefront_sensors[0].detector.pixel_intensities is None
    for path in (tmp_path / "night.fits", tmp_path / "no" / "night.fits"):
        with refused(f"{path}"):
            write_aot(path, telemetry)
    with refused("ao_mode"):
        write_aot(tmp_path / "mode.fits", telemetry, ao_mode="scao")


NUMBERS = [0, 1, 4, 4, 2, 3, LARGEST_GAP + 4, 2 * LARGEST_GAP + 6, 2**63 - 1, 0, 1]
EXPECTED = [0, 2, -1, -1, 0, LARGEST_GAP, -1, -1, -1, 0]


def test_what_is_missing_between_two_numbers() -> None:
    assert [left_out(*both) for both in pairwise(NUMBERS)] == EXPECTED
    np.testing.assert_array_equal(all_left_out(NUMBERS), EXPECTED)
    assert all_left_out(NUMBERS[:1]).shape == (0,)
