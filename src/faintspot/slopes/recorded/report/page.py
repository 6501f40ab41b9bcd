"""The report page of a slopes run: what each table and picture is, and what to look for in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.figure_data import FigureWithData
from faintspot.base.report.page import POSITIONS, Report, Section, Table, configuration_section
from faintspot.base.report.texts import Texts, percentage
from faintspot.base.statistics import Estimate, rms
from faintspot.slopes.recorded.report import frame_pictures, maps
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.statistics import (
    Floats,
    MeasuredSlopes,
    SlopesSummary,
    error_ratio,
    flux_gain,
    jitter,
    median,
    slope_error,
)
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront import fit_wavefront
from faintspot.slopes.wavefront.figure import wavefront_figure
from faintspot.slopes.wavefront.words import remarks, rms_table

_TEXT = Texts("faintspot.slopes.recorded")
_FLAGS_OF_DENOISING = (SubapertureFlag.INFEASIBLE_STRENGTH, SubapertureFlag.NOT_CONVERGED)
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
    makers = _frame, _flux, _slopes, _jitter, _wavefront
    made = (make(run) for make in makers)
    return [_key_numbers(run), *(section for section in made if section is not None)]


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


def _of_method(method: MeasuredSlopes, summary: SlopesSummary) -> list[str]:
    lines = [] if summary.valid_fraction else [_TEXT["warnings.none_valid"]]
    for flag, advice in _TEXT["advice"].items():
        fraction = method.flag_count(SubapertureFlag[flag]) / method.x.size
        if fraction > advice["above"]:
            lines.append(_TEXT(f"advice.{flag}.text", fraction=fraction))
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
    note = _TEXT(
        "numbers.truth",
        low=truth.min(),
        high=truth.max(),
        count=np.count_nonzero(run.valid[-1]),
        shared="valid" if len(methods) == 1 else "valid in every method",
        last=last.name if len(methods) > 1 else None,
    )
    return _TEXT.section("numbers", note, table)


def _record(run: SlopesRun, index: int) -> dict[str, object]:
    """Return the numbers of a method; None where they say nothing."""
    method, comparison = run.methods[index], run.comparison
    scale = None if run.layout is None else run.layout.pixel_scale_arcsec
    noise, gain = median(comparison.noise_px[index]), Estimate(*comparison.gains[index])
    record = {
        "method": method.name,
        "noise": noise,
        "noise_arcsec": None if scale is None else noise * scale,
        "is_last": False,
        "relative_gain": None,
        "noise_at_equal_gain": None,
        "stated_error": method.standard_error_px,
        "jitter": median(run.jitters[index].px),
        "robust": median(run.jitters[index].robust_px),
        "summary": run.summaries[index],
        **_against_truth(run, method),
    }
    if run.truth is None and np.isfinite([gain for gain, _ in comparison.gains[:-1]]).any():
        record["is_last"] = gain.standard_error == 0
        record["relative_gain"] = None if record["is_last"] else gain
        record["noise_at_equal_gain"] = median(comparison.equal_noise(index))
    return record


def _against_truth(run: SlopesRun, method: MeasuredSlopes) -> dict[str, object]:
    """Return the numbers that need the truth; None without."""
    truth, last, valid = run.true_positions, run.methods[-1], run.valid[-1]
    if truth is None:
        return dict.fromkeys(("error", "gain", "ratio", "flux_gain"))
    error, gain = slope_error(method, truth, valid)
    ratio = Estimate(*error_ratio(method, last, truth, valid))
    is_known = method is not last and np.isfinite(ratio.value)
    return {
        "error": error,
        "gain": gain,
        "ratio": ratio if is_known else None,
        "flux_gain": flux_gain(ratio.value) if is_known else None,
    }


def _frame(run: SlopesRun) -> Section | None:
    if run.followed is not None and run.layout is not None:
        picture = frame_pictures.followed_picture(run.followed, run.layout)
        figure = _TEXT.figure("followed-frame", picture, frame=run.followed.number)
        return _TEXT.section("followed", figure, largest=run.followed.largest_pitches(run.layout))
    if not run.stages and not run.why_no_stages:
        return None
    if run.layout is None or not run.stages:
        return _TEXT.section("frame", missing=_NO_LAYOUT if run.layout is None else run.why_no_stages)
    truth = None if run.true_positions is None else run.true_positions[run.example_frame]
    example = frame_pictures.Example(run.layout, run.stages, truth, run.steps)
    factor = frame_pictures.coarseness(run.layout)
    values = {
        "frame": run.example_frame,
        "marked": len(run.layout) <= frame_pictures.MOST_MARKED,
        "circles": "" if truth is None else ", circles true ones",
        "coarse": factor if factor > 1 else None,
    }
    return _TEXT.section(
        "frame",
        _TEXT.figure("sensor", frame_pictures.whole_sensor(example), **values),
        _TEXT.figure("subapertures", frame_pictures.zoom(example), shown=next(iter(run.stages))),
    )


def _flux(run: SlopesRun) -> Section:
    denoised = any(method.is_denoised for method in run.methods)
    rows = []
    for name, meaning in _TEXT["flags"].items():
        flag = SubapertureFlag[name]
        counts = {method.name: method.flag_count(flag) for method in run.methods}
        if any(counts.values()) or denoised or flag not in _FLAGS_OF_DENOISING:
            shares = [percentage(counts[method.name] / method.flags.size) for method in run.methods]
            cells = [f"{count} ({share})" for count, share in zip(counts.values(), shares, strict=True)]
            rows.append([name, *cells, meaning])
    table = _TEXT.table("flux.flags", rows, [*(method.name for method in run.methods), "meaning"])
    if run.layout is None:
        return _TEXT.section("flux", table, missing=_NO_LAYOUT)
    figure = maps.flux_and_validity(run.methods, run.summaries, run.layout)
    return _TEXT.section("flux", table, _TEXT.figure("flux", figure, several=run.has_several_frames))


def _slopes(run: SlopesRun) -> Section:
    if run.layout is None:
        return _TEXT.section("slopes", missing=_NO_LAYOUT)
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
        "several": run.has_several_frames,
    }
    return _TEXT.section("slopes", _TEXT.figure("slopes", figure, **values))


def _jitter(run: SlopesRun) -> Section | None:
    if not run.has_several_frames:
        return None
    if not run.jitters[0].measured.any():
        return _TEXT.section("jitter")
    motion, truth = None, run.true_positions
    if truth is not None:
        motion = rms(jitter(truth[..., 0], truth[..., 1], run.valid[-1]).px)
    if run.layout is None:
        return _TEXT.section("jitter", missing=_NO_LAYOUT)
    figure = _TEXT.figure("jitter", maps.jitter_maps(run.methods, run.jitters, run.layout))
    return _TEXT.section("jitter", figure, motion=motion)


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
        figures.append(wavefront_figure(wavefront, run.layout, name, file=f"wavefront-{number + 1}"))
    return Section("wavefront", "Wavefront", [*text, *tables, *figures], " ".join(missing))


def _mean(values: Floats) -> float:
    kept = values[np.isfinite(values)]
    return float(kept.mean()) if kept.size else np.nan
