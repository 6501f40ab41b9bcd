"""What people write is understood, or refused in one line; and quickly."""

import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.base.tables import parse_changes, parse_ranges


def test_changes_are_parsed_to_their_types() -> None:
    texts = ["noise_std=2.5", " keep_brightest = 20", "denoise=TRUE", "flux_e=none", "rule=threshold"]
    assert parse_changes([*texts, "tolerance=1e-3,0.1", "steps=3"]) == {
        "noise_std": 2.5,
        "keep_brightest": 20,
        "denoise": True,
        "flux_e": None,
        "rule": "threshold",
        "tolerance": [1e-3, 0.1],
        "steps": 3,
    }


@pytest.mark.parametrize(
    "texts", [[], ["noise_std"], ["=2"], ["noise_std="], ["noise_std=1,,2"], ["rule=a", "rule=b"]]
)
def test_changes_that_cannot_be_parsed(texts: list[str]) -> None:
    with refused():
        parse_changes(texts)


def test_ranges_of_subapertures_are_parsed() -> None:
    assert parse_ranges("4,5,10-13") == [4, 5, 10, 11, 12, 13]
    assert parse_ranges(" 7 , 3-3, 2-4 ") == [7, 3, 2, 4]


@pytest.mark.parametrize(
    "text", ["", "a", "1,", "3-1", "-1", "1-2-3", "1.5", "0-99999999999", "0-1000000", "²"]
)
def test_subapertures_that_cannot_be_parsed(text: str) -> None:
    with refused("sub-apertures"):
        parse_ranges(text)


@given(st.text(max_size=20))
def test_any_text_is_parsed_or_refused_in_one_line(text: str) -> None:
    for parse in (parse_ranges, lambda line: parse_changes([line])):
        said = ""
        try:
            parse(text)
        except InputError as error:
            said = str(error)
        assert len(said.splitlines()) <= 1


@pytest.mark.slow
def test_commands_that_only_ask_import_nothing_that_takes_time() -> None:
    modules = "faintspot.cli.realtime, faintspot.base.tables"
    code = f"import {modules}, sys; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numba", "scipy", "faintspot.slopes.pipeline.slope_pipeline"} & set(done.stdout.split())
