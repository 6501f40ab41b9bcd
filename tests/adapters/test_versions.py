"""Each adapter says once that a tool has another version than was tested."""

import importlib.metadata
import re
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.adapters import test_oopao
from tests.adapters.adapter_cases import EVERYTHING, needs

from faintspot import InputError
from faintspot.adapters import oopao, pyrtc
from faintspot.adapters.base import UntestedVersionWarning, check_version

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(params=["0.0.9", "99.0"])
def version(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    check_version.cache_clear()
    monkeypatch.setattr(importlib.metadata, "version", lambda name: request.param)
    yield request.param
    check_version.cache_clear()


def said_once(make: Callable[[], Any], tool: str, version: str, tested: str) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            make()
    said = [str(warning.message) for warning in caught if warning.category is UntestedVersionWarning]
    assert len(said) == 1
    assert re.match(f"{tool} {version}: .* tested with {tested}; compare", said[0])


def test_untested_oopao_version_warns_once(version: str) -> None:
    said_once(lambda: oopao.attach(test_oopao.StandIn(), EVERYTHING), "OOPAO", version, oopao.TESTED)


@pytest.mark.slow  # pyRTC starts a process when it is imported
@needs("pyrtc", "pyrtc")
def test_untested_pyrtc_version_warns_once(version: str) -> None:
    def make() -> None:
        pyrtc.slopes_process.cache_clear()
        pyrtc.camera.cache_clear()
        assert pyrtc.FaintspotSlopes
        assert pyrtc.FaintspotCamera

    said_once(make, "pyRTC", version, pyrtc.TESTED)
    pyrtc.slopes_process.cache_clear()
    pyrtc.camera.cache_clear()


@needs("hcipy", "loop")
def test_untested_hcipy_version_warns_once(version: str) -> None:
    from faintspot.adapters import hcipy

    def make() -> None:
        with pytest.raises(InputError):
            hcipy.SlopeEstimator(None, None, settings=EVERYTHING)

    said_once(make, "HCIPy", version, hcipy.TESTED)


@needs("specula", "specula")
def test_untested_specula_version_warns_once(version: str) -> None:
    import specula

    specula.init(-1, precision=1)
    from faintspot.adapters.specula.faintspot_slopec import TESTED, FaintspotSlopec

    def make() -> None:
        with pytest.raises(AttributeError):
            FaintspotSlopec(None)

    said_once(make, "SPECULA", version, TESTED)
