"""A small simulated sensor measured in two ways, and a reader of pages, for the tests of reports."""

from dataclasses import dataclass, field
from html.parser import HTMLParser
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.page import Report
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.pipeline.slopes import Slopes, Stages
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.simulate import sensor_frames

SETTINGS = Settings(noise_std=0.3, keep_brightest=10)
VOID = {"meta", "img", "br", "hr", "link", "input"}


def sensor(shape: tuple[int, int] = (3, 3)) -> Layout:
    return Layout.grid(shape, pixels=8)


def simulated(layout: Layout, n_frames: int) -> tuple[NDArray[Any], NDArray[np.float64]]:
    rng = np.random.default_rng(4)
    return sensor_frames(layout, n_frames, rng=rng)


def two_methods(layout: Layout, frames: NDArray[Any]) -> tuple[list[MeasuredSlopes], dict[str, Stages]]:
    methods, stages = [], {}
    for name, settings in (("TV", SETTINGS), ("no TV", SETTINGS.replace(estimator="brightest"))):
        pipeline = SlopePipeline(layout, settings)
        methods.append(MeasuredSlopes(name, pipeline(frames)))
        stages[name] = pipeline.explain(frames[0])
    return methods, stages


def method_of(
    name: str, x: Any, y: Any, flux: Any = 1.0, flags: Any = 0, error_px: float = np.inf
) -> MeasuredSlopes:
    """Return slopes (n_frames, n_subapertures) with these values."""
    zero = np.zeros(np.shape(x))
    counts, errors = np.zeros(zero.shape, np.int32), np.full(zero.shape, error_px, np.float32)
    flags = np.zeros(zero.shape, np.uint8) + np.asarray(flags, np.uint8)
    arrays: Any = (x, y, zero + flux, flags, counts, counts, errors, errors, zero)
    return MeasuredSlopes(name, Slopes(*arrays))


@dataclass
class Page(HTMLParser):
    """What is in a page; fails where a tag is not closed or closed twice."""

    report: Report | str
    tags: list[tuple[str, dict[str, str | None]]] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    opened: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.html = self.report if isinstance(self.report, str) else self.report.html()
        self.feed(self.html)
        self.close()
        assert self.opened == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.opened.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.opened
        assert self.opened.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    @property
    def ids(self) -> list[str]:
        """Names of the sections."""
        return [value for tag, found in self.tags if tag == "section" and (value := found.get("id"))]

    def values(self, attribute: str) -> list[str]:
        return [value for _, found in self.tags if (value := found.get(attribute)) is not None]
