"""Telemetry of observatories and benches: arrays, rates and units; what is not known is asked for."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.io import idl_file, loop_layouts
from tests.io.loop_layouts import RATE_HZ, START_S, Loop, pairs, random_loop
from tests.refusals import refused

from faintspot.io.loop_layouts import LAYOUTS, read_layout

fits = pytest.importorskip("astropy.io.fits")
LOOP = random_loop()
FRAMES = len(LOOP.slopes)


@pytest.mark.parametrize("whole_folder", [False, True])
def test_sparta_with_interaction_matrices(tmp_path: Path, whole_folder: bool) -> None:
    state: dict[str, Any] = {"HO_LOOP_ST": True, "GLOBAL_GAIN": 0.4, "LOOP_RATE": 499.0}
    path = loop_layouts.sparta(tmp_path, LOOP, **state)
    values = read_layout(tmp_path if whole_folder else path, {})
    np.testing.assert_array_equal(values["slopes"], pairs(LOOP.slopes))
    np.testing.assert_array_equal(values["commands"], LOOP.commands)
    np.testing.assert_array_equal(values["interaction_matrix"], pairs(LOOP.matrix, 0))
    np.testing.assert_array_equal(values["frame"], np.arange(FRAMES) + LOOP.first)
    np.testing.assert_allclose(values["time_s"] - START_S, np.arange(FRAMES) / RATE_HZ, atol=1e-6)
    assert values["slope_order"] == "pairs"
    assert values["loop"] == "closed"
    assert values["control_law"] == "ESO AOS GLOBAL GAIN = 0.4"
    assert values["sources"] == {
        "slopes": "Gradients",
        "commands": "HODM_Positions, ITTM_Positions",
        "interaction_matrix": "CLMatrixOptimiser.HO_IM.fits, CLMatrixOptimiser.ITT_IM.fits",
        "frame": "FrameCounter",
        "time_s": "Seconds, USeconds",
    }
    assert "frame_rate_hz" not in values  # the times are those of the frames themselves


def test_sparta_with_the_control_matrix_of_both_mirrors(tmp_path: Path) -> None:
    path = loop_layouts.sparta(tmp_path, LOOP, control=True, LOOP_ST=False)
    values = read_layout(path, {})
    np.testing.assert_allclose(values["control_matrix"], np.linalg.pinv(pairs(LOOP.matrix, 0)))
    assert values["loop"] == "open"
    assert "interaction_matrix" not in values
    (tmp_path / "Recn.REC1.CM_0001.fits").unlink()
    values = read_layout(path, {})
    np.testing.assert_array_equal(values["commands"], LOOP.commands[:, :-2])
    np.testing.assert_array_equal(values["interaction_matrix"], pairs(LOOP.matrix, 0)[:, :-2])
    assert values["remarks"] == ["commands: ITTM_Positions left out, as there is no matrix for it"]
    np.save(tmp_path / "whole.npy", LOOP.matrix)
    values = read_layout(path, {"interaction_matrix": "whole.npy"})
    np.testing.assert_array_equal(values["commands"], LOOP.commands)
    np.testing.assert_array_equal(values["interaction_matrix"], LOOP.matrix)
    for file in tmp_path.glob("RecnOptimiser*"):
        file.unlink()
    values = read_layout(path, {})
    assert not {"interaction_matrix", "control_matrix"} & values.keys()
    np.testing.assert_array_equal(values["commands"], LOOP.commands)


def table(path: Path, header: Any = None, **columns: Any) -> Path:
    """Write a table with columns of float64, and cards of the primary header."""
    described = [
        fits.Column(name, f"{np.asarray(values)[0].size}D", array=values) for name, values in columns.items()
    ]
    primary = fits.PrimaryHDU(header=fits.Header(header or {}))
    fits.HDUList([primary, fits.BinTableHDU.from_columns(described)]).writeto(path)
    return path


NAMES = ("HODM_Positions", "DSM_Positions", "DM_Positions", "ModalCoefficients", "Positions", "IFM_Positions")


def test_commands_of_other_tables(tmp_path: Path) -> None:
    for name in NAMES:
        path = table(tmp_path / f"{name}.fits", Gradients=LOOP.slopes, **{name: LOOP.commands})
        values = read_layout(path, {})
        np.testing.assert_array_equal(values["commands"], LOOP.commands)
        assert values["sources"]["commands"] == name
        assert "time_s" not in values


def test_numbers_and_times_that_do_not_rise(tmp_path: Path) -> None:
    """Rows read twice are left out; times of 0, as some tables have, are not used."""
    rows = [0, 1, 2, 2, 1, 3, *range(4, 30)]
    stamps = {"FrameCounter": np.array(rows, float), "Seconds": np.zeros(len(rows))}
    header = {"HIERARCH ESO AOS LOOP RATE": 499.5}
    values = read_layout(table(tmp_path / "t.fits", header, Gradients=LOOP.slopes[rows], **stamps), {})
    np.testing.assert_array_equal(values["slopes"], LOOP.slopes[:30])
    np.testing.assert_array_equal(values["frame"], np.arange(30))
    assert "time_s" not in values
    assert values["frame_rate_hz"] == 499.5
    assert values["sources"]["frame_rate_hz"] == "ESO AOS LOOP RATE"
    assert [line.split(":")[0] for line in values["remarks"]] == ["times", "frame"]


def test_rows_out_of_order_do_not_lose_the_times(tmp_path: Path) -> None:
    """The times that are left belong to the frames that are left."""
    path = loop_layouts.sparta(tmp_path, LOOP)
    with fits.open(path) as file:
        table = file[1].data
        rows = np.r_[0:10, 8:20, 21, 20, 22:40]  # two repeated, two swapped
        fits.HDUList([file[0], fits.BinTableHDU(table[rows], file[1].header)]).writeto(tmp_path / "t.fits")
    values = read_layout(tmp_path / "t.fits", {})
    kept = np.r_[0:20, 21:40]
    np.testing.assert_array_equal(values["frame"], kept + LOOP.first)
    np.testing.assert_allclose(values["time_s"] - START_S, kept / RATE_HZ, atol=2e-6)
    assert len(values["slopes"]) == len(values["commands"]) == len(kept)


@pytest.mark.parametrize(
    ("state", "loop"), [("OFF", "open"), ("opened", "open"), (0.0, "open"), (1.0, "closed"), ("ON", "closed")]
)
def test_states_of_the_loop(tmp_path: Path, state: Any, loop: str) -> None:
    assert read_layout(loop_layouts.sparta(tmp_path, LOOP, LOOP_ST=state), {})["loop"] == loop


def test_tables_that_are_not_known(tmp_path: Path) -> None:
    path = table(tmp_path / "t.fits", WFS1_Gradients=LOOP.slopes, Volts=LOOP.commands)
    with refused("t.fits", "--slopes", "--commands", "WFS1_Gradients, Volts"):
        read_layout(path, {})
    np.save(tmp_path / "im.npy", LOOP.matrix)
    named = {"slopes": "wfs1_gradients", "commands": "Volts", "interaction_matrix": "im.npy"}
    values = read_layout(path, named)
    np.testing.assert_array_equal(values["slopes"], LOOP.slopes)
    np.testing.assert_array_equal(values["commands"], LOOP.commands)
    np.testing.assert_array_equal(values["interaction_matrix"], LOOP.matrix)
    with refused("--slopes", "absent", "t.fits", "WFS1_Gradients, Volts"):
        read_layout(path, {"slopes": "absent"})
    number = np.arange(FRAMES) * 1.0
    times = {"FrameCounter": number, "Seconds": number, "USeconds": 0 * number}
    values = read_layout(
        table(tmp_path / "u.fits", WFS1=LOOP.slopes, WFS2=LOOP.slopes, **times), {"slopes": "WFS1"}
    )
    np.testing.assert_array_equal(values["time_s"], number)
    np.testing.assert_array_equal(values["frame"], number)


def test_layouts_differ_in_their_slopes() -> None:
    assert len({layout.slopes for layout in LAYOUTS}) == len(LAYOUTS)


def test_several_tables_in_a_folder(tmp_path: Path) -> None:
    for name in "ab":
        table(tmp_path / f"{name}.fits", Gradients=LOOP.slopes, DM_Positions=LOOP.commands)
    with refused("a.fits, b.fits"):
        read_layout(tmp_path, {})


@pytest.mark.parametrize(
    ("name", "shape", "option"),
    [("HO_IM", (18, 4), "--interaction-matrix"), ("x.REC1.CM", (2, 18), "--control-matrix")],
)
def test_matrices_that_do_not_fit(tmp_path: Path, name: str, shape: tuple[int, int], option: str) -> None:
    path = loop_layouts.sparta(tmp_path, LOOP)
    for file in tmp_path.glob("CLMatrix*"):
        file.unlink()
    fits.writeto(tmp_path / f"{name}.fits", np.ones(shape))
    with refused(f"{name}.fits", option):
        read_layout(path, {})
    (tmp_path / f"{name}.fits").write_bytes(b"SIMPLE  = no")
    with refused(f"{name}.fits"):
        read_layout(path, {})


def tip_tilt() -> Loop:
    return LOOP._replace(slopes=LOOP.slopes[:, :2], commands=LOOP.commands[:, :2])


def test_keck_tip_tilt(tmp_path: Path) -> None:
    values = read_layout(loop_layouts.keck(tmp_path, tip_tilt()), {})
    np.testing.assert_array_equal(values["slopes"], LOOP.slopes[:, :2])
    np.testing.assert_array_equal(values["commands"], LOOP.commands[:, :2])
    np.testing.assert_array_equal(values["interaction_matrix"], np.eye(2))
    np.testing.assert_allclose(values["time_s"], np.arange(FRAMES) / RATE_HZ)
    assert values["control_law"] == "DT_SERVO = 0.3 0 0 0 -0.99 0 0 0"
    assert "slope_unit" not in values


def test_keck_has_two_loops(tmp_path: Path) -> None:
    path = loop_layouts.keck_high_order(tmp_path, LOOP)
    with refused("--slopes", "A.OFFSETCENTROID, A.RESIDUALWAVEFRONT"):
        read_layout(path, {})
    values = read_layout(path, {"slopes": "a.offsetcentroid"})
    np.testing.assert_allclose(values["slopes"], pairs(LOOP.slopes), rtol=1e-6)
    np.testing.assert_allclose(values["commands"], LOOP.commands, rtol=1e-6)
    control = np.linalg.pinv(pairs(LOOP.matrix, 0))
    np.testing.assert_allclose(values["control_matrix"], control, rtol=1e-6, atol=1e-7)
    assert values["cells"].sum() == 304
    assert (values["slope_unit"], values["subaperture_m"]) == ("px", 0.5625)
    values = read_layout(path, {"slopes": "A.RESIDUALWAVEFRONT"})
    np.testing.assert_allclose(values["slopes"], LOOP.slopes[:, :2], rtol=1e-6)
    np.testing.assert_allclose(values["commands"], LOOP.commands[:, -2:], rtol=1e-6)
    assert values["slope_unit"] == "arcsec"
    with refused("n.sav", "--slopes", "A.VOLTS"):
        read_layout(idl_file.write(tmp_path / "n.sav", {"A": {"VOLTS": LOOP.commands, "U": np.eye(3)}}), {})


def test_folder_of_texts(tmp_path: Path) -> None:
    values = read_layout(loop_layouts.texts(tmp_path, LOOP), {})
    for name, expected in (("slopes", LOOP.slopes), ("commands", LOOP.commands), ("cells", LOOP.mask)):
        np.testing.assert_array_equal(values[name], expected)
    np.testing.assert_array_equal(values["interaction_matrix"], LOOP.matrix)
    np.testing.assert_allclose(values["time_s"], np.arange(FRAMES) / RATE_HZ)
    assert values["slope_unit"] == "rad"
    assert values["sources"]["interaction_matrix"] == "poke.txt"
    (tmp_path / "y_slopes.csv").unlink()
    with refused("--slopes", "commands, poke, reference_mask, time_s, x_slopes"):
        read_layout(tmp_path, {})
    values = read_layout(tmp_path, {"slopes": "commands", "cells": "reference_mask.txt"})
    np.testing.assert_array_equal(values["slopes"], LOOP.commands)


def test_single_array_is_slopes(tmp_path: Path) -> None:
    fits.writeto(tmp_path / "slopes.fits", LOOP.slopes)
    values = read_layout(tmp_path / "slopes.fits", {})
    np.testing.assert_array_equal(values["slopes"], LOOP.slopes)
    with refused("none"):
        (tmp_path / "empty").mkdir()
        read_layout(tmp_path / "empty", {})
