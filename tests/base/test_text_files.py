"""TOML and JSON texts: errors in one line, and JSON without NaN."""

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot
from faintspot.base import text_files
from faintspot.base.errors import InputError
from faintspot.base.text_files import parse_json, plain_values, to_json


def test_a_file_gives_its_tables(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text('# a comment\n[table]\nname = "é"\n', encoding="utf-8")
    assert text_files.parse_file(path) == {"table": {"name": "é"}}
    path.unlink()
    with refused(f"{path}", "`make demo`"):
        text_files.parse_file(path, if_missing="`make demo` makes one")


def test_unknown_and_missing_keys_are_named() -> None:
    for table, message in (
        ({"noise_std": 1, "nois_std": 1}, "settings.nois_std: unknown key; did you mean noise_std?"),
        ({"noise_std": 1, "zzz": 1}, "settings.zzz: unknown key; known: noise_std, rule"),
        ({"rule": 1}, "settings.noise_std: expected a value, found none"),
    ):
        text_files.check_keys("settings.", {"noise_std": 1}, ("noise_std", "rule"), required=["noise_std"])
        with pytest.raises(InputError) as error:
            text_files.check_keys("settings.", table, ("noise_std", "rule"), required=["noise_std"])
        assert str(error.value) == message


# The page's server looks for lone surrogates, which text may hold in memory and not in a message.
OTHERS = {"base/text_files.py", "engine/page/server.py"}


def test_values_that_json_lacks_are_written_as_it_has_them() -> None:
    given = {
        "inf": np.float64("inf"),
        3: (np.int64(2), [float("-inf")]),
        "array": np.array([[1.5, np.nan]], np.float32),
        "path": Path("a"),
        "flags": [np.True_, None],
        "other": 1j,
    }
    expected = {
        "inf": None,
        "3": [2, [None]],
        "array": [[1.5, None]],
        "path": "a",
        "flags": [True, None],
        "other": "1j",
    }
    assert plain_values(given) == expected
    assert json.loads(to_json(given)) == expected
    assert to_json({"a": 1}, indent=1) == '{\n "a": 1\n}'


@pytest.mark.parametrize(
    ("value", "error"), [(math.nan, ValueError), ([math.inf], ValueError), (1j, TypeError)]
)
def test_exact_text_holds_values_as_they_are(value: Any, error: type[Exception]) -> None:
    with pytest.raises(error):
        to_json({"a": value}, exact=True)
    assert to_json({"a": Path("b"), "c": np.arange(2)}, exact=True) == '{"a": "b", "c": [0, 1]}'


@pytest.mark.parametrize("text", ["[" * 100_000, b"\xff", "{", "NaN", '{"a": [-Infinity]}'])
def test_text_that_is_not_json_is_refused(text: str | bytes) -> None:
    assert parse_json('{"a": [1]}') == {"a": [1]}
    with pytest.raises(ValueError):  # noqa: PT011
        parse_json(text)


def test_all_json_is_written_and_read_here() -> None:
    package = Path(faintspot.__file__).parent
    files = sorted(package.rglob("*.py"))
    assert len(files) > 300
    imported = re.compile(r"^\s*(?:import|from) json\b", re.MULTILINE)
    users = {file for file in files if imported.search(file.read_text(encoding="utf-8"))}
    assert {file.relative_to(package).as_posix() for file in users} == OTHERS
