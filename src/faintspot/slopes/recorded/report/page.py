"""The report page of a slopes run: one HTML text that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between
from faintspot.base.errors import InputError
from faintspot.base.report.page import POSITIONS, Page, Section, configuration_section, html_of
from faintspot.slopes.estimators.base import Step
from faintspot.slopes.estimators.built_in.total_variation import TotalVariation
from faintspot.slopes.pipeline.slopes import Slopes, Stages
from faintspot.slopes.recorded.report.advice import warnings_in_words
from faintspot.slopes.recorded.report.sections import all_sections, make_run
from faintspot.slopes.recorded.report.wavefront_section import wavefront_sections
from faintspot.slopes.recorded.statistics import MeasuredSlopes
from faintspot.slopes.sensor.layout import Layout


def slopes_report(
    methods: Sequence[MeasuredSlopes],
    *,
    layout: Layout | None,
    stages: Mapping[str, Stages] | None,
    truth: ArrayLike | None = None,
    title: str,
    facts: Mapping[str, str],
    configurations: Mapping[str, str],
    example_frame: int = 0,
    warnings: Sequence[str] = (),
    why_no_stages: str = "Not drawn: no frame was given.",
    steps: Sequence[Step] = TotalVariation.steps_shown,
    slopes: Mapping[str, Slopes] | None = None,
    sections: Sequence[Section] = (),
) -> str:
    """Return the report page of a slopes run as HTML: self-contained, without scripts.

    Parameters
    ----------
    methods : sequence of MeasuredSlopes
        The same frames, measured in one or several ways. Others are compared with the last one.
    layout : Layout or None
        None leaves the maps out, which the page says.
    stages : mapping of Stages, or None
        `SlopePipeline.explain` of frame `example_frame`, by name. The first one's images are shown; the
        positions of all are marked, and must be measured without a reference.
    truth : array (n_frames, n_subapertures, 2), optional
        True x, y, px from each sub-aperture's centre.
    title : str
    facts : mapping of str
        What was run, for the top of the page, as sources and settings in words.
    configurations : mapping of str
        TOML text by the name of what it is of; "" when not known.
    example_frame : int
    warnings : sequence of str
        Shown before those found in the slopes.
    why_no_stages : str
        What the page says in place of the frame.
    steps : sequence of Step
        Which pictures of the frame are drawn.
    slopes : mapping of Slopes, optional
        Slopes by method, whose wavefronts are shown. Default: no wavefronts.
    sections : sequence of Section
        Further sections, before the configurations.

    Raises
    ------
    InputError
        When the parts do not fit together.
    MissingExtraError
        When matplotlib or jinja2 is not installed.
    """
    methods = list(methods)
    _check_methods(methods, layout)
    shape = methods[0].x.shape
    number_between("example_frame", example_frame, 0, shape[0] - 1, integer=True)
    true = None if truth is None else _checked_truth(truth, shape)
    stages = _checked_stages(stages or {}, shape[1])
    run = make_run(methods, layout, stages, true, int(example_frame), why_no_stages, steps)
    return html_of(
        Page(
            title=title,
            facts={**facts, "Frames": str(shape[0]), "Sub-apertures": _sensor_in_words(shape[1], layout)},
            sections=[
                *all_sections(run),
                *wavefront_sections(slopes or {}, layout),
                *sections,
                *(configuration_section(text, name) for name, text in configurations.items()),
            ],
            warnings=[*warnings, *run.comparison.warnings(), *warnings_in_words(run.methods, run.summaries)],
            remark=POSITIONS,
        )
    )


def _check_methods(methods: Sequence[MeasuredSlopes], layout: Layout | None) -> None:
    if not methods:
        raise InputError("methods: expected at least one, got none")
    names = [method.name for method in methods]
    if len(set(names)) < len(names):
        raise InputError(f"methods: expected a different name for each, got {', '.join(names)}")
    for method in methods[1:]:
        if method.x.shape != methods[0].x.shape:
            raise InputError(
                f"methods: expected the same frames and sub-apertures in all, got shape {methods[0].x.shape} "
                f"in {methods[0].name!r} and {method.x.shape} in {method.name!r}"
            )
    if layout is not None and len(layout) != methods[0].n_subapertures:
        raise InputError(
            f"layout: expected {methods[0].n_subapertures} sub-apertures, as in the slopes, got {len(layout)}"
        )


def _checked_truth(truth: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = finite_array("truth", truth).astype(np.float64)
    if array.shape != (*shape, 2):
        raise InputError(f"truth: expected shape {(*shape, 2)}, got {array.shape}")
    return array


def _checked_stages(stages: Mapping[str, Stages], n: int) -> dict[str, Stages]:
    """Return the stages of one frame each; `explain` of a stack of one frame is accepted too."""
    for name, item in stages.items():
        if item.raw.ndim != 3 or len(item.raw) != n:
            raise InputError(
                f"stages: {name}: expected images (n_subapertures, ny, nx) of one frame with {n} "
                f"sub-apertures, got shape {item.raw.shape}"
            )
    return dict(stages)


def _sensor_in_words(n: int, layout: Layout | None) -> str:
    if layout is None:
        return str(n)
    pitch = "" if layout.pitch_px is None else f", pitch {layout.pitch_px:.2f} px"
    height, width = layout.frame_shape
    return (
        f"{n} of {layout.window[0]} × {layout.window[1]} px, {layout.geometry}{pitch}, in frames of "
        f"{height} × {width} px"
    )
