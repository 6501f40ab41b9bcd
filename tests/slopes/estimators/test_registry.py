"""Which estimators are known, and how others become known."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from typing import Any, ClassVar

import numpy as np
import pytest
from tests.refusals import refused
from tests.shared_data import ROOT

import faintspot as fs
from faintspot.slopes.estimators import Estimator, estimator_named, estimators, register, registry
from faintspot.slopes.estimators.built_in.gravity import BrightestPixels
from faintspot.slopes.estimators.registry import all_tables
from faintspot.slopes.pipeline.settings import SharedOptions

BUILT_IN = [
    "brightest",
    "tv",
    "smoothed",
    "centroid",
    "thresholded",
    "window",
    "weighted",
    "ml",
    "map",
]


@pytest.fixture(autouse=True)
def afterwards_as_before(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a test registers is forgotten, and packages are looked for again."""
    estimators()
    monkeypatch.setattr(registry, "_kinds", dict(registry._kinds))
    yield
    registry._load.cache_clear()


def middle(name: Any) -> type[Estimator]:
    """Return a new estimator that always says the window's middle."""

    @dataclass(frozen=True, eq=False, kw_only=True)
    class Middle(Estimator):
        label: ClassVar[str] = "middle"

        def locate(self, images: Any, sensor: Any, prior: Any) -> Any:
            return np.zeros((len(images), 2))

    Middle.name = name
    return Middle


def installed(monkeypatch: pytest.MonkeyPatch, *points: Any) -> None:
    """Make it look as if packages with these entry points were installed."""

    def found(group: str) -> list[Any]:
        assert group == "faintspot.estimators"
        return list(points)

    monkeypatch.setattr(registry, "entry_points", found)
    registry._load.cache_clear()


def test_built_in_ones_in_their_order() -> None:
    assert list(estimators())[: len(BUILT_IN)] == BUILT_IN
    for name, kind in estimators().items():
        assert kind.name == name
        assert estimator_named(name) is kind


@pytest.mark.slow
def test_order_does_not_depend_on_what_was_imported_first() -> None:
    code = (
        "from faintspot.slopes.estimators.built_in.weighted import Weighted; "
        "from faintspot.slopes.estimators import estimators; "
        "print(*estimators())"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split()[: len(BUILT_IN)] == BUILT_IN


def test_what_is_returned_is_a_copy() -> None:
    estimators().clear()
    assert list(estimators())[: len(BUILT_IN)] == BUILT_IN


@pytest.mark.parametrize("name", ["newton", "", 3, None, ["ml"]])
def test_unknown_estimator_is_refused(name: Any) -> None:
    with refused(f"estimator = {name!r}: expected one of 'brightest', 'tv', 'smoothed'"):
        estimator_named(name)


class TestRegister:
    def test_is_known_everywhere(self) -> None:
        kind = register(middle("middle"))
        assert list(estimators())[-1] == "middle"
        settings = fs.Settings("middle", search_range_px=2.0)
        assert isinstance(settings.estimator, kind)
        slopes = fs.measure_images(np.ones((3, 8, 8)), settings)
        assert np.array_equal(slopes.vector, np.zeros(6))

    def test_twice_the_same(self) -> None:
        """As when a module is loaded again."""
        register(middle("middle"))
        again = register(middle("middle"))
        assert estimator_named("middle") is again

    def test_another_one_of_that_name(self) -> None:
        with refused(
            "estimator 'tv': faintspot.slopes.estimators.built_in.total_variation has one",
            "of that name already",
        ):
            register(middle("tv"))
        assert estimator_named("tv").__name__ == "TotalVariation"

    @pytest.mark.parametrize("name", ["", "two words", "a-b", None, 3])
    def test_names_that_are_no_words(self, name: Any) -> None:
        with refused(f"estimator Middle: name = {name!r}: expected a word"):
            register(middle(name))

    def test_without_a_way_to_measure(self) -> None:
        @register
        @dataclass(frozen=True, eq=False, kw_only=True)
        class Empty(Estimator):
            name: ClassVar[str] = "empty"
            label: ClassVar[str] = "empty"

        with refused("estimator 'empty': expected a class with `locate` or `plan`, got neither"):
            fs.SlopePipeline(fs.Layout.grid((1, 2), pixels=8), fs.Settings("empty"))


class Point:
    """An entry point of an installed package."""

    def __init__(self, load: Any, package: str | None = "spots") -> None:
        self.name, self.load = "middle", load
        self.dist = None if package is None else type("Distribution", (), {"name": package})()


class TestInstalledPackages:
    def test_are_loaded_once(self, monkeypatch: pytest.MonkeyPatch) -> None:
        loads: list[str] = []

        def load() -> None:
            loads.append("middle")
            register(middle("middle"))

        installed(monkeypatch, Point(load))
        assert list(estimators())[-1] == "middle"
        assert fs.Settings("middle").estimator.label == "middle"
        assert loads == ["middle"]

    def test_a_real_entry_point(self, monkeypatch: pytest.MonkeyPatch) -> None:
        place = "faintspot.slopes.estimators.built_in.gravity:BrightestPixels"
        installed(monkeypatch, EntryPoint("brightest", place, registry.ENTRY_POINTS))
        assert estimators()["brightest"] is BrightestPixels

    @pytest.mark.parametrize("package", ["spots", None])
    @pytest.mark.parametrize(
        ("fault", "error"),
        [
            (RuntimeError("no such library\nand more"), "RuntimeError: no such library and more"),
            (SystemExit(0), "SystemExit: 0"),
            (KeyboardInterrupt(), "KeyboardInterrupt"),
        ],
    )
    def test_one_that_fails_is_said_in_one_line(
        self, monkeypatch: pytest.MonkeyPatch, package: str | None, fault: BaseException, error: str
    ) -> None:
        def load() -> None:
            raise fault

        installed(monkeypatch, Point(load, package))
        for _ in range(2):  # and not only the first time
            with refused(f"estimator 'middle' of the package {package or '?'}", error):
                fs.Settings("middle")
        assert fs.Settings("ml").estimator.name == "ml"

    def test_ctrl_c_while_one_is_imported_is_the_users(self, monkeypatch: pytest.MonkeyPatch) -> None:
        def load() -> None:
            try:
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(60)
            except KeyboardInterrupt:
                raise RuntimeError("half imported") from None

        installed(monkeypatch, Point(load))
        with pytest.raises(KeyboardInterrupt):
            fs.Settings("middle")

    def test_one_with_a_name_that_is_taken(self, monkeypatch: pytest.MonkeyPatch) -> None:
        installed(monkeypatch, Point(lambda: register(middle("ml"))))
        with refused("estimator 'middle' of the package spots", "has one of that name already"):
            fs.Settings("middle")


PAGE = ROOT / "docs" / "configuration.md"


def test_every_table_is_included() -> None:
    text = PAGE.read_text(encoding="utf-8")
    tables = {name for name, table in all_tables(SharedOptions).items() if "\n| `" in table} - {"estimators"}
    assert {name for name in tables if f"{{include}} reference/options/{name}.md" not in text} == set()
    assert "{include} reference/options/control.md" in text
