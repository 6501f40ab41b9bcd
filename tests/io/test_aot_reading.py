"""AOT files are read as far as they say what is needed, or refused in one line."""

import shlex
import shutil
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from tests.cli.cli_cases import Commands
from tests.io.telemetry_files import ATTRIBUTES, IMAGE, RECORD, N, images_of, records_of
from tests.patience import mostly_slow
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.io import open_frames, read_aot, read_slopes, read_telemetry, write_aot
from faintspot.slopes.recorded.measuring import measure_recorded
from faintspot.slopes.simulate import sensor_frames

aotpy: Any = pytest.importorskip("aotpy")
pytestmark = pytest.mark.filterwarnings("ignore:.AOT_")

REFERENCE = np.random.default_rng(1).uniform(-0.3, 0.3, 2 * N)
LAYOUT = fs.Layout(**ATTRIBUTES["layout"])


def own(folder: Path, images: NDArray[Any] | None = None, **attributes: Any) -> Path:
    """Return an AOT file of ours."""
    shutil.rmtree(folder / "night.zarr", ignore_errors=True)
    store = TelemetryStore(folder / "night.zarr", RECORD, IMAGE, {**ATTRIBUTES, **attributes})
    store.append(records_of(10, 15), images_of(10, 20) if images is None else images, {})
    path = folder / "night.fits"
    path.unlink(missing_ok=True)
    write_aot(path, read_telemetry(store.path))
    return path


def test_what_was_exported_is_read(tmp_path: Path) -> None:
    """Slopes that are not valid are NaN; references are from the windows' middles."""
    sensor: Any = read_aot(own(tmp_path, reference=REFERENCE.tolist()))
    telemetry = read_telemetry(tmp_path / "night.zarr")
    layout = fs.Layout(**sensor.layout)
    assert (layout.window, layout.frame_shape) == (LAYOUT.window, LAYOUT.frame_shape)
    assert np.array_equal(layout.corners, LAYOUT.corners)
    assert np.array_equal(layout.cells, LAYOUT.cells)
    np.testing.assert_allclose(sensor.reference, REFERENCE + np.repeat([0.25, 0.0], N))
    slopes = np.stack([telemetry.x, telemetry.y], axis=1)
    assert np.array_equal(np.isnan(sensor.slopes).all(axis=1), ~telemetry.valid)
    assert np.array_equal(np.where(np.isnan(sensor.slopes), slopes, sensor.slopes), slopes)
    assert np.array_equal(sensor.flux, telemetry.flux)
    assert (sensor.slopes.dtype, sensor.unit) == (np.float32, "pix")
    assert np.array_equal(sensor.frame, telemetry.frame)
    assert np.array_equal(sensor.unix_time_s, telemetry.unix_time_s)
    assert np.array_equal(sensor.image_frame, telemetry.image_frame)
    with open_frames([sensor.path]) as frames:
        assert np.array_equal(frames.block(0, 2), telemetry.raw)
    assert repr(sensor) == "AotSensor('SENSOR', 8 sub-apertures, layout, pixels, slopes, reference)"


@pytest.mark.slow
def test_windows_with_gaps_are_no_grid_of_the_standard(tmp_path: Path) -> None:
    apart = {"corners": [[12 * row, 12 * column] for row, column in ATTRIBUTES["layout"]["cells"]]}
    layout = ATTRIBUTES["layout"] | apart | {"frame_shape": (40, 40)}
    sensor: Any = read_aot(own(tmp_path, layout=layout))
    assert sensor.layout is None
    assert np.array_equal(sensor.cells, LAYOUT.cells)


def test_what_others_read_of_ours(tmp_path: Path) -> None:
    """Where the windows begin, x before y; references from their middles, with what was subtracted."""
    layout = ATTRIBUTES["layout"]
    moved = {
        **layout,
        "frame_shape": (30, 30),
        "corners": [[row + 1, column + 5] for row, column in layout["corners"]],
        "centres": [[x + 5, y + 1] for x, y in layout["centres"]],
    }
    path = own(tmp_path, layout=moved, reference=REFERENCE.tolist())
    (sensor,) = aotpy.AOSystem.read_from_file(path).wavefront_sensors
    (first,) = sensor.mask_offsets
    assert (first.x, first.y, sensor.subaperture_size) == (5.0, 1.0, 8.0)
    expected = REFERENCE.reshape(2, N) + np.array([[0.25], [0.0]])
    np.testing.assert_allclose(sensor.ref_measurements.data, expected, atol=1e-6)


