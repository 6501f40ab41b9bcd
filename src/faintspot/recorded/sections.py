"""The sections of a report page: what each table and picture is, and what to look for in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from faintspot.flags import SubapertureFlag
from faintspot.recorded import frame_pictures, maps
from faintspot.recorded.advice import FLAG_MEANINGS, FLAGS_OF_DENOISING, percentage
from faintspot.recorded.statistics import (
    Floats,
    Jitter,
    MeasuredSlopes,
    SlopesSummary,
    error_ratio,
    flux_gain,
    jitter,
    median,
    rms,
    slope_error,
    summarise,
    valid_in_all,
)
from faintspot.report.figure_data import FigureWithData
from faintspot.report.page import Section, Table
from faintspot.sensor.layout import Layout

if TYPE_CHECKING:
    from faintspot.estimators.base import Step
    from faintspot.slopes import Stages

NO_LAYOUT = "Not drawn: the layout of the sub-apertures is not known."


@dataclass(frozen=True)
class Run:
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
    valid: NDArray[np.bool_]
    """Measurements that are valid in every arm."""


def make_run(
    arms: Sequence[MeasuredSlopes],
    layout: Layout | None,
    stages: Mapping[str, Stages],
    truth: Floats | None,
    example_frame: int,
    why_no_stages: str,
    steps: Sequence[Step],
) -> Run:
    """Compute the numbers of a run."""
    valid = valid_in_all(arms)
    return Run(
        arms,
        layout,
        stages,
        truth,
        example_frame,
        why_no_stages,
        steps,
        [summarise(arm) for arm in arms],
        [jitter(arm.x, arm.y, valid) for arm in arms],
        valid,
    )


def all_sections(run: Run) -> list[Section]:
    """Return the sections in the order of the page."""
    makers: list[Callable[[Run], Section]] = [
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


def _key_numbers(run: Run) -> Section:
    scale = None if run.layout is None else run.layout.pixel_scale_arcsec
    columns = [_arm_numbers(*arm, scale) for arm in zip(run.arms, run.summaries, run.jitters, strict=True)]
    notes = []
    if run.truth is not None:
        errors, note = _truth_numbers(run, run.truth)
        columns = [column | more for column, more in zip(columns, errors, strict=True)]
        notes.append(note)
    names = dict.fromkeys(chain(*sorted(columns, key=lambda column: -len(column))))
    rows = [[name, *(column.get(name, "–") for column in columns)] for name in names]
    table = Table(["", *(arm.name for arm in run.arms)], rows, caption=_about_the_numbers(run))
    return Section("numbers", "Key numbers", tables=[table], text=notes)


def _about_the_numbers(run: Run) -> str:
    n_frames, n = run.arms[0].x.shape
    text = f"One measurement is one sub-aperture in one frame: {n_frames} × {n} = {n_frames * n}. "
    text += (
        "Flux, iterations and the fraction at the limit are of the valid ones."
        if any(arm.is_denoised for arm in run.arms)
        else "Flux is that of the valid ones."
    )
    if n_frames == 1:
        return text
    frames = run.jitters[0].n_frames[run.jitters[0].measured]
    span = f" ({frames.min()} to {frames.max()} frames each)" if frames.size else ""
    valid = ", over the frames that are valid in every arm" if len(run.arms) > 1 else ""
    return (
        f"{text} Jitter is the standard deviation over the frames of the position in a sub-aperture{valid}, "
        f"from {len(frames)} of {n} sub-apertures{span}; it includes real motion of the spot."
    )


def _arm_numbers(
    arm: MeasuredSlopes, summary: SlopesSummary, scatter: Jitter, scale: float | None
) -> dict[str, str]:
    numbers = {
        "valid measurements": percentage(summary.valid_fraction),
        "median flux": _number(summary.median_flux_e, "e-", 3),
    }
    if arm.is_denoised:
        some = np.isfinite(summary.median_iterations)
        numbers |= {
            "median iterations": f"{summary.median_iterations:.0f}" if some else "–",
            "hit the iteration limit": percentage(summary.limit_fraction),
            "strength lowered, too strong for the image": percentage(_infeasible(arm)),
        }
    if arm.n_frames == 1:
        return numbers
    if scale is not None:
        numbers["slope jitter, median, in arcsec"] = _number(median(scatter.px) * scale, "arcsec", 3)
    return numbers | {
        "slope jitter, rms of all sub-apertures": _number(rms(scatter.px), "px", 3),
        "slope jitter, median": _number(median(scatter.px), "px", 3),
        "slope jitter, median, x | y": f"{_number(median(scatter.x_px), '', 3)} | "
        + _number(median(scatter.y_px), "px", 3),
        "slope jitter, median, from absolute deviations": _number(median(scatter.robust_px), "px", 3),
    }


def _infeasible(arm: MeasuredSlopes) -> float:
    return arm.flag_count(SubapertureFlag.INFEASIBLE_STRENGTH) / arm.flags.size


def _truth_numbers(run: Run, truth: Floats) -> tuple[list[dict[str, str]], str]:
    """Return the rows that need the truth, by arm, and what to say about them."""
    columns = []
    last = run.arms[-1]
    for arm in run.arms:
        error = slope_error(arm, truth, run.valid)
        column = {
            "slope error R": f"{_number(error.mean_px, '', 4)} ± {_number(error.standard_error_px, 'px', 2)}",
            "centroid gain": _number(error.gain, "", 3),
        }
        if len(run.arms) > 1:
            column |= _against(arm, last, truth, run.valid)
        columns.append(column)
    shared = "valid" if len(run.arms) == 1 else "valid in every arm"
    note = (
        f"The true positions are known; they lie between {truth.min():.2f} and {truth.max():.2f} px. R is "
        f"the mean of (|dx| + |dy|) / 2 over the {np.count_nonzero(run.valid)} measurements that are "
        f"{shared}, ± its standard error. The centroid gain is the slope of the measured on the true "
        "position: below 1 an estimator shrinks all motion."
    )
    if len(run.arms) > 1:
        note += (
            f" The flux gain says how many times less light gives the same R as {last.name!r}; it is a "
            "range, as R falls as 1 / flux where read noise rules (lower end when the arm is better) and as "
            "1 / √flux where photon noise does. It is worked out from R at this one flux, not measured by "
            "dimming the light."
        )
    return columns, note


def _against(
    arm: MeasuredSlopes, last: MeasuredSlopes, truth: Floats, valid: NDArray[np.bool_]
) -> dict[str, str]:
    ratio, error = error_ratio(arm, last, truth, valid)
    names = f"R of {last.name!r} / R", f"flux gain against {last.name!r}"
    if arm is last or not np.isfinite(ratio):
        return dict.fromkeys(names, "–")
    low, high = flux_gain(ratio)
    return {names[0]: f"{ratio:.3f} ± {_number(error, '', 2)}", names[1]: f"{low:.2f} to {high:.2f}"}


def _frame(run: Run) -> Section:
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


def _flux(run: Run) -> Section:
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


def _slopes(run: Run) -> Section:
    if run.layout is None:
        return Section("slopes", "Mean slopes", missing=NO_LAYOUT)
    tilts = "; ".join(
        f"{arm.name}: x {_number(_mean(summary.x_px), '', 3)}, y {_number(_mean(summary.y_px), 'px', 3)}"
        for arm, summary in zip(run.arms, run.summaries, strict=True)
    )
    noise = ""
    if run.jitters[0].measured.any():
        errors = "; ".join(
            f"{arm.name}: {_number(median(item.px / np.sqrt(np.maximum(item.n_frames, 1))), 'px', 2)}"
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
            f" Arrows longer than {_number(longest, 'px', 2)} (1.5 times the {maps.ARROWS_WHOLE_PERCENT}th "
            f"percentile) are drawn black, at that length: {number}."
        )
    caption = (
        f"{what}, all panels at one scale (key below each).{cut} Sub-apertures without an arrow but a grey "
        "cross were never valid. All arrows alike are tilt or a shifted layout, arrows to or from the middle "
        f"are focus. Mean over the sensor: {tilts}.{noise}"
    )
    figure = maps.slope_arrows(run.arms, run.summaries, run.layout)
    shown = FigureWithData("slopes", "Mean slopes as arrows", caption, figure)
    return Section("slopes", "Mean slopes", figures=[shown])


def _iterations(run: Run) -> Section:
    denoised = [
        (arm, summary) for arm, summary in zip(run.arms, run.summaries, strict=True) if arm.is_denoised
    ]
    if run.layout is None:
        return Section("iterations", "Iterations", missing=NO_LAYOUT)
    if not any(arm.valid.any() for arm, _ in denoised):
        return Section("iterations", "Iterations", missing="Not drawn: no measurement is valid.")
    caption = (
        "Left: mean iterations of the denoiser. Right: how often each number occurred, over valid "
        "measurements. A pile at the right end is the iteration limit; faint sub-apertures take longest."
    )
    arms, summaries = zip(*denoised, strict=True)
    figure = maps.iteration_counts(arms, summaries, run.layout)
    shown = FigureWithData("iterations", "Iterations", caption, figure)
    return Section("iterations", "Iterations", figures=[shown])


def _jitter(run: Run) -> Section:
    title = "Slope jitter"
    if not run.jitters[0].measured.any():
        return Section("jitter", title, missing="No sub-aperture is valid in two frames, as jitter needs.")
    text = [
        "Jitter includes the real motion of the spots (atmosphere, vibration, guiding), so it is an upper "
        "bound of the noise. Less jitter is not better by itself: an estimator whose centroid gain is below "
        "1 shrinks noise and motion alike."
    ]
    if run.truth is not None:
        moved = jitter(run.truth[..., 0], run.truth[..., 1], run.valid)
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


def _number(value: float, unit: str, digits: int) -> str:
    """Return a number with that many significant digits; a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" in text:
        text = f"{value:.0f}" if abs(value) >= 1 else f"{value:.1e}"
    return f"{text} {unit}".rstrip()
