"""Each adapter says once that its tool has an untested version, and in one line that it is absent."""

import importlib
import importlib.metadata
import re
import sys
import warnings

import pytest
from tests.adapters import test_oopao
from tests.adapters.adapter_cases import EVERYTHING, needs

from faintspot import InputError, MissingExtraError
from faintspot.adapters import oopao, pyrtc
from faintspot.adapters.base import UntestedVersionWarning, check_version

pytestmark = pytest.mark.filterwarnings("ignore")


def use_oopao() -> str:
    oopao.attach(test_oopao.StandIn(), EVERYTHING)
    return oopao.TESTED


def use_pyrtc() -> str:
    pyrtc.slopes_process.cache_clear()
    pyrtc.camera.cache_clear()
    assert pyrtc.FaintspotSlopes
    assert pyrtc.FaintspotCamera
    return pyrtc.TESTED


def use_hcipy() -> str:
    from faintspot.adapters import hcipy

    with pytest.raises(InputError):
        hcipy.SlopeEstimator(None, None, settings=EVERYTHING)
    return hcipy.TESTED


def use_specula() -> str:
    import specula

    specula.init(-1, precision=1)
    from faintspot.adapters.specula.faintspot_slopec import TESTED, FaintspotSlopec

    with pytest.raises(AttributeError):
        FaintspotSlopec(None)
    return TESTED


SLOW = pytest.mark.slow  # pyRTC starts a process when it is imported


@pytest.mark.parametrize(
    "tool",
    [
        "OOPAO",
        pytest.param("pyRTC", marks=[SLOW, needs("pyrtc", "pyrtc")]),
        pytest.param("HCIPy", marks=needs("hcipy", "loop")),
        pytest.param("SPECULA", marks=needs("specula", "specula")),
    ],
)
def test_untested_version_warns_once(tool: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use = {"OOPAO": use_oopao, "pyRTC": use_pyrtc, "HCIPy": use_hcipy, "SPECULA": use_specula}[tool]
    check_version.cache_clear()
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "99.0")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tested = {use() for _ in range(2)}.pop()
    check_version.cache_clear()
    said = [str(warning.message) for warning in caught if warning.category is UntestedVersionWarning]
    assert len(said) == 1
    assert re.match(f"{tool} 99.0: .* tested with {tested}; compare", said[0])


@pytest.mark.parametrize(
    ("package", "extra", "module", "name"),
    [
        ("hcipy", "loop", "hcipy", "SlopeEstimator"),
        ("specula", "specula", "specula.faintspot_slopec", "FaintspotSlopec"),
        ("pyrtc", "pyrtc", "pyrtc", "FaintspotSlopes"),
        ("pyrtc", "pyrtc", "pyrtc", "FaintspotCamera"),
    ],
)
def test_missing_tool_is_said_in_one_line(
    package: str, extra: str, module: str, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"faintspot.adapters.{module}", raising=False)
    with pytest.raises(MissingExtraError, match=rf"faintspot\[{extra}\]"):
        getattr(importlib.import_module(f"faintspot.adapters.{module}"), name)
