"""Meaning of a run's flags, with advice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.texts import Texts
from faintspot.slopes.recorded.statistics import MeasuredSlopes, SlopesSummary

_TEXT = Texts("faintspot.slopes.recorded")
FLAGS_OF_DENOISING = (SubapertureFlag.INFEASIBLE_STRENGTH, SubapertureFlag.NOT_CONVERGED)
_MOST_LISTED = 20


def percentage(fraction: float) -> str:
    """Return a fraction as per cent, without rounding small ones to 0 or nearly all to 100."""
    if not np.isfinite(fraction):
        return "–"
    percent = 100.0 * fraction
    if 0 < percent < 0.1:
        return "< 0.1 %"
    if 99.9 < percent < 100:
        return "> 99.9 %"
    return f"{percent:.0f} %" if percent in (0, 100) else f"{percent:.1f} %"


def warnings_in_words(methods: Sequence[MeasuredSlopes], summaries: Sequence[SlopesSummary]) -> list[str]:
    """Return what is wrong with a run and what to do next, a sentence or two each."""
    lines = []
    for method, summary in zip(methods, summaries, strict=True):
        prefix = f"{method.name}: " if len(methods) > 1 else ""
        lines += [prefix + line for line in _of_method(method, summary)]
    if methods[0].n_frames == 1:
        lines.append(_TEXT["warnings.one_frame"])
    fractions = [summary.valid_fraction for summary in summaries]
    if max(fractions) - min(fractions) > 0.01:
        lines.append(_TEXT["warnings.not_alike"])
    return lines


def _of_method(method: MeasuredSlopes, summary: SlopesSummary) -> list[str]:
    lines = [] if summary.valid_fraction else [_TEXT["warnings.none_valid"]]
    for flag, advice in _TEXT["advice"].items():
        fraction = method.flag_count(SubapertureFlag[flag]) / method.x.size
        if fraction > advice["above"]:
            lines.append(advice["text"].format(percent=percentage(fraction)))
    never = np.flatnonzero(summary.valid_frames == 0)
    if 0 < len(never) < method.n_subapertures:
        listed = ", ".join(str(number) for number in never[:_MOST_LISTED])
        more = f" and {len(never) - _MOST_LISTED} more" if len(never) > _MOST_LISTED else ""
        counts = {"count": len(never), "all": method.n_subapertures, "listed": listed + more}
        lines.append(_TEXT("warnings.never_valid", **counts))
    return lines
