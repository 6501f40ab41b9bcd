"""Few tests need pictures drawn, none in fine detail."""

import pytest


@pytest.fixture(autouse=True)
def _coarse(coarse_pictures: None) -> None: ...
