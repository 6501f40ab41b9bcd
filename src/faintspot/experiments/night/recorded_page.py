"""Page, numbers and lines of text of a recorded night."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from faintspot.base.report.page import Page, Section, Table
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.analysis import Difference, differences
from faintspot.experiments.night.page import night_page, night_summary, night_summary_text
from faintspot.experiments.night.recorded import RecordedNight
from faintspot.experiments.words import NOTHING, with_error, with_interval

_TEXT = Texts("faintspot.experiments.night")


def page_of_recording(recorded: RecordedNight) -> Page:
    """Return the page of a night, with its residual phase and how its blocks were made."""
    page = night_page(recorded.night)
    first, *others = page.sections
    return replace(page, sections=[first, *others, _phase_section(recorded), _blocks_section(recorded)])


def summary_of_recording(recorded: RecordedNight) -> dict[str, Any]:
    """Return the numbers of the page as plain values for JSON; null is not known."""
    night = recorded.night
    return {
        **night_summary(night),
        "strehl": "measured" if recorded.is_measured else "estimated from slopes",
        "phase_rad2": [
            {
                "method": each.name,
                "difference": _plain(each.measured.value),
                "standard_error": _plain(each.measured.standard_error),
                "low": _plain(each.measured.low),
                "high": _plain(each.measured.high),
            }
            for each in phase_differences(recorded)
        ],
        "centroid_gain_of_control": recorded.centroid_gain,
        "relative_centroid_gain": {
            label: {"value": _plain(gain), "standard_error": _plain(error)}
            for label, gain, error in zip(
                night.labels, recorded.gains.gain.tolist(), recorded.gains.error.tolist(), strict=True
            )
        },
        "settle_frames": dict(zip(night.labels, recorded.settle_frames, strict=True)),
        "turns": recorded.turns,
        "cycles_in_block": recorded.turns_in_block,
        "scored_frames": recorded.frames,
        "remarks": _remarks(recorded),
    }


def text_of_recording(recorded: RecordedNight) -> str:
    """Return verdicts, differences and remarks as lines of text."""
    return "\n".join([night_summary_text(recorded.night), *_remarks(recorded)])


def phase_differences(recorded: RecordedNight) -> list[Difference]:
    """Return the residual phase variance of each group minus that of the reference [rad^2]."""
    night = recorded.night
    return differences(replace(night, strehl=night.phase_rad2, shared_error=recorded.shared_phase_error_rad2))


def _phase_section(recorded: RecordedNight) -> Section:
    night = recorded.night
    means = [
        float(np.nanmean(night.phase_rad2[night.method == number])) for number in range(len(night.labels))
    ]
    rows = [[label, f"{mean:.3g}"] for label, mean in zip(night.labels, means, strict=True)]
    compared = [
        [each.name, with_interval(each.measured), with_interval(each.without_r0)]
        for each in phase_differences(recorded)
    ]
    tables = [
        _TEXT.table("phase_means", rows, um=night.wavelength_m * 1e6),
        _TEXT.table("phase", compared, reference=night.labels[night.reference]),
    ]
    return Section("phase", _TEXT["phase.title"], [_TEXT["phase.text"]], tables)


def _blocks_section(recorded: RecordedNight) -> Section:
    night, gains = recorded.night, recorded.gains
    rows = [
        [label, f"{settle}", _relative(float(gain), float(error)), f"{np.sum(night.method == number)}"]
        for number, (label, settle, gain, error) in enumerate(
            zip(night.labels, recorded.settle_frames, gains.gain, gains.error, strict=True)
        )
    ]
    table = _TEXT.table("blocks", rows)
    text = _TEXT(
        "blocks.text",
        turns=recorded.turns,
        together=recorded.turns_in_block,
        frames=recorded.frames,
        stated=recorded.centroid_gain,
    )
    return Section(
        "blocks",
        _TEXT["blocks.title"],
        [text],
        [Table(table.header, table.rows, table.caption)],
        points=_remarks(recorded),
    )


def _remarks(recorded: RecordedNight) -> list[str]:
    """Return what a reader must know of the numbers."""
    kind = "measured" if recorded.is_measured else "estimated"
    remarks = [_TEXT[f"remarks.{kind}"]]
    unknown = [
        label
        for label, error in zip(recorded.night.labels, recorded.gains.error, strict=True)
        if not math.isfinite(error)
    ]
    if unknown:
        remarks.append(_TEXT("remarks.gains", methods=", ".join(unknown)))
    if recorded.leaning:
        remarks.append(_TEXT("remarks.leaning", methods=", ".join(recorded.leaning)))
    return remarks


def _relative(gain: float, error: float) -> str:
    if error == 0:
        return "1"
    return with_error(Estimate(gain, error), 3) if math.isfinite(error) else f"1 assumed ({NOTHING})"


def _plain(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None
