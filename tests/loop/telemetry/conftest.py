"""Fixtures for the tests of telemetry."""

import pytest
from tests.cli.cli_cases import Commands


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Commands:
    return Commands(capsys)
