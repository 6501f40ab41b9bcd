"""The sections of a report page: what each table and picture is, and what to look for in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import Section, Table
from faintspot.base.report.texts import Texts
from faintspot.base.report.words import percentage
from faintspot.slopes.recorded.report import frame_pictures, maps
from faintspot.slopes.recorded.report.advice import FLAGS_OF_DENOISING
from faintspot.slopes.recorded.report.key_numbers import key_numbers
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.statistics import Floats, jitter, median, rms
from faintspot.slopes.wavefront import fit_wavefront
from faintspot.slopes.wavefront.figure import wavefront_figure
from faintspot.slopes.wavefront.words import mode_table, remarks, rms_table

_TEXT = Texts("faintspot.slopes.recorded")
NO_LAYOUT = "Not drawn: the layout of the sub-apertures is not known."


def slopes_sections(run: SlopesRun) -> list[Section]:
    """Return the sections in the order of the page."""
    makers = _frame, _flux, _slopes, _iterations, _jitter, _wavefront
    made = (make(run) for make in makers)
    return [key_numbers(run), *(section for section in made if section is not None)]


def _frame(run: SlopesRun) -> Section | None:
    if not run.stages and not run.why_no_stages:
        return None
    if run.layout is None or not run.stages:
        return _TEXT.section("frame", missing=NO_LAYOUT if run.layout is None else run.why_no_stages)
    truth = None if run.true_positions is None else run.true_positions[run.example_frame]
    example = frame_pictures.Example(run.layout, run.stages, truth, run.steps)
    number, factor = len(example.shown_steps), frame_pictures.coarseness(run.layout)
    marked, in_electrons = len(run.layout) <= frame_pictures.MOST_MARKED, example.raw_is_calibrated
    values = {
        "frame": run.example_frame,
        "shown": next(iter(run.stages)),
        "in_electrons": in_electrons,
        "all_alike": in_electrons and number > 1,
        "both_scales": not in_electrons and number == 2,
        "raw_apart": not in_electrons and number != 2,
        "marked": marked,
        "circles": "" if truth is None else " and circles true ones",
        "unmarked": not marked,
        "coarse": factor if factor > 1 else None,
        "several": number > 2,
    }
    return _TEXT.section(
        "frame",
        _TEXT.figure("sensor", frame_pictures.whole_sensor(example), **values),
        _TEXT.figure("subapertures", frame_pictures.zoom(example), several=number > 2),
    )


def _flux(run: SlopesRun) -> Section:
    denoised = any(method.is_denoised for method in run.methods)
    rows = []
    for name, meaning in _TEXT["flags"].items():
        flag = SubapertureFlag[name]
        counts = {method.name: method.flag_count(flag) for method in run.methods}
        if any(counts.values()) or denoised or flag not in FLAGS_OF_DENOISING:
            shares = [percentage(counts[method.name] / method.flags.size) for method in run.methods]
            cells = [f"{count} ({share})" for count, share in zip(counts.values(), shares, strict=True)]
            rows.append([name, *cells, meaning])
    table = _TEXT.table("flux.flags", rows, [*(method.name for method in run.methods), "meaning"])
    if run.layout is None:
        return _TEXT.section("flux", table, missing=NO_LAYOUT)
    figure = maps.flux_and_validity(run.methods, run.summaries, run.layout)
    return _TEXT.section("flux", table, _TEXT.figure("flux", figure, **_frames(run)))


def _slopes(run: SlopesRun) -> Section:
    if run.layout is None:
        return _TEXT.section("slopes", missing=NO_LAYOUT)
    each = list(zip(run.methods, run.summaries, run.jitters, strict=True))
    tilts = [
        _TEXT("slopes.tilt", name=method.name, x=_mean(summary.x_px), y=_mean(summary.y_px))
        for method, summary, _ in each
    ]
    errors = [
        _TEXT("slopes.error", name=method.name, error=median(item.px / np.sqrt(np.maximum(item.n_frames, 1))))
        for method, _, item in each
    ]
    longest, number = maps.longest_arrow(run.summaries)
    figure = maps.slope_arrows(run.methods, run.summaries, run.layout)
    values = {
        "tilts": "; ".join(tilts),
        "errors": "; ".join(errors) if run.jitters[0].measured.any() else None,
        "longest": longest,
        "percent": maps.ARROWS_WHOLE_PERCENT,
        "number": number or None,
        **_frames(run),
    }
    return _TEXT.section("slopes", _TEXT.figure("slopes", figure, **values))


def _iterations(run: SlopesRun) -> Section | None:
    pairs = zip(run.methods, run.summaries, strict=True)
    denoised = [(method, summary) for method, summary in pairs if method.is_denoised]
    if not denoised:
        return None
    if run.layout is None:
        return _TEXT.section("iterations", missing=NO_LAYOUT)
    if not any(method.valid.any() for method, _ in denoised):
        return _TEXT.section("iterations")
    medians = "; ".join(f"{method.name}: {summary.median_iterations:.0f}" for method, summary in denoised)
    methods, summaries = zip(*denoised, strict=True)
    figure = maps.iteration_counts(methods, summaries, run.layout)
    return _TEXT.section("iterations", _TEXT.figure("iterations", figure, medians=medians))


def _jitter(run: SlopesRun) -> Section | None:
    if run.methods[0].n_frames == 1:
        return None
    if not run.jitters[0].measured.any():
        return _TEXT.section("jitter")
    motion, truth = None, run.true_positions
    if truth is not None:
        motion = rms(jitter(truth[..., 0], truth[..., 1], run.valid[-1]).px)
    figures = [_TEXT.figure("jitter", maps.jitter_plot(run.methods, run.jitters))]
    if run.layout is not None:
        shown = maps.jitter_maps(run.methods, run.jitters, run.layout)
        figures.insert(0, _TEXT.figure("jitter-map", shown))
    return _TEXT.section("jitter", *figures, motion=motion)


def _wavefront(run: SlopesRun) -> Section | None:
    """Return the section with the wavefronts fitted to the slopes of each method; none without a layout."""
    if run.layout is None or not run.slopes:
        return None
    tables: list[Table] = []
    figures: list[FigureWithData] = []
    text, missing = [_TEXT["wavefront.about"]], []
    for number, (name, slopes) in enumerate(run.slopes.items()):
        try:
            wavefront = fit_wavefront(slopes, run.layout)
        except InputError as error:
            missing.append(f"Wavefront of {name!r}: {error}.")
            continue
        text += [line for line in remarks(wavefront) if line not in text]
        tables.append(Table(*rms_table(wavefront), name))
        tables.append(Table(*mode_table(wavefront), name, folded=f"Coefficients of {name!r}"))
        figures.append(wavefront_figure(wavefront, run.layout, name, file=f"wavefront-{number + 1}"))
    return Section("wavefront", "Wavefront", [*text, *tables, *figures], " ".join(missing))


def _frames(run: SlopesRun) -> dict[str, Any]:
    """Return whether there is one frame or several."""
    several = run.methods[0].n_frames > 1
    return {"several": several, "single": not several}


def _mean(values: Floats) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else np.nan
