"""The sections of a report page: what each table and picture is, and what to look for in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.page import Section, Table
from faintspot.base.report.texts import Texts
from faintspot.slopes.recorded.report import frame_pictures, maps
from faintspot.slopes.recorded.report.advice import FLAGS_OF_DENOISING, percentage
from faintspot.slopes.recorded.report.key_numbers import Comparison, key_numbers, number_text
from faintspot.slopes.recorded.statistics import (
    Floats,
    Jitter,
    MeasuredSlopes,
    SlopesSummary,
    jitter,
    median,
    rms,
    summarise,
    valid_in_all,
)
from faintspot.slopes.sensor.layout import Layout

if TYPE_CHECKING:
    from faintspot.slopes.estimators.base import Step
    from faintspot.slopes.pipeline.slopes import Stages

_TEXT = Texts("faintspot.slopes.recorded")
NO_LAYOUT = "Not drawn: the layout of the sub-apertures is not known."


@dataclass(frozen=True)
class ReportInputs:
    """Everything that the sections are made of; see `make_run`."""

    methods: Sequence[MeasuredSlopes]
    layout: Layout | None
    stages: Mapping[str, Stages]
    truth: Floats | None
    example_frame: int
    why_no_stages: str
    steps: Sequence[Step]
    summaries: Sequence[SlopesSummary]
    jitters: Sequence[Jitter]
    valid: Sequence[NDArray[np.bool_]]
    """Mask of the compared measurements of each method: those valid in every method of the same frames."""
    comparison: Comparison


def make_run(
    methods: Sequence[MeasuredSlopes],
    layout: Layout | None,
    stages: Mapping[str, Stages],
    truth: Floats | None,
    example_frame: int,
    why_no_stages: str,
    steps: Sequence[Step],
) -> ReportInputs:
    """Compute the numbers of a run; methods with frames of their own are each taken by themselves."""
    same = all(np.array_equal(method.number, methods[0].number) for method in methods)
    valid = [valid_in_all(methods)] * len(methods) if same else [method.valid for method in methods]
    return ReportInputs(
        methods,
        layout,
        stages,
        truth,
        example_frame,
        why_no_stages,
        steps,
        [summarise(method) for method in methods],
        [jitter(method.x, method.y, used) for method, used in zip(methods, valid, strict=True)],
        valid,
        Comparison.of(methods, valid),
    )


def all_sections(run: ReportInputs) -> list[Section]:
    """Return the sections in the order of the page."""
    makers: list[Callable[[ReportInputs], Section]] = [_key_numbers, _flux, _slopes]
    if run.stages or run.why_no_stages:
        makers.insert(1, _frame)
    if any(method.is_denoised for method in run.methods):
        makers.append(_iterations)
    if run.methods[0].n_frames > 1:
        makers.append(_jitter)
    return [make(run) for make in makers]


def _key_numbers(run: ReportInputs) -> Section:
    scale = None if run.layout is None else run.layout.pixel_scale_arcsec
    return key_numbers(run.comparison, run.summaries, run.jitters, run.valid[-1], run.truth, scale)


def _frame(run: ReportInputs) -> Section:
    title = "One frame, step by step"
    if run.layout is None:
        return Section("frame", title, missing=NO_LAYOUT)
    if not run.stages:
        return Section("frame", title, missing=run.why_no_stages)
    truth = None if run.truth is None else run.truth[run.example_frame]
    example = frame_pictures.Example(run.layout, run.stages, truth, run.steps)
    shown = next(iter(run.stages))
    circles = " and circles true ones" if truth is not None else ""
    marks = _TEXT("sensor.marked", shown=shown, circles=circles)
    if len(run.layout) > frame_pictures.MOST_MARKED:
        marks = _TEXT("sensor.unmarked", shown=shown)
    factor, several = frame_pictures.coarseness(run.layout), len(example.shown_steps) > 2
    values = {
        "frame": run.example_frame,
        "scale": _scale_in_words(example),
        "marks": marks,
        "coarse": _TEXT("sensor.coarse", factor=factor) if factor > 1 else "",
        "left_over": _TEXT["sensor.left_over"] if several else "",
    }
    noise = "whether the noise goes and the spot stays, and " if several else ""
    figures = [
        _TEXT.figure("sensor", frame_pictures.whole_sensor(example), **values),
        _TEXT.figure("subapertures", frame_pictures.zoom(example), noise=noise),
    ]
    return Section("frame", title, figures=figures)


def _scale_in_words(example: frame_pictures.Example) -> str:
    number = len(example.shown_steps)
    if example.raw_is_calibrated:
        return "The frames are in electrons already." + (
            " All pictures share one colour scale." if number > 1 else ""
        )
    if number == 2:
        return "Raw is in ADU, calibrated in electrons; each has its own scale."
    return str(_TEXT["sensor.one_scale"])


def _flux(run: ReportInputs) -> Section:
    header = ["flag", *(method.name for method in run.methods), "meaning"]
    rows = []
    denoised = any(method.is_denoised for method in run.methods)
    for name, meaning in _TEXT["flags"].items():
        flag = SubapertureFlag[name]
        counts = [method.flag_count(flag) for method in run.methods]
        if flag in FLAGS_OF_DENOISING and not denoised and not any(counts):
            continue
        cells = [
            f"{n} ({percentage(n / method.flags.size)})"
            for n, method in zip(counts, run.methods, strict=True)
        ]
        rows.append([name, *cells, meaning])
    table = Table(header, rows, _TEXT["flux.table"], words=True)
    if run.layout is None:
        return Section("flux", "Flux and validity", tables=[table], missing=NO_LAYOUT)
    several = run.methods[0].n_frames > 1
    maps_shown = "Left: median flux. Right: in how many frames the slope was valid." if several else "Flux."
    figure = maps.flux_and_validity(run.methods, run.summaries, run.layout)
    shown = _TEXT.figure("flux", figure, maps=maps_shown)
    return Section("flux", "Flux and validity", tables=[table], figures=[shown])


def _slopes(run: ReportInputs) -> Section:
    if run.layout is None:
        return Section("slopes", "Mean slopes", missing=NO_LAYOUT)
    tilts = "; ".join(
        f"{method.name}: x {number_text(_mean(summary.x_px), '', 3)}, "
        f"y {number_text(_mean(summary.y_px), 'px', 3)}"
        for method, summary in zip(run.methods, run.summaries, strict=True)
    )
    noise = ""
    if run.jitters[0].measured.any():
        errors = "; ".join(
            f"{method.name}: {number_text(median(item.px / np.sqrt(np.maximum(item.n_frames, 1))), 'px', 2)}"
            for method, item in zip(run.methods, run.jitters, strict=True)
        )
        noise = _TEXT("slopes.noise", errors=errors)
    subject = (
        "Mean slope of each sub-aperture over its valid frames" if run.methods[0].n_frames > 1 else "Slopes"
    )
    longest, number = maps.longest_arrow(run.summaries)
    cut = ""
    if number:
        long = number_text(longest, "px", 2)
        cut = _TEXT("slopes.cut", longest=long, percent=maps.ARROWS_WHOLE_PERCENT, number=number)
    figure = maps.slope_arrows(run.methods, run.summaries, run.layout)
    shown = _TEXT.figure("slopes", figure, what=subject, cut=cut, tilts=tilts, noise=noise)
    return Section("slopes", "Mean slopes", figures=[shown])


def _iterations(run: ReportInputs) -> Section:
    denoised = [
        (method, summary)
        for method, summary in zip(run.methods, run.summaries, strict=True)
        if method.is_denoised
    ]
    if run.layout is None:
        return Section("iterations", "Iterations", missing=NO_LAYOUT)
    if not any(method.valid.any() for method, _ in denoised):
        return Section("iterations", "Iterations", missing="Not drawn: no measurement is valid.")
    medians = "; ".join(f"{method.name}: {number.median_iterations:.0f}" for method, number in denoised)
    methods, summaries = zip(*denoised, strict=True)
    figure = maps.iteration_counts(methods, summaries, run.layout)
    shown = _TEXT.figure("iterations", figure, medians=medians)
    return Section("iterations", "Iterations", figures=[shown])


def _jitter(run: ReportInputs) -> Section:
    title = "Slope jitter"
    if not run.jitters[0].measured.any():
        return Section("jitter", title, missing="No sub-aperture is valid in two frames, as jitter needs.")
    text = [_TEXT["jitter.text"]]
    if run.truth is not None:
        moved = jitter(run.truth[..., 0], run.truth[..., 1], run.valid[-1])
        text.append(f"The true motion in these frames is {rms(moved.px):.3f} px rms.")
    shown = [_TEXT.figure("jitter", maps.jitter_plot(run.methods, run.jitters))]
    if run.layout is not None:
        figure = maps.jitter_maps(run.methods, run.jitters, run.layout)
        shown.insert(0, _TEXT.figure("jitter-map", figure))
    return Section("jitter", title, text=text, figures=shown)


def _mean(values: Floats) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else np.nan
