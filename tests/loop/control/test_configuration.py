"""[control] of faintspot.toml: what is refused, in one line that says where."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.loop.control.control_cases import INTERACTION
from tests.loop.telemetry.alternation_cases import MATRIX
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.loop.control.configuration import (
    Control,
    load_control,
    packed_control,
    save_control,
    unpacked_control,
)
from faintspot.loop.control.options import ControlOptions
from faintspot.slopes.pipeline import configuration as configuration_file
from faintspot.slopes.sensor.layout import Layout


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
    with pytest.raises(InputError):
        Control(INTERACTION, positions.T)


BAD = INTERACTION.copy()
BAD[3, 4] = np.nan


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("", "control.interaction_matrix: expected a value, found none"),
        ("interaction_matrix = 3", "interaction_matrix: expected the name of a file, found 3"),
        ('interaction_matrix = "none.npy"', "none.npy: no such file"),
        ('interaction_matrix = "nan.npy"', "interaction_matrix: expected finite numbers, got 1 NaN"),
        ('interaction_matrix = "wide.npy"', "no more commands than slopes, got (12, 18)"),
        ('interaction_matrix = "line.npy"', "expected shape (2 n, commands), got (18,)"),
        ('interaction_matrix = "zero.npy"', "expected slopes that follow the commands, got zeros only"),
        (
            'interaction_matrix = "good.npy"\nreference_slopes = "wide.npy"',
            "reference_slopes: expected shape (18,)",
        ),
        ('interaction_matrix = "good.npy"\ngian = 1', "control.gian: unknown key; did you mean gain?"),
        ('interaction_matrix = "good.npy"\ngain = 3', "control.gain = 3: expected a number from 0 to 2"),
    ],
)
def test_what_is_refused(tmp_path: Path, line: str, message: str) -> None:
    arrays = {
        "good": INTERACTION,
        "nan": BAD,
        "wide": INTERACTION.T,
        "line": INTERACTION[:, 0],
        "zero": np.zeros((18, 12)),
    }
    path = _written(tmp_path, f"[control]\n{line}\n", **arrays)
    with refused(message, str(path)):
        load_control(path)


def test_another_sensor_is_refused() -> None:
    control = Control(INTERACTION)
    control.check_fits(9)
    expected = "expected 32 rows for 16 sub-apertures (all x, then all y), got 18"
    with pytest.raises(InputError, match=re.escape(expected)):
        control.check_fits(len(Layout.grid((4, 4), pixels=8)))


def test_matrix_and_options_are_read_as_they_were_written() -> None:
    options = ControlOptions(gain=0.3, delay_frames=3, centroid_gain=0.8, largest_command=500.0)
    packed = json.loads(json.dumps(packed_control(Control(MATRIX, options=options))))
    found = unpacked_control({"control": packed})
    assert found is not None
    np.testing.assert_allclose(found.interaction, MATRIX, rtol=1e-6)
    assert found.options == options


def test_what_is_not_recorded() -> None:
    assert packed_control(None) is None
    assert unpacked_control({}) is None
    assert unpacked_control({"control": None}) is None
    large = Control(np.vstack([np.eye(400), np.zeros((400, 400))]))
    assert large.interaction.size * 4 > 1 << 20
    assert packed_control(large) is None


@pytest.mark.parametrize(
    "damage", [{"interaction_matrix": "?"}, {"shape": [3, 5]}, {"gain": 7}, {"unknown": 1}]
)
def test_damage_is_refused(damage: dict[str, object]) -> None:
    packed = packed_control(Control(MATRIX))
    assert packed is not None
    with refused("control: the recorded control is damaged"):
        unpacked_control({"control": {**packed, **damage}})
