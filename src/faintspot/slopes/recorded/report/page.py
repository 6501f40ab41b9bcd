"""The report page of a slopes run: one HTML text that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from faintspot.base.report.page import POSITIONS, Report, Section, configuration_section
from faintspot.slopes.recorded.report.advice import warnings_in_words
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.report.sections import slopes_sections
from faintspot.slopes.sensor.layout import Layout


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
