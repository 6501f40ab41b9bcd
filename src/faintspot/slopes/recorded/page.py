"""Report page of a slopes run: its methods, their comparison, and what each table and picture is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between
from faintspot.base.errors import InputError
from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.page import POSITIONS, Part, Report, Section, Table, configuration_section
from faintspot.base.report.texts import Texts, percentage
from faintspot.base.statistics import Estimate
from faintspot.slopes.estimators.base import Step
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slopes import Stages
from faintspot.slopes.recorded import pictures, statistics
from faintspot.slopes.recorded.pictures import Followed
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront import certify, fit_wavefront
from faintspot.slopes.wavefront.figure import wavefront_figure
from faintspot.slopes.wavefront.files import certificate_table, remarks

_TEXT = Texts("faintspot.slopes.recorded")
_KNOWN = 0.1  # standard error of a relative gain above which it counts as unknown
_DIFFERENT = 0.05  # difference of centroid gains that is worth a warning
_SURELY = 3.0  # standard errors


@dataclass(frozen=True)
class NoiseComparison:
    """Noise and centroid gain of the methods of a run, from the slopes alone."""

    methods: Sequence[statistics.MeasuredSlopes]
    noise_px: Sequence[statistics.Floats]
    """Noise of each sub-aperture from consecutive frames; NaN where there are none."""
    gains: Sequence[tuple[float, float]]
    """Centroid gain relative to the last method, and its standard error; NaN where it is not known."""

    @classmethod
    def of(
        cls, methods: Sequence[statistics.MeasuredSlopes], valid: Sequence[NDArray[np.bool_]]
    ) -> NoiseComparison:
        """Measure the methods, each over its valid measurements; gains only where the frames are the same."""
        noise = [
            statistics.frame_to_frame_noise(method, used) for method, used in zip(methods, valid, strict=True)
        ]
        last, unknown = methods[-1], (np.nan, np.nan)
        same = len(methods) > 1 and all(np.array_equal(method.number, last.number) for method in methods)
        gains = [statistics.relative_gain(method, last, valid[-1]) if same else unknown for method in methods]
        return cls(methods, noise, [gain if gain[1] < _KNOWN else unknown for gain in gains])

    def equal_noise(self, index: int) -> statistics.Floats:
        """Return the noise of a method at the gain of the last one, px."""
        equal: statistics.Floats = self.noise_px[index] / self.gains[index][0]
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
        levels = [statistics.median(self.equal_noise(index)) for index in range(len(self.methods))]
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

    methods: Sequence[statistics.MeasuredSlopes]
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
    def true_positions(self) -> statistics.Floats | None:
        """The truth, where it is known."""
        return None if self.truth is None else np.asarray(self.truth)

    @cached_property
    def valid(self) -> list[NDArray[np.bool_]]:
        """Compared measurements of each method: those valid in every method of the same frames."""
        first = self.methods[0]
        if all(np.array_equal(method.number, first.number) for method in self.methods):
            return [statistics.valid_in_all(self.methods)] * len(self.methods)
        return [method.valid for method in self.methods]

    @cached_property
    def summaries(self) -> list[statistics.SlopesSummary]:
        """Numbers of each method."""
        return [statistics.summarise(method) for method in self.methods]

    @cached_property
    def jitters(self) -> list[statistics.Jitter]:
        """Jitter of each method."""
        pairs = zip(self.methods, self.valid, strict=True)
        return [statistics.jitter(method.x, method.y, valid) for method, valid in pairs]

    @cached_property
    def comparison(self) -> NoiseComparison:
        """Noise and relative gains of the methods."""
        return NoiseComparison.of(self.methods, self.valid)


_MOST_LISTED = 20
_NO_LAYOUT = "Not drawn: the layout of the sub-apertures is not known."


def slopes_report(
    run: SlopesRun,
    *,
    title: str,
    facts: Mapping[str, str],
    configurations: Mapping[str, str],
    warnings: Sequence[str] = (),
    sections: Sequence[Section] = (),
) -> Report:
    """Return the report of a slopes run.

    Parameters
    ----------
    run : SlopesRun
    title : str
    facts : mapping of str
        What was run, for the top of the page, as sources and settings in words.
    configurations : mapping of str
        TOML text by the name of what it is of; "" when not known.
    warnings : sequence of str
        Shown before those found in the slopes.
    sections : sequence of Section
        Further sections, before the configurations.
    """
    n_frames, n = run.methods[0].x.shape
    return Report(
        title=title,
        facts={**facts, "Frames": str(n_frames), "Sub-apertures": _sensor_in_words(n, run.layout)},
        sections=[
            *slopes_sections(run),
            *sections,
            *(configuration_section(text, name) for name, text in configurations.items()),
        ],
        warnings=[*warnings, *run.comparison.warnings(), *warnings_in_words(run)],
        remark=POSITIONS,
    )


def _sensor_in_words(n: int, layout: Layout | None) -> str:
    if layout is None:
        return str(n)
    pitch = "" if layout.pitch_px is None else f", pitch {layout.pitch_px:.2f} px"
    (window_height, window_width), (height, width) = layout.window, layout.frame_shape
    size = f"{window_height} × {window_width} px"
    return f"{n} of {size}, {layout.geometry}{pitch}, in frames of {height} × {width} px"


def slopes_sections(run: SlopesRun) -> list[Section]:
    """Return the sections in the order of the page."""
    return [_key_numbers(run), *_frame(run), _flux(run), _slopes(run), *_wavefront(run)]


def warnings_in_words(run: SlopesRun) -> list[str]:
    """Return what is wrong with a run and what to do next, a sentence or two each."""
    lines = []
    for method, summary in zip(run.methods, run.summaries, strict=True):
        prefix = f"{method.name}: " if len(run.methods) > 1 else ""
        lines += [prefix + line for line in _of_method(method, summary)]
    if not run.has_several_frames:
        lines.append(_TEXT["warnings.one_frame"])
    if np.ptp([summary.valid_fraction for summary in run.summaries]) > 0.01:
        lines.append(_TEXT["warnings.not_alike"])
    return lines


def _of_method(method: statistics.MeasuredSlopes, summary: statistics.SlopesSummary) -> list[str]:
    lines = [] if summary.valid_fraction else [_TEXT["warnings.none_valid"]]
    for flag, (most, advice) in _TEXT["advice"].items():
        fraction = method.flag_count(SubapertureFlag[flag]) / method.x.size
        if fraction > most:
            lines.append(f"{percentage(fraction)} of the measurements {advice}")
    never = np.flatnonzero(summary.valid_frames == 0)
    if 0 < len(never) < method.n_subapertures:
        listed = ", ".join(str(number) for number in never[:_MOST_LISTED])
        more = f" and {len(never) - _MOST_LISTED} more" if len(never) > _MOST_LISTED else ""
        counts = {"count": len(never), "all": method.n_subapertures, "listed": listed + more}
        lines.append(_TEXT("warnings.never_valid", **counts))
    return lines


def _key_numbers(run: SlopesRun) -> Section:
    """Return the table of all methods: errors where the truth is known, noise, and the rest."""
    methods, last, truth = run.methods, run.methods[-1], run.true_positions
    n_frames, n = methods[0].x.shape
    alike = all(method.n_frames == n_frames for method in methods)
    table = _TEXT.table(
        "numbers",
        [_record(run, index) for index in range(len(methods))],
        last=last.name,
        counted=f": {n_frames} × {n} = {n_frames * n}" if alike else "",
        together=alike and len(methods) > 1,
    )
    if truth is None:
        return _TEXT.section("numbers", run.comparison.verdict(), table)
    shared = "valid" if len(methods) == 1 else "valid in every method"
    values = {"low": truth.min(), "high": truth.max(), "count": np.count_nonzero(run.valid[-1])}
    return _TEXT.section("numbers", _TEXT("numbers.truth", values, shared=shared), table)


def _record(run: SlopesRun, index: int) -> dict[str, object]:
    """Return the numbers of a method; None where they say nothing."""
    method, comparison, truth = run.methods[index], run.comparison, run.true_positions
    noise, relative = statistics.median(comparison.noise_px[index]), Estimate(*comparison.gains[index])
    error = gain = None
    if truth is not None:
        error, gain = statistics.slope_error(method, truth, run.valid[-1])
    ranked = truth is None and bool(np.isfinite([gain for gain, _ in comparison.gains[:-1]]).any())
    is_last = relative.standard_error == 0
    scale = None if run.layout is None else run.layout.pixel_scale_arcsec
    return {
        "method": method.name,
        "error": error,
        "gain": gain,
        "noise": noise,
        "noise_arcsec": None if scale is None else noise * scale,
        "is_last": ranked and is_last,
        "relative_gain": relative if ranked and not is_last else None,
        "noise_at_equal_gain": statistics.median(comparison.equal_noise(index)) if ranked else None,
        "stated_error": method.standard_error_px,
        "jitter": statistics.median(run.jitters[index].px),
        "summary": run.summaries[index],
    }


def _frame(run: SlopesRun) -> list[Section]:
    if run.followed is not None and run.layout is not None:
        figure = pictures.followed_figure(run.followed, run.layout)
        return [_TEXT.section("followed", figure, largest=run.followed.largest_pitches(run.layout))]
    if not run.stages and not run.why_no_stages:
        return []
    if run.layout is None or not run.stages:
        return [_TEXT.section("frame", missing=_NO_LAYOUT if run.layout is None else run.why_no_stages)]
    truth = None if run.true_positions is None else run.true_positions[run.example_frame]
    example = pictures.Example(run.layout, run.stages, truth, run.steps)
    figures = pictures.sensor_figure(example, run.example_frame), pictures.steps_figure(example)
    return [_TEXT.section("frame", *figures)]


def _flux(run: SlopesRun) -> Section:
    rows = []
    for name, meaning in _TEXT["flags"].items():
        counts = [method.flag_count(SubapertureFlag[name]) for method in run.methods]
        if any(counts):
            pairs = zip(counts, run.methods, strict=True)
            cells = [f"{count} ({percentage(count / method.flags.size)})" for count, method in pairs]
            rows.append([name, *cells, meaning])
    table = _TEXT.table("flux.flags", rows, [*(method.name for method in run.methods), "meaning"])
    if run.layout is None:
        return _TEXT.section("flux", table, missing=_NO_LAYOUT)
    return _TEXT.section(
        "flux", table, pictures.maps_figure(run.methods, run.summaries, run.jitters, run.layout)
    )


def _slopes(run: SlopesRun) -> Section:
    if run.layout is None:
        return _TEXT.section("slopes", missing=_NO_LAYOUT)
    return _TEXT.section("slopes", pictures.arrows_figure(run.methods, run.summaries, run.layout))


def _wavefront(run: SlopesRun) -> list[Section]:
    """Return the section with the wavefronts fitted to the slopes of each method; none without a layout."""
    known = [(method.name, method.slopes) for method in run.methods if method.slopes is not None]
    if run.layout is None or not known:
        return []
    parts: list[Part] = []
    text, missing = [_TEXT["wavefront.about"]], []
    for number, (name, slopes) in enumerate(known):
        try:
            wavefront = fit_wavefront(slopes, run.layout)
        except InputError as error:
            missing.append(f"Wavefront of {name!r}: {error}.")
            continue
        text += [line for line in remarks(wavefront) if line not in text]
        figure = wavefront_figure(wavefront, run.layout, name, file=f"wavefront-{number + 1}")
        parts += [Table(*certificate_table(certify(wavefront), wavefront.unit), name), figure]
    return [Section("wavefront", "Wavefront", [*text, *parts], " ".join(missing))]
