"""[control] of faintspot.toml: what is refused, in one line that says where."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from tests.loop.control.control_cases import INTERACTION
from tests.loop.telemetry.alternation_cases import MATRIX
from tests.refusals import refused

from faintspot.loop.control.configuration import (
    Control,
    load_control,
    packed_control,
    save_control,
    unpacked_control,
)
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.pipeline import configuration as configuration_file


def _written(folder: Path, text: str, **arrays: Any) -> Path:
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)
    path = folder / "faintspot.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_round_trip_beside_what_else_there_is(tmp_path: Path) -> None:
    path = _written(tmp_path, '# mine\n[estimator]\nname = "centroid"\n', matrix=INTERACTION)
    np.savez(tmp_path / "both.npz", flat=np.arange(18.0), other=INTERACTION)
    assert load_control(path) is None
    save_control(path, interaction_matrix="matrix.npy", reference_slopes="both.npz:flat", gain=0.3)
    save_control(path, largest_command=50.0)
    control = load_control(path)
    assert control is not None
    assert control.options == ControlOptions(gain=0.3, largest_command=50.0)
    np.testing.assert_array_equal(control.interaction, INTERACTION)
    np.testing.assert_array_equal(control.reference, np.arange(18.0))
    assert control.commands == 12
    assert "# mine" in path.read_text()
    assert configuration_file.has(path, "control")


def test_reference_as_positions() -> None:
    positions = np.arange(18.0).reshape(9, 2)
    np.testing.assert_array_equal(Control(INTERACTION, positions).reference, positions.T.reshape(-1))
    with refused():
        Control(INTERACTION, positions.T)


BAD = INTERACTION.copy()
BAD[3, 4] = np.nan


def test_what_is_refused(tmp_path: Path) -> None:
    arrays = {"good": INTERACTION, "nan": BAD, "wide": INTERACTION.T, "line": INTERACTION[:, 0]}
    good = 'interaction_matrix = "good.npy"\n'
    for text, *words in (
        ("", "control.interaction_matrix", "none"),
        ("interaction_matrix = 3", "interaction_matrix", "3"),
        ('interaction_matrix = "none.npy"', "none.npy: no such file"),
        ('interaction_matrix = "nan.npy"', "interaction_matrix", "1 NaN"),
        ('interaction_matrix = "wide.npy"', "interaction_matrix", "(12, 18)"),
        ('interaction_matrix = "line.npy"', "(2 n, commands)", "(18,)"),
        ('interaction_matrix = "zero.npy"', "zeros"),
        (f'{good}reference_slopes = "wide.npy"', "reference_slopes", "(18,)"),
        (f"{good}gian = 1", "control.gian", "gain?"),
        (f"{good}gain = 3", "control.gain = 3", "0 to 2"),
    ):
        path = _written(tmp_path, f"[control]\n{text}\n", **arrays, zero=np.zeros((18, 12)))
        with refused(*words, str(path)):
            load_control(path)
    Control(INTERACTION).check_fits(9)
    for n in (8, 16):
        with refused("interaction_matrix", f"{2 * n} rows", "18"):
            Control(INTERACTION).check_fits(n)


def test_matrix_and_options_are_read_as_they_were_written() -> None:
    options = ControlOptions(gain=0.3, delay_frames=3, centroid_gain=0.8, largest_command=500.0)
    packed = json.loads(json.dumps(packed_control(Control(MATRIX, options=options))))
    found = unpacked_control({"control": packed})
    assert found is not None
    np.testing.assert_allclose(found.interaction, MATRIX, rtol=1e-6)
    assert found.options == options
    damages: Any = {"interaction_matrix": "?"}, {"shape": [3, 5]}, {"gain": 7}, {"unknown": 1}
    for damage in damages:
        with refused("control"):
            unpacked_control({"control": {**packed, **damage}})


def test_what_is_not_recorded() -> None:
    assert packed_control(None) is None
    assert unpacked_control({}) is None
    assert unpacked_control({"control": None}) is None
    large = Control(np.vstack([np.eye(400), np.zeros((400, 400))]))
    assert large.interaction.size * 4 > 1 << 20
    assert packed_control(large) is None
