"""The report page of a slopes run: what each table and picture is, and what to look for in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from faintspot.base.errors import InputError
from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.page import POSITIONS, Part, Report, Section, Table, configuration_section
from faintspot.base.report.texts import Texts, percentage
from faintspot.base.statistics import Estimate
from faintspot.slopes.recorded.report import pictures
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.statistics import MeasuredSlopes, SlopesSummary, median, slope_error
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront import certify, fit_wavefront
from faintspot.slopes.wavefront.figure import wavefront_figure
from faintspot.slopes.wavefront.files import certificate_table, remarks

_TEXT = Texts("faintspot.slopes.recorded")
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


def _of_method(method: MeasuredSlopes, summary: SlopesSummary) -> list[str]:
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
    noise, relative = median(comparison.noise_px[index]), Estimate(*comparison.gains[index])
    error = gain = None
    if truth is not None:
        error, gain = slope_error(method, truth, run.valid[-1])
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
        "noise_at_equal_gain": median(comparison.equal_noise(index)) if ranked else None,
        "stated_error": method.standard_error_px,
        "jitter": median(run.jitters[index].px),
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
