"""Content of a report of slopes: the methods of a run, and their comparison."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between
from faintspot.base.errors import InputError
from faintspot.base.report.texts import Texts
from faintspot.slopes.estimators.base import Step
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slopes import Stages
from faintspot.slopes.recorded.report.pictures import Followed
from faintspot.slopes.recorded.statistics import (
    Floats,
    Jitter,
    MeasuredSlopes,
    SlopesSummary,
    frame_to_frame_noise,
    jitter,
    median,
    relative_gain,
    summarise,
    valid_in_all,
)
from faintspot.slopes.sensor.layout import Layout

_TEXT = Texts("faintspot.slopes.recorded")
_KNOWN = 0.1  # standard error of a relative gain above which it counts as unknown
_DIFFERENT = 0.05  # difference of centroid gains that is worth a warning
_SURELY = 3.0  # standard errors


@dataclass(frozen=True)
class NoiseComparison:
    """Noise and centroid gain of the methods of a run, from the slopes alone."""

    methods: Sequence[MeasuredSlopes]
    noise_px: Sequence[Floats]
    """Noise of each sub-aperture from consecutive frames; NaN where there are none."""
    gains: Sequence[tuple[float, float]]
    """Centroid gain relative to the last method, and its standard error; NaN where it is not known."""

    @classmethod
    def of(cls, methods: Sequence[MeasuredSlopes], valid: Sequence[NDArray[np.bool_]]) -> NoiseComparison:
        """Measure the methods, each over its valid measurements; gains only where the frames are the same."""
        noise = [frame_to_frame_noise(method, used) for method, used in zip(methods, valid, strict=True)]
        last, unknown = methods[-1], (np.nan, np.nan)
        same = len(methods) > 1 and all(np.array_equal(method.number, last.number) for method in methods)
        gains = [relative_gain(method, last, valid[-1]) if same else unknown for method in methods]
        return cls(methods, noise, [gain if gain[1] < _KNOWN else unknown for gain in gains])

    def equal_noise(self, index: int) -> Floats:
        """Return the noise of a method at the gain of the last one, px."""
        equal: Floats = self.noise_px[index] / self.gains[index][0]
        return equal

    def warnings(self) -> list[str]:
        """Return a warning where the centroid gains of two methods differ."""
        pairs = list(zip(self.methods, self.gains, strict=True))[:-1]
        name = self.methods[-1].name
        return [
            _TEXT("numbers.different_gain", name=method.name, last=name, gain=gain, error=error)
            for method, (gain, error) in pairs
            if abs(gain - 1) > max(_DIFFERENT, _SURELY * error)
        ]

    def verdict(self) -> str:
        """Name the method with the least noise at equal gain, if the errors allow it."""
        levels = [median(self.equal_noise(index)) for index in range(len(self.methods))]
        if len(levels) < 2 or self.methods[0].n_frames < 2:
            return ""
        if not np.isfinite(levels).all():
            return str(_TEXT["numbers.unknown_gain"])
        best, second = np.argsort(levels)[:2]
        difference = self.equal_noise(second) - self.equal_noise(best)
        difference = difference[np.isfinite(difference)]
        size, error = float(difference.mean()), float(difference.std() / max(len(difference) - 1, 1) ** 0.5)
        for method, other in ((best, second), (second, best)):
            gain, gain_error = self.gains[method]
            error = float(np.hypot(error, levels[other] * gain_error / gain))
        names = {"best": self.methods[best].name, "second": self.methods[second].name}
        if len(difference) < 2 or size < _SURELY * error:
            return _TEXT("numbers.equal", **names)
        return _TEXT("numbers.least", **names, size=size, error=error)


@dataclass(frozen=True)
class SlopesRun:
    """Slopes of frames that were measured in one or several ways.

    Parameters
    ----------
    methods : sequence of MeasuredSlopes
        Others are compared with the last one; methods with frames of their own are each taken by themselves.
    layout : Layout or None
        None leaves the maps out, which the page says.
    stages : mapping of Stages
        `SlopePipeline.explain` of frame `example_frame`, by name. The first one's images are shown; the
        positions of all are marked, and must be measured without a reference.
    truth : array (n_frames, n_subapertures, 2), optional
        True x, y, px from each sub-aperture's centre.
    example_frame : int
    why_no_stages : str
        What the page says in place of the frame; "" leaves it out.
    steps : sequence of Step
        Which pictures of the frame are drawn.
    followed : Followed, optional
        Spots that were followed, which are shown in place of the stages.

    Raises
    ------
    InputError
        When the parts do not fit together.
    """

    methods: Sequence[MeasuredSlopes]
    layout: Layout | None
    stages: Mapping[str, Stages] = field(default_factory=dict)
    truth: ArrayLike | None = None
    example_frame: int = 0
    why_no_stages: str = "Not drawn: no frame was given."
    steps: Sequence[Step] = TotalVariation.steps_shown
    followed: Followed | None = None

    def __post_init__(self) -> None:
        names = [method.name for method in self.methods]
        if not names or len(set(names)) < len(names):
            raise InputError(f"methods: expected at least one, each with a name of its own, got {names}")
        n_frames, n = self.methods[0].x.shape
        parts = {f"slopes of {method.name!r}": method.n_subapertures for method in self.methods}
        parts |= {f"images of {name!r}": len(stages.raw) for name, stages in self.stages.items()}
        parts |= {} if self.layout is None else {"layout": len(self.layout)}
        for name, number in parts.items():
            if number != n:
                raise InputError(f"{name}: expected {n} sub-apertures, as in {names[0]!r}, got {number}")
        number_between("example_frame", self.example_frame, 0, n_frames - 1, integer=True)
        if self.truth is not None:
            truth = finite_array("truth", self.truth).astype(np.float64)
            if truth.shape != (n_frames, n, 2):
                raise InputError(f"truth: expected shape {(n_frames, n, 2)}, got {truth.shape}")
            object.__setattr__(self, "truth", truth)

    @property
    def has_several_frames(self) -> bool:
        """Whether it has more than one frame."""
        return self.methods[0].n_frames > 1

    @property
    def true_positions(self) -> Floats | None:
        """The truth, where it is known."""
        return None if self.truth is None else np.asarray(self.truth)

    @cached_property
    def valid(self) -> list[NDArray[np.bool_]]:
        """Compared measurements of each method: those valid in every method of the same frames."""
        first = self.methods[0]
        if all(np.array_equal(method.number, first.number) for method in self.methods):
            return [valid_in_all(self.methods)] * len(self.methods)
        return [method.valid for method in self.methods]

    @cached_property
    def summaries(self) -> list[SlopesSummary]:
        """Numbers of each method."""
        return [summarise(method) for method in self.methods]

    @cached_property
    def jitters(self) -> list[Jitter]:
        """Jitter of each method."""
        pairs = zip(self.methods, self.valid, strict=True)
        return [jitter(method.x, method.y, valid) for method, valid in pairs]

    @cached_property
    def comparison(self) -> NoiseComparison:
        """Noise and relative gains of the methods."""
        return NoiseComparison.of(self.methods, self.valid)
