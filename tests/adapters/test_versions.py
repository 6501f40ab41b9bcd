"""Each adapter says in one line that its tool is absent."""

import importlib
import importlib.metadata
import sys

import pytest

from faintspot import MissingExtraError

pytestmark = pytest.mark.filterwarnings("ignore")


def test_missing_tool_is_said_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for package, extra, module, name in (
        ("hcipy", "loop", "hcipy", "SlopeEstimator"),
        ("specula", "specula", "specula.faintspot_slopec", "FaintspotSlopec"),
        ("pyrtc", "pyrtc", "pyrtc", "FaintspotSlopes"),
        ("pyrtc", "pyrtc", "pyrtc", "FaintspotCamera"),
    ):
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"faintspot.adapters.{module}", raising=False)
        with pytest.raises(MissingExtraError, match=rf"faintspot\[{extra}\]"):
            getattr(importlib.import_module(f"faintspot.adapters.{module}"), name)
