"""Fixtures for the tests of the commands."""

from pathlib import Path

import pytest
from tests.cli.cli_cases import CONFIGURATION


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return an empty working directory with a configuration."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "faintspot.toml").write_text(CONFIGURATION)
    return tmp_path


@pytest.fixture(autouse=True)
def _undrawn(undrawn_pictures: None) -> None:
    """Draw no pictures: figures have tests of their own."""


@pytest.fixture
def no_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw nothing, which takes most of a second, where the picture is not what is tested."""
    monkeypatch.setattr("faintspot.slopes.sensor.drawing.layout_picture", lambda *given, **named: None)
