"""Recordings of loops from files of several formats, and files that are wrong."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io import loop_layouts
from tests.io.telemetry_files import ATTRIBUTES, IMAGE, RECORD, SIZES, images_of, records_of
from tests.loop.telemetry.loop_cases import CELLS, recorded
from tests.patience import mostly_slow
from tests.refusals import refused

import faintspot as fs
from faintspot.base.flags import SubapertureFlag
from faintspot.engine.telemetry.recorder import TelemetryStore
from faintspot.io import create_writer, read_telemetry, write_aot
from faintspot.io.telemetry import item_type
from faintspot.loop.control.identification.preparation import prepared
from faintspot.loop.control.identification.recording import NUMBERS, Recording
from faintspot.loop.telemetry.page import page_of_loop
from faintspot.loop.telemetry.recorded_loop import frame_rate, read_recorded_loop
from faintspot.loop.telemetry.report import _begun, _scintillation, report_of_loop

WORDS = """
slope_unit = "px"
frame_rate_hz = 250
subaperture_m = 0.6
pixel_scale_arcsec = 0.2
"""


def arrays() -> dict[str, Any]:
    loop: Any = recorded()
    return {"slopes": loop.slopes, "commands": loop.commands, "interaction_matrix": loop.interaction_matrix}


def same(found: Any) -> None:
    loop: Any = recorded()
    assert np.allclose(found.slopes, loop.slopes)
    assert np.allclose(found.commands, loop.commands)
    assert np.array_equal(found.cells, CELLS)
    assert (found.frame_rate_hz, found.subaperture_m, found.pixel_scale_arcsec) == (250.0, 0.6, 0.2)


def written(folder: Path, **more: Any) -> Any:
    """Write a recording with its words; return what is read."""
    np.savez(folder / "night.npz", **{**arrays(), **more})
    (folder / "system.toml").write_text(WORDS)
    return read_recorded_loop(folder / "night.npz", folder / "system.toml")


def test_npz_with_words(tmp_path: Path) -> None:
    """Slopes that are not valid are left out."""
    same(written(tmp_path))
    flags = np.zeros((2550, 25), np.uint8)
    flags[:, 3], flags[7, 4] = 1, 128
    loop = written(tmp_path, slopes=np.where(np.arange(50) == 30, np.nan, arrays()["slopes"]), flags=flags)
    line = "slopes: left out 2 of 25 sub-apertures, 1 slope of others: dark, not finite, limited"
    assert line in loop.remarks
    assert np.isnan(loop.slopes[:, [3, 28, 5, 30]]).all()
    assert np.isnan(loop.slopes).sum() == 4 * 2550 + 2


@pytest.mark.usefixtures("undrawn_pictures")
def test_fluxes_have_a_part_of_the_report(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    light = np.exp(0.4 * np.sin(np.arange(2550) / 7.0))[:, None]
    loop = written(tmp_path, flux=rng.poisson(200 * light, (2550, 25)))
    _, report = _begun(loop)
    _scintillation(report, 0.8)
    index = report.parts["scintillation"].values[0]
    assert index.value == pytest.approx((light.std() / light.mean()) ** 2, rel=0.1)
    assert len(report.as_values()["scintillation"]["of_subapertures"]) == 25
    assert "scintillation" in {section.name for section in page_of_loop(report).sections}
    with refused("level"):
        report_of_loop(loop, fade_level=0.0)
    with refused("flux"):
        replace(loop, flux=loop.flux[:, 1:])
    assert "scintillation" not in _begun(replace(loop, flux=None))[1].parts


def test_toml_that_names_arrays(tmp_path: Path) -> None:
    """Slopes as CSV in pairs, commands of the opposite sign, times with a gap."""
    found = arrays()
    pairs = found["slopes"].reshape(-1, 2, 25).swapaxes(1, 2).reshape(-1, 50)
    header = ",".join(f"s{number}" for number in range(50))
    np.savetxt(tmp_path / "slopes.csv", pairs, delimiter=",", header=header, comments="")
    np.save(tmp_path / "commands.npy", -found["commands"])
    matrix = found["interaction_matrix"].reshape(2, 25, 36).swapaxes(0, 1).reshape(50, 36)
    np.save(tmp_path / "matrix.npy", matrix)
    times = np.arange(len(pairs)) / 250
    times[100:] += 7 / 250
    np.save(tmp_path / "times.npy", times)
    names = 'slopes = "slopes.csv"\ncommands = "commands.npy"\ninteraction_matrix = "matrix.npy"\n'
    (tmp_path / "night.toml").write_text(WORDS + names + 'time_s = "times.npy"\nslope_order = "pairs"\n')
    loop = read_recorded_loop(tmp_path / "night.toml")
    same(replace(loop, commands=-loop.commands))
    np.testing.assert_array_equal(loop.interaction_matrix, found["interaction_matrix"])
    assert np.flatnonzero(np.diff(loop.frame) > 1).tolist() == [99]
    assert np.diff(loop.frame).max() == 8


def test_control_matrix_and_mask(tmp_path: Path) -> None:
    found = arrays()
    control = np.linalg.pinv(found.pop("interaction_matrix"), rcond=0.03)
    mask = np.zeros((7, 7))
    mask[1:6, 1:6] = 1
    np.savez(tmp_path / "night.npz", **found, control_matrix=control, cells=mask, frame_rate_hz=250.0)
    (tmp_path / "system.toml").write_text('slope_unit = "arcsec"')
    loop: Any = read_recorded_loop(tmp_path / "night.npz", tmp_path / "system.toml")
    assert loop.interaction_matrix.shape == (50, 36)
    assert np.array_equal(loop.cells, CELLS + 1)
    assert loop.pixel_scale_arcsec == 1.0


@pytest.mark.parametrize("closed", mostly_slow(1, [True, False]))
def test_what_is_written_as_aot_is_read_as_from_the_store(tmp_path: Path, closed: bool) -> None:
    pytest.importorskip("aotpy")
    scales = {"pixel_scale_arcsec": 0.3, "subaperture_m": 0.5, "diameter_m": 1.6}
    records = np.zeros(15, item_type("frame", {**SIZES, "command": 4}, ()))
    for name in RECORD.names or ():
        records[name] = records_of(10, 15)[name]
    records["loop"], records["flags"] = 1 + closed, 0
    records["commands"] = np.arange(60).reshape(15, 4)
    attributes = {**ATTRIBUTES, "layout": ATTRIBUTES["layout"] | scales}
    store = TelemetryStore(tmp_path / "night.zarr", records.dtype, IMAGE, attributes)
    store.append(records, images_of(10), {})
    write_aot(tmp_path / "night.fits", read_telemetry(store.path))
    known = {"frame_rate_hz": 1000.0}
    loops: list[Any] = [
        read_recorded_loop(tmp_path / name, stated=known) for name in ("night.zarr", "night.fits")
    ]
    for name in ("slopes", "commands", "cells", "frame"):
        np.testing.assert_allclose(getattr(loops[1], name), getattr(loops[0], name), err_msg=name)
    for name in ("is_closed", "slope_unit", "subaperture_m"):
        assert getattr(loops[1], name) == getattr(loops[0], name)
    assert loops[1].pixel_scale_arcsec == pytest.approx(0.3)


def test_aot_file_is_read(tmp_path: Path) -> None:
    aotpy = pytest.importorskip("aotpy")
    found = arrays()
    mirror = aotpy.DeformableMirror("DM", n_valid_actuators=36, telescope=aotpy.MainTelescope("T"))
    mirror.telescope.enclosing_diameter = 3.0
    system = aotpy.AOSystem(ao_mode="SCAO", main_telescope=mirror.telescope)
    source = aotpy.NaturalGuideStar("S")
    mask = aotpy.Image("mask", np.arange(25).reshape(5, 5))
    sensor = aotpy.ShackHartmann("WFS", source=source, n_valid_subapertures=25, subaperture_mask=mask)
    sensor.measurements = aotpy.Image("slopes", found["slopes"].reshape(-1, 2, 25))
    sensor.detector = aotpy.Detector("D", pixel_scale=0.2 * np.pi / 180 / 3600)
    system.sources, system.wavefront_sensors = [source], [sensor]
    system.wavefront_correctors = [mirror]
    matrix = found["interaction_matrix"].reshape(2, 25, 36).swapaxes(0, 1)
    loop = aotpy.ControlLoop("loop", input_sensor=sensor, commanded_corrector=mirror)
    loop.framerate, loop.delay = 250.0, 2.0
    loop.commands = aotpy.Image("commands", found["commands"])
    loop.interaction_matrix = aotpy.Image("matrix", matrix)
    system.loops = [loop]
    system.write_to_file(tmp_path / "night.fits")
    with refused("slope_unit", "--slope-unit"):
        read_recorded_loop(tmp_path / "night.fits")
    (tmp_path / "unit.toml").write_text('slope_unit = "px"')
    loop = read_recorded_loop(tmp_path / "night.fits", tmp_path / "unit.toml")
    assert np.allclose(loop.slopes, recorded().slopes)
    assert loop.delay_frames == 2.0
    assert loop.subaperture_m == pytest.approx(0.6)
    assert loop.pixel_scale_arcsec == pytest.approx(0.2)


def small() -> dict[str, Any]:
    """Arrays and numbers of a recording of four sub-apertures."""
    slopes = np.random.default_rng(1).standard_normal((20, 8))
    return {"slopes": slopes, "commands": slopes[:, :3], "slope_unit": "px", "frame_rate_hz": 250.0}


COLUMN = np.arange(20)[:, None]
WRONG: dict[str, list[Any]] = {
    "time_s": [3.0, np.zeros(20)],
    "frame": [3, COLUMN.astype(str), COLUMN + 0.5, COLUMN * 1j],
    "slopes": [3.0, np.zeros((20, 9)), np.full((20, 8), "1.5"), np.full((20, 8), 1j)],
    "commands": [3.0, np.zeros((7, 36))],
    "interaction_matrix": [np.ones((8, 2))],
    "control_matrix": [3.0],
    "flags": [np.zeros((20, 3), int)],
    "slope": [1.0],
    "cells": [
        3,
        np.zeros((4, 2)),
        [[0, 0], [0, 1], [10**6, 0], [1, 1]],
        np.full((4, 2), 1e300),
        [[0, 0], [0, 1], [1, 0], [1, 0.5]],
    ],
    **{name: [True, 1e300, 1e-300, [1.0, 2.0]] for name in NUMBERS},
}


def test_values_that_are_wrong(tmp_path: Path) -> None:
    for name, values in WRONG.items():
        for value in values:
            np.savez(tmp_path / "night.npz", **{**small(), name: value})
            with refused(name):
                read_recorded_loop(tmp_path / "night.npz")
    for text in ("3", "[[1, 2], [3]]", '[["a", "b"]]', "true", "[]", "{a = 1}"):
        (tmp_path / "night.toml").write_text(f'slopes = {text}\nslope_unit = "px"\nframe_rate_hz = 250')
        with refused("slopes"):
            read_recorded_loop(tmp_path / "night.toml")
    slopes = small()["slopes"]
    slopes[:, 7] *= 1e10
    with refused("columns 7"):
        prepared(Recording(slopes, None, None, np.ones((2, 2)), 250.0))


def test_rows_of_files(tmp_path: Path) -> None:
    """Times and frame numbers in a column, as a CSV is read; a first row not measured is no line of names."""
    np.savez(tmp_path / "night.npz", **small(), time_s=COLUMN / 125, frame=2 * COLUMN)
    loop = read_recorded_loop(tmp_path / "night.npz")
    assert np.array_equal(loop.frame, 2 * np.arange(20))
    (tmp_path / "night.csv").write_text("x,y\n,nan\n1,2\n3,4\n")
    stated: dict[str, Any] = {"slope_unit": "px", "frame_rate_hz": 9.0, "cells": [[0, 0]]}
    (tmp_path / "system.toml").write_text("".join(f"{name} = {value!r}\n" for name, value in stated.items()))
    loop = read_recorded_loop(tmp_path / "night.csv", tmp_path / "system.toml")
    np.testing.assert_array_equal(loop.slopes, [[np.nan] * 2, [1, 2], [3, 4]])


def test_frame_rate_of_frames_that_were_buffered() -> None:
    """Time stamps of ten frames lie close together; a gap, and a pause, are no frames."""
    frame = np.delete(np.arange(1000), slice(400, 420))
    time_s = (frame // 10 * 10) / 250 + frame % 10 * 1e-6 + 7.0 * (frame > 700)
    assert frame_rate(time_s, frame) == pytest.approx(250, rel=1e-3)


def test_slopes_of_frames_are_those_of_an_open_loop(tmp_path: Path) -> None:
    """Slopes in the axes of a turned array; what is flagged is left out, unless kept or in the response."""
    pytest.importorskip("zarr")
    layout = replace(fs.Layout.grid((3, 3), pixels=8), angle_deg=90.0, pixel_scale_arcsec=0.2, diameter_m=1.8)
    layout.save(tmp_path / "faintspot.toml")
    fs.Settings("centroid").save(tmp_path / "faintspot.toml")
    rng = np.random.default_rng(1)
    values = {name: np.zeros((20, 9)) for name in ("flux", "valid", "flags", "iterations", "bad_pixels")}
    x, y = rng.normal(0, 1, (2, 20, 9))
    values["flags"][3, 4], values["flags"][5, 6] = SubapertureFlag.NO_FLUX, SubapertureFlag.AT_SEARCH_LIMIT
    attributes: dict[str, object] = {
        "fingerprint": "one",
        "configuration": (tmp_path / "faintspot.toml").read_text(),
    }
    keep, response = {"keep": ["limited"]}, {"response": [0.5] * 18}
    for name, more, gain in (("a.zarr", keep, 1.0), ("b.npz", keep, 1.0), ("c.zarr", response, 0.5)):
        with create_writer(
            tmp_path / name, n_frames=20, n_subapertures=9, attributes={**attributes, **more}, coordinates={}
        ) as writer:
            writer.append(0, {"x": x, "y": y, **values})
        with refused("frame_rate_hz", "--frame-rate-hz"):
            read_recorded_loop(tmp_path / name)
        loop = read_recorded_loop(tmp_path / name, stated={"frame_rate_hz": 100.0})
        assert not loop.is_closed
        assert (loop.commands, loop.subaperture_m, loop.pixel_scale_arcsec) == (None, 0.6, 0.2)
        assert np.array_equal(loop.cells, layout.cells)
        expected = np.hstack([y, -x]) / gain
        expected[3, [4, 13]] = np.nan
        assert np.allclose(loop.slopes, expected, atol=1e-6, equal_nan=True)


OPTIONS: dict[str, Any] = {"subaperture_m": 0.6, "pixel_scale_arcsec": 0.2, "slope_unit": "px"}


@pytest.mark.parametrize("writer", mostly_slow(1, list(loop_layouts.WRITERS)))
def test_files_of_others_give_the_same_loop(tmp_path: Path, writer: str) -> None:
    """With their matrices, frame rate and lost frames; what was taken from where is the first remark."""
    pytest.importorskip("astropy")
    known = recorded()
    written = loop_layouts.Loop(known.slopes, known.commands, known.interaction_matrix, np.ones((5, 5)))
    path, options = loop_layouts.WRITERS[writer](tmp_path, written), dict(OPTIONS)
    if writer == "milk":
        np.save(tmp_path / "im.npy", known.interaction_matrix)
        options |= {"slopes": "wfs", "commands": "dm", "interaction_matrix": f"{tmp_path / 'im.npy'}"}
    loop = read_recorded_loop(path, stated=options)
    assert loop.frame_rate_hz == pytest.approx(250.0, rel=1e-3)  # times are rounded to microseconds
    same(replace(loop, frame_rate_hz=250.0))
    np.testing.assert_allclose(loop.interaction_matrix, known.interaction_matrix)
    assert np.array_equal(np.diff(loop.frame), np.ones(len(known.slopes) - 1))
    assert loop.remarks[0].startswith("read as ")
    assert "slope_unit as given" in loop.remarks[0]
    assert prepared(loop).sent_after_frames == 0


def test_a_question_at_a_time(tmp_path: Path) -> None:
    """Each error names the option that answers it; then what is still not known is a remark."""
    slopes = np.random.default_rng(1).standard_normal((300, 42))
    np.savez(tmp_path / "loop.npz", wfs=slopes, mask=np.pad(np.ones((3, 7)), 1))
    answers: list[tuple[str, Any]] = [
        ("slopes", "wfs"),
        ("slope_unit", "px"),
        ("frame_rate_hz", 100.0),
        ("cells", "mask"),
    ]
    stated: dict[str, Any] = {}
    for name, answer in answers:
        with refused(match=name.replace("_", "[-_]")):
            read_recorded_loop(tmp_path / "loop.npz", stated=stated)
        stated[name] = answer
    loop = read_recorded_loop(tmp_path / "loop.npz", stated=stated)
    assert len(loop.cells) == 21
    unknown = next(line for line in loop.remarks if line.startswith("not known: "))
    for option in ("--commands", "--interaction-matrix", "--pixel-scale-arcsec", "--diameter-m", "law"):
        assert option in unknown


@pytest.mark.slow
def test_tip_tilt_of_keck(tmp_path: Path) -> None:
    """Commands are in the axes and the unit of the slopes; the loop is one aperture."""
    rng = np.random.default_rng(2)
    tilt = np.cumsum(rng.standard_normal((1500, 2)), axis=0)
    slopes, commands = np.zeros((1500, 2)), np.zeros((1500, 2))
    for frame in range(2, 1500):
        slopes[frame] = tilt[frame] + commands[frame - 2] + 0.1 * rng.standard_normal(2)
        commands[frame] = commands[frame - 1] - 0.3 * slopes[frame]
    written = loop_layouts.Loop(slopes, commands, np.eye(2), np.ones((1, 1)))
    path = loop_layouts.keck(tmp_path, written)
    loop = read_recorded_loop(path, stated={"slope_unit": "arcsec"})
    np.testing.assert_array_equal(loop.slopes, slopes)
    np.testing.assert_array_equal(loop.interaction_matrix, np.eye(2))
    assert loop.frame_rate_hz == pytest.approx(250.0, rel=1e-4)
    ready = prepared(loop)
    assert (ready.sign, ready.sent_after_frames) == (1.0, 0)
    assert ready.loop_gain == pytest.approx(0.3, abs=0.01)
    delay = report_of_loop(loop, compare=False).parts["loop"].values[0]
    assert delay.value == pytest.approx(2.0, abs=3 * delay.error)
    assert 0 < delay.error < 0.2


def test_slopes_of_a_folder_in_three_dimensions(tmp_path: Path) -> None:
    """(frames, n, 2) says itself which is x; the order is that of flat rows."""
    slopes = np.random.default_rng(1).standard_normal((30, 9, 2))
    np.save(tmp_path / "slopes.npy", slopes)
    stated: dict[str, float | str] = {"slope_unit": "px", "frame_rate_hz": 100.0, "loop": "open"}
    for order in ("axes", "pairs"):
        loop: Any = read_recorded_loop(tmp_path, stated={**stated, "slope_order": order})
        np.testing.assert_array_equal(loop.slopes, np.hstack([slopes[..., 0], slopes[..., 1]]))


@pytest.mark.slow
def test_sensor_without_cells(tmp_path: Path) -> None:
    """Slopes of any number and order; delay, noise and limits are reported, and no turbulence."""
    pytest.importorskip("matplotlib")
    pytest.importorskip("jinja2")
    known = recorded()
    order = np.random.default_rng(5).permutation(50)[:37]
    arrays_ = {"slopes": known.slopes[:1200, order], "commands": known.commands[:1200]}
    np.savez(tmp_path / "loop.npz", **arrays_, interaction_matrix=known.interaction_matrix[order])
    stated: dict[str, Any] = {"slope_unit": "px", "frame_rate_hz": 250.0, "cells": "none"}
    loop = read_recorded_loop(tmp_path / "loop.npz", stated=stated)
    assert loop.cells is None
    np.testing.assert_array_equal(loop.slopes, known.slopes[:1200, order])
    report = report_of_loop(replace(loop, delay_frames=2.0))
    values = {value.name: value.value for part in report.parts.values() for value in part.values}
    assert values["noise of a slope"] == pytest.approx(0.3, rel=0.1)
    assert not report.parts["turbulence"].values
    assert "cells" in report.parts["choices"].missing
    page_of_loop(report)
