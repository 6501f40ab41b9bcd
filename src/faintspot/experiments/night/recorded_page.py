"""Page, numbers and lines of text of a recorded night."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from faintspot.base.report.page import Report, Section
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.analysis import Difference, differences
from faintspot.experiments.night.page import night_page, night_summary, night_summary_text, plain
from faintspot.experiments.night.recorded import RecordedNight

_TEXT = Texts("faintspot.experiments.night")


def page_of_recording(recorded: RecordedNight) -> Report:
    """Return the page of a night, with its residual phase and how its blocks were made."""
    page = night_page(recorded.night)
    return replace(page, sections=[*page.sections, _phase_section(recorded), _blocks_section(recorded)])


def summary_of_recording(recorded: RecordedNight) -> dict[str, object]:
    """Return the numbers of the page as plain values for JSON; null is not known."""
    night, gains = recorded.night, recorded.gains
    parts = ("standard_error", "low", "high")
    return {
        **night_summary(night),
        "strehl": "measured" if recorded.is_measured else "estimated from slopes",
        "phase_rad2": [
            {
                "method": each.name,
                "difference": plain(each.measured.value),
                **{part: plain(getattr(each.measured, part)) for part in parts},
            }
            for each in phase_differences(recorded)
        ],
        "centroid_gain_of_control": recorded.centroid_gain,
        "relative_centroid_gain": {
            label: {"value": plain(gain), "standard_error": plain(error)}
            for label, gain, error in zip(
                night.labels, gains.gain.tolist(), gains.error.tolist(), strict=True
            )
        },
        "settle_frames": dict(zip(night.labels, recorded.settle_frames, strict=True)),
        "turns": recorded.turns,
        "cycles_in_block": recorded.turns_in_block,
        "scored_frames": recorded.frames,
        "remarks": _remarks(recorded),
    }


def text_of_recording(recorded: RecordedNight) -> str:
    """Return verdicts and differences, and what a reader must know of them, as lines of text."""
    return "\n".join([night_summary_text(recorded.night), *_remarks(recorded)])


def phase_differences(recorded: RecordedNight) -> list[Difference]:
    """Return the residual phase variance of each group minus that of the reference [rad^2]."""
    night = recorded.night
    return differences(replace(night, strehl=night.phase_rad2, shared_error=recorded.shared_phase_error_rad2))


def _phase_section(recorded: RecordedNight) -> Section:
    night = recorded.night
    table = _TEXT.table("phase", phase_differences(recorded), reference=night.labels[night.reference])
    return _TEXT.section("phase", table)


def _blocks_section(recorded: RecordedNight) -> Section:
    night, gains = recorded.night, recorded.gains
    rows = [
        {
            "method": label,
            "settle": settle,
            "stated": True if error == 0 else None,
            "assumed": True if not math.isfinite(error) else None,
            "gain": Estimate(float(gain), float(error)) if 0 < error < math.inf else None,
            "blocks": np.sum(night.method == number),
        }
        for number, (label, settle, gain, error) in enumerate(
            zip(night.labels, recorded.settle_frames, gains.gain, gains.error, strict=True)
        )
    ]
    return _TEXT.section("blocks", _remarks(recorded), _TEXT.table("blocks", rows), recorded=recorded)


def _remarks(recorded: RecordedNight) -> list[str]:
    """Return what a reader must know of the numbers."""
    unknown = [
        label
        for label, error in zip(recorded.night.labels, recorded.gains.error, strict=True)
        if not math.isfinite(error)
    ]
    return _TEXT.lines(
        "remarks",
        measured=recorded.is_measured,
        unknown=", ".join(unknown) or None,
        leaning=", ".join(recorded.leaning) or None,
    )
