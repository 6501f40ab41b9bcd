"""Fixtures for the tests of `faintspot layout`."""

from typing import Any

import pytest

from faintspot import Settings


@pytest.fixture(autouse=True)
def _undrawn() -> None:
    """Draw the pictures of layouts, unlike those of other commands."""


@pytest.fixture
def no_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take the first of the settings that would be tried, which takes most of a second."""

    def first(trial: Any) -> tuple[Settings, float]:
        width = float(f"{trial.fwhm_px:.3g}")
        return Settings("weighted", weight_fwhm_px=width, spot_fwhm_px=width), 1.0

    monkeypatch.setattr("faintspot.slopes.recorded.first_settings._Trial.best", first)


@pytest.fixture
def only_found(no_picture: None, no_trials: None) -> None:
    """Find sub-apertures only: neither is a picture drawn nor are settings tried."""
