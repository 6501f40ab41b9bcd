"""Few tests need pictures drawn, none in fine detail."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def _coarse(coarse_pictures: None) -> None: ...