def test_values_of_a_loop(tmp_path: Path) -> None:
    def in_units_of_the_standard(system: Any) -> None:
        system.main_telescope.enclosing_diameter = 4.2
        system.wavefront_sensors[0].detector.pixel_scale = 1e-6  # radian
        loop = system.loops[0]
        loop.framerate, loop.delay, loop.closed = 500.0, 2.5, False
        loop.control_matrix.data = np.arange(256.0).reshape(32, 2, 4)
        loop.commands.data = np.arange(1600.0).reshape(50, 32)

    sensor: Any = read_aot(example(tmp_path / "e.fits", in_units_of_the_standard))
    assert sensor.pixel_scale_arcsec == pytest.approx(0.206265, rel=1e-5)
    assert (sensor.diameter_m, sensor.frame_rate_hz, sensor.delay_frames) == (4.2, 500.0, 2.5)
    assert not sensor.is_closed
    np.testing.assert_array_equal(sensor.control_matrix[1], np.arange(8.0, 16.0))
    np.testing.assert_array_equal(sensor.commands[2], np.arange(64.0, 96.0))


@pytest.mark.slow
def test_exported_frames_are_measured(tmp_path: Path, run: Commands, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the settings of a faintspot.toml, sub-apertures and reference slopes of the file."""
    images = images_of(10, 20)
    images["raw"], _ = sensor_frames(LAYOUT, 2, flux_e=300.0, rng=np.random.default_rng(2))
    sensor: Any = read_aot(own(tmp_path, images, reference=REFERENCE.tolist()))
    monkeypatch.chdir(tmp_path)
    fs.Settings("centroid").save(tmp_path / "faintspot.toml")
    out = run.ok("slopes", "night.fits", "-o", "slopes.npz").out
    assert "sub-apertures, reference slopes of night.fits" in out
    layout = fs.Layout(**sensor.layout)
    expected = fs.SlopePipeline(layout, fs.Settings("centroid"), reference=sensor.reference)(images["raw"])
    assert np.array_equal(read_slopes(tmp_path / "slopes.npz").variables["x"], expected.x)


def example(path: Path, change: Callable[[Any], None] = lambda system: None) -> Path:
    """Write the system that aotpy's own documentation has as an example, and changes of it."""
    system = aotpy.AOSystem(ao_mode="GLAO", main_telescope=aotpy.MainTelescope("Example telescope"))
    mirror = aotpy.DeformableMirror("Example DM", n_valid_actuators=32, telescope=system.main_telescope)
    system.wavefront_correctors.append(mirror)
    system.sources = [aotpy.NaturalGuideStar("Example NGS"), aotpy.SodiumLaserGuideStar("Example LGS")]
    slopes = [aotpy.Image(f"slopes {n}", np.ones((50, 2, n))) for n in (4, 8)]
    sensors = [
        aotpy.ShackHartmann(f"WFS{i}", source=source, n_valid_subapertures=n, measurements=measured)
        for i, source, n, measured in zip((1, 2), system.sources, (4, 8), slopes, strict=True)
    ]
    pixels = np.random.default_rng(3).random((10, 20, 20))
    sensors[0].detector = aotpy.Detector("DET1", pixel_intensities=aotpy.Image("Pixels", pixels))
    system.wavefront_sensors = sensors
    system.loops = [
        aotpy.ControlLoop(
            f"loop {i}",
            input_sensor=sensor,
            commanded_corrector=mirror,
            commands=aotpy.Image(f"commands {i}", np.ones((50, 32))),
            control_matrix=aotpy.Image(f"control {i}", np.ones((32, 2, n))),
        )
        for i, sensor, n in zip((1, 2), sensors, (4, 8), strict=True)
    ]
    change(system)
    system.write_to_file(path)
    return path


def with_subapertures(system: Any) -> None:
    """Say where the first sensor's sub-apertures are, and what its references and commands do."""
    sensor = system.wavefront_sensors[0]
    sensor.subaperture_mask = aotpy.Image("mask", np.array([[-1, 2, -1], [0, -1, 1], [-1, 3, -1]]))
    sensor.mask_offsets, sensor.subaperture_size = [aotpy.Coordinates(2.0, 1.0)], 6.0
    sensor.ref_measurements = aotpy.Image("ref", np.arange(8.0).reshape(2, 4) / 10, "pix")
    system.loops[0].interaction_matrix = aotpy.Image("poke", np.arange(24.0).reshape(4, 2, 3))
    for row, column in ((9, 4), (9, 16), (3, 10), (15, 10)):
        system.wavefront_sensors[0].detector.pixel_intensities.data[:, row, column] += 1000.0


@pytest.mark.slow
def test_the_example_of_aotpy(tmp_path: Path) -> None:
    sensor: Any = read_aot(example(tmp_path / "e.fits"))  # that with pixels
    assert (sensor.name, sensor.n, sensor.pixels) == ("WFS1", 4, "PIXELS")
    assert sensor.layout is None
    assert (sensor.slopes.shape, sensor.unit, sensor.frame.size) == ((50, 2, 4), "", 0)
    other = read_aot(tmp_path / "e.fits", "WFS2")
    assert repr(other) == "AotSensor('WFS2', 8 sub-apertures, slopes)"
    with open_frames([tmp_path / "e.fits"]) as frames:
        assert (frames.n_frames, frames.shape) == (10, (20, 20))
    with open_frames([f"{tmp_path}/e.fits:SLOPES 4"]) as frames:
        assert frames.shape == (2, 4)
    with refused("e.fits: sensor 'WFS1'", "[layout] in ", "none.toml"):
        measure_recorded([tmp_path / "e.fits"], tmp_path / "none.toml", tmp_path / "s.npz")
    with refused("'WFS2'", "pixel_intensities"):
        open_frames([tmp_path / "e.fits"], key="WFS2")


@pytest.mark.slow
def test_layout_of_the_configuration_comes_first(tmp_path: Path) -> None:
    example(tmp_path / "e.fits", with_subapertures)
    layout = fs.Layout.grid((2, 2), pixels=8, frame_shape=(20, 20))
    for item in (layout, fs.Settings("centroid")):
        item.save(tmp_path / "faintspot.toml")
    summary = measure_recorded([tmp_path / "e.fits"], tmp_path / "faintspot.toml", tmp_path / "s.npz")
    assert (summary.n_frames, summary.notes) == (10, [])
    with open_frames([tmp_path / "e.fits"]) as frames:
        block = frames.block(0, 10)
    expected = fs.SlopePipeline(layout, fs.Settings("centroid")).with_dark(block.mean(axis=0))(block)
    assert np.array_equal(read_slopes(tmp_path / "s.npz").variables["x"], expected.x)


def test_subapertures_of_others(tmp_path: Path) -> None:
    sensor: Any = read_aot(example(tmp_path / "e.fits", with_subapertures))
    layout = fs.Layout(**sensor.layout)
    assert layout.corners.tolist() == [[7, 2], [7, 14], [1, 8], [13, 8]]
    assert (layout.window, layout.frame_shape) == ((6, 6), (20, 20))
    assert layout.cells.tolist() == [[1, 0], [1, 2], [0, 1], [2, 1]]
    assert np.allclose(sensor.reference, np.arange(8.0) / 10)
    assert sensor.interaction.shape == (8, 3)
    assert sensor.interaction[1].tolist() == [6.0, 7.0, 8.0]  # x of the second
    assert sensor.interaction[4].tolist() == [3.0, 4.0, 5.0]  # y of the first


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::faintspot.base.errors.DoubtWarning")
def test_quad_cells_of_others_without_a_configuration(tmp_path: Path, run: Commands) -> None:
    def quad_cells(system: Any) -> None:
        sensor = system.wavefront_sensors[0]
        sensor.subaperture_mask = aotpy.Image("mask", np.array([[0, 1], [2, 3]]))
        sensor.mask_offsets, sensor.subaperture_size = [aotpy.Coordinates(4.0, 6.0)], 2.0
        sensor.detector.pixel_intensities.data[:, 6:10, 4:8] += 100.0

    path = example(tmp_path / "e.fits", quad_cells)
    toml = tmp_path / "faintspot.toml"
    error = run.refused("slopes", path, "-c", toml, "-o", tmp_path / "s.npz").error
    run.ok(*shlex.split(error.split("`")[1].removeprefix("faintspot ")))
    assert fs.Layout.load(toml).corners.tolist() == [[6, 4], [6, 6], [8, 4], [8, 6]]
    run.ok("slopes", path, "-c", toml, "-o", tmp_path / "s.npz")


def changed(place: str, value: Any) -> Callable[[Any], None]:
    """Return what sets an attribute of the first sensor with sub-apertures, or of its loop."""

    def change(system: Any) -> None:
        with_subapertures(system)
        *names, last = place.split(".")
        owner = reduce(
            getattr, names, SimpleNamespace(sensor=system.wavefront_sensors[0], loop=system.loops[0])
        )
        setattr(owner, last, value)

    return change


def pyramid(system: Any) -> None:
    source = system.sources[0]
    system.wavefront_sensors = [aotpy.Pyramid("P", source=source, n_valid_subapertures=4, n_sides=4)]
    system.loops = []


MASK = np.array([[7, 2, -1], [0, -1, 1], [-1, 3, -1]])


@pytest.mark.parametrize(
    ("change", "names"),
    mostly_slow(
        1,
        [
            (changed("sensor.detector", None), ("Shack-Hartmann", "WFS1, WFS2")),
            (pyramid, ("Shack-Hartmann", "none")),
            (changed("sensor.subaperture_mask.data", MASK), ("subaperture_mask", "0 to 3")),
            (changed("sensor.ref_measurements.data", np.zeros((4, 2))), ("(2, 4)", "(4, 2)")),
            (changed("sensor.measurements.data", np.ones((50, 4, 2))), ("measurements", "(t, 2, 4)")),
            (changed("loop.interaction_matrix.data", np.ones((3, 2, 4))), ("(4, 2, commands)",)),
            (changed("sensor.mask_offsets", 2 * [aotpy.Coordinates(2.0, 1.0)]), ("one", "2")),
            (changed("sensor.detector.pixel_intensities.data", np.ones(20)), ("(frames, height, width)",)),
        ],
    ),
)
def test_damaged_files_are_refused(tmp_path: Path, change: Callable[[Any], None], names: Any) -> None:
    with refused("e.fits", *names):
        read_aot(example(tmp_path / "e.fits", change))


def test_subapertures_outside_the_frame_are_refused(tmp_path: Path) -> None:
    fs.Settings("centroid").save(tmp_path / "faintspot.toml")
    path = example(tmp_path / "e.fits", changed("sensor.mask_offsets", [aotpy.Coordinates(5.0, 1.0)]))
    with refused("'WFS1'", "layout", "sub-aperture 1"):
        measure_recorded([path], tmp_path / "faintspot.toml", tmp_path / "s.npz")


def test_references_in_another_unit_are_not_taken(tmp_path: Path) -> None:
    path = example(tmp_path / "e.fits", changed("sensor.ref_measurements.unit", "m"))
    assert read_aot(path).reference is None


def test_images_elsewhere_are_not_fetched(tmp_path: Path) -> None:
    def elsewhere(system: Any) -> None:
        from aotpy.io.fits import FITSURLImage

        far = FITSURLImage("http://127.0.0.1:9/pixels.fits", read_data=False)
        far.name, far.data, far.unit, far.time, far.metadata = "FAR", None, None, None, []
        system.wavefront_sensors[0].measurements = far

    assert read_aot(example(tmp_path / "e.fits", elsewhere)).slopes is None


def test_what_is_no_aot_file(tmp_path: Path) -> None:
    content = example(tmp_path / "e.fits").read_bytes()
    (tmp_path / "text.fits").write_text("text")
    (tmp_path / "unknown.fits").write_bytes(content.replace(b"AOT_SOURCES", b"AOT_SAUCES "))
    (tmp_path / "cut.fits").write_bytes(content[: len(content) // 3])
    for name, sensor, names in (
        *((name, None, ()) for name in ("absent", "unknown", "cut")),
        ("text", None, ("AOT-VERS",)),
        ("e", "WFS7", ("'WFS7'", "WFS1, WFS2")),
    ):
        with refused(f"{name}.fits", *names):
            read_aot(tmp_path / f"{name}.fits", sensor)
