"""Pictures of reports take most of the time; few tests need them drawn, none in fine detail."""

from __future__ import annotations

import pytest

from faintspot.report import drawing


@pytest.fixture(autouse=True)
def coarse_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "DOTS_PER_INCH", 20)


@pytest.fixture
def undrawn_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compose the figures but do not draw them."""
    monkeypatch.setattr(drawing, "png", lambda figure: b"")
