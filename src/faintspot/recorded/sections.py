"""The sections of a report page: what each table and picture is, and what to look for in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.recorded import frame_pictures, maps
from faintspot.recorded.advice import FLAG_MEANINGS, FLAGS_OF_DENOISING, percentage
from faintspot.recorded.key_numbers import Comparison, key_numbers, number_text
from faintspot.recorded.statistics import (
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
from faintspot.report.figure_data import FigureWithData
from faintspot.report.page import Section, Table
from faintspot.sensor.layout import Layout

if TYPE_CHECKING:
    from faintspot.estimators.base import Step
    from faintspot.pipeline.slopes import Stages

NO_LAYOUT = "Not drawn: the layout of the sub-apertures is not known."


@dataclass(frozen=True)
class ReportInputs:
    """Everything that the sections are made of; see `make_run`."""

    arms: Sequence[MeasuredSlopes]
    layout: Layout | None
    stages: Mapping[str, Stages]
    truth: Floats | None
    example_frame: int
    why_no_stages: str
    steps: Sequence[Step]
    summaries: Sequence[SlopesSummary]
    jitters: Sequence[Jitter]
    valid: Sequence[NDArray[np.bool_]]
    """Which measurements of each arm are compared: those that are valid in every arm of the same frames."""
    comparison: Comparison


def make_run(
    arms: Sequence[MeasuredSlopes],
    layout: Layout | None,
    stages: Mapping[str, Stages],
    truth: Floats | None,
    example_frame: int,
    why_no_stages: str,
    steps: Sequence[Step],
) -> ReportInputs:
    """Compute the numbers of a run; arms with frames of their own are each taken by themselves."""
    same = all(np.array_equal(arm.number, arms[0].number) for arm in arms)
    valid = [valid_in_all(arms)] * len(arms) if same else [arm.valid for arm in arms]
    return ReportInputs(
        arms,
        layout,
        stages,
        truth,
        example_frame,
        why_no_stages,
        steps,
        [summarise(arm) for arm in arms],
        [jitter(arm.x, arm.y, used) for arm, used in zip(arms, valid, strict=True)],
        valid,
        Comparison.of(arms, valid),
    )


def all_sections(run: ReportInputs) -> list[Section]:
    """Return the sections in the order of the page."""
    makers: list[Callable[[ReportInputs], Section]] = [
        _key_numbers,
        _flux,
        _slopes,
    ]
    if run.stages or run.why_no_stages:
        makers.insert(1, _frame)
    if any(arm.is_denoised for arm in run.arms):
        makers.append(_iterations)
    if run.arms[0].n_frames > 1:
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
    marks = f"Images are those of {shown!r}. On the last one, crosses are measured positions{circles}. "
    if len(run.layout) > frame_pictures.MOST_MARKED:
        marks = f"Images are those of {shown!r}; positions are not marked in so many sub-apertures. "
    factor = frame_pictures.coarseness(run.layout)
    coarse = (
        f"Each pixel of the picture is the brightest of {factor} × {factor} of the frame. "
        if factor > 1
        else ""
    )
    left_over = ", and for anything left over after the background" if len(example.shown_steps) > 2 else ""
    whole = (
        f"Frame {run.example_frame} with all windows at their places. {_scale_in_words(example)} {marks}"
        f"{coarse}Look for spots that leave their window and for windows without a spot{left_over}."
    )
    noise = "whether the noise goes and the spot stays, and " if len(example.shown_steps) > 2 else ""
    zoomed = (
        "The faintest, a median and the brightest valid sub-aperture of this frame, each row on a scale of "
        f"its own. Look {noise}whether the crosses sit on the spot."
    )
    return Section(
        "frame",
        title,
        figures=[
            FigureWithData(
                "sensor", "The sensor after every step", whole, frame_pictures.whole_sensor(example)
            ),
            FigureWithData(
                "subapertures", "Three sub-apertures after every step", zoomed, frame_pictures.zoom(example)
            ),
        ],
    )


def _scale_in_words(example: frame_pictures.Example) -> str:
    number = len(example.shown_steps)
    if example.raw_is_calibrated:
        return "The frames are in electrons already." + (
            " All pictures share one colour scale." if number > 1 else ""
        )
    if number == 2:
        return "Raw is in ADU, calibrated in electrons; each has its own scale."
    return "Raw is in ADU and has a scale of its own; the others share one scale in electrons."


def _flux(run: ReportInputs) -> Section:
    header = ["flag", *(arm.name for arm in run.arms), "meaning"]
    rows = []
    denoised = any(arm.is_denoised for arm in run.arms)
    for flag, meaning in FLAG_MEANINGS.items():
        counts = [arm.flag_count(flag) for arm in run.arms]
        if flag in FLAGS_OF_DENOISING and not denoised and not any(counts):
            continue
        cells = [f"{n} ({percentage(n / arm.flags.size)})" for n, arm in zip(counts, run.arms, strict=True)]
        rows.append([str(flag.name), *cells, meaning])
    table = Table(
        header,
        rows,
        "Measurements with each flag; one may have several. Only those that say so are invalid.",
        words=True,
    )
    if run.layout is None:
        return Section("flux", "Flux and validity", tables=[table], missing=NO_LAYOUT)
    several = run.arms[0].n_frames > 1
    maps_shown = "Left: median flux. Right: in how many frames the slope was valid." if several else "Flux."
    caption = (
        f"{maps_shown} Flux is what the estimator finds: without the background, where one is subtracted. An "
        "empty outline was never valid. Look for a smooth pupil: single dim sub-apertures are vignetted or "
        "off their spot, and a bright edge on one side means that the windows are shifted."
    )
    figure = maps.flux_and_validity(run.arms, run.summaries, run.layout)
    shown = FigureWithData("flux", "Maps of flux and validity", caption, figure)
    return Section("flux", "Flux and validity", tables=[table], figures=[shown])


def _slopes(run: ReportInputs) -> Section:
    if run.layout is None:
        return Section("slopes", "Mean slopes", missing=NO_LAYOUT)
    tilts = "; ".join(
        f"{arm.name}: x {number_text(_mean(summary.x_px), '', 3)}, "
        f"y {number_text(_mean(summary.y_px), 'px', 3)}"
        for arm, summary in zip(run.arms, run.summaries, strict=True)
    )
    noise = ""
    if run.jitters[0].measured.any():
        errors = "; ".join(
            f"{arm.name}: {number_text(median(item.px / np.sqrt(np.maximum(item.n_frames, 1))), 'px', 2)}"
            for arm, item in zip(run.arms, run.jitters, strict=True)
        )
        noise = (
            f" Arrows not longer than the standard error of a mean slope per axis (median {errors}, if "
            "frames are independent) are noise."
        )
    what = "Mean slope of each sub-aperture over its valid frames" if run.arms[0].n_frames > 1 else "Slopes"
    longest, number = maps.longest_arrow(run.summaries)
    cut = ""
    if number:
        cut = (
            f" Arrows longer than {number_text(longest, 'px', 2)} (1.5 times the "
            f"{maps.ARROWS_WHOLE_PERCENT}th percentile) are drawn black, at that length: {number}."
        )
    caption = (
        f"{what}, all panels at one scale (key below each).{cut} Sub-apertures without an arrow but a grey "
        "cross were never valid. All arrows alike are tilt or a shifted layout, arrows to or from the middle "
        f"are focus. Mean over the sensor: {tilts}.{noise}"
    )
    figure = maps.slope_arrows(run.arms, run.summaries, run.layout)
    shown = FigureWithData("slopes", "Mean slopes as arrows", caption, figure)
    return Section("slopes", "Mean slopes", figures=[shown])


def _iterations(run: ReportInputs) -> Section:
    denoised = [
        (arm, summary) for arm, summary in zip(run.arms, run.summaries, strict=True) if arm.is_denoised
    ]
    if run.layout is None:
        return Section("iterations", "Iterations", missing=NO_LAYOUT)
    if not any(arm.valid.any() for arm, _ in denoised):
        return Section("iterations", "Iterations", missing="Not drawn: no measurement is valid.")
    medians = "; ".join(f"{arm.name}: {number.median_iterations:.0f}" for arm, number in denoised)
    caption = (
        f"Median iterations: {medians}. Left: mean iterations of the denoiser. Right: how often each "
        "number occurred, over valid measurements. A pile at the right end is the iteration "
        "limit; faint sub-apertures take longest."
    )
    arms, summaries = zip(*denoised, strict=True)
    figure = maps.iteration_counts(arms, summaries, run.layout)
    shown = FigureWithData("iterations", "Iterations", caption, figure)
    return Section("iterations", "Iterations", figures=[shown])


def _jitter(run: ReportInputs) -> Section:
    title = "Slope jitter"
    if not run.jitters[0].measured.any():
        return Section("jitter", title, missing="No sub-aperture is valid in two frames, as jitter needs.")
    text = [
        "Jitter includes the real motion of the spots (atmosphere, vibration, guiding), so it is an upper "
        "bound of the noise. Less jitter is not better by itself: an estimator whose centroid gain is below "
        "1 shrinks noise and motion alike."
    ]
    if run.truth is not None:
        moved = jitter(run.truth[..., 0], run.truth[..., 1], run.valid[-1])
        text.append(f"The true motion in these frames is {rms(moved.px):.3f} px rms.")
    caption = (
        "Dots: standard deviation over the frames. Line: the same from the median absolute deviation, which "
        "rare outliers do not touch: dots far above their line are outliers, not noise. Of many "
        "sub-apertures the line is a running median. Dotted: medians."
    )
    plot = maps.jitter_plot(run.arms, run.jitters)
    shown = [FigureWithData("jitter", "Jitter of the sub-apertures", caption, plot)]
    if run.layout is not None:
        where = (
            "Where the jitter is: rms of x and y over the frames, all maps on one scale. Look for the "
            "pupil's edge and for single sub-apertures that stand out (bad pixels, a neighbour's light)."
        )
        figure = maps.jitter_maps(run.arms, run.jitters, run.layout)
        shown.insert(0, FigureWithData("jitter-map", "Maps of the jitter", where, figure))
    return Section("jitter", title, text=text, figures=shown)


def _mean(values: Floats) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else np.nan
