"""Meaning of a run's flags, with advice."""

from __future__ import annotations

import numpy as np

from faintspot.base.flags import SubapertureFlag
from faintspot.base.report.texts import Texts
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.statistics import MeasuredSlopes, SlopesSummary

_TEXT = Texts("faintspot.slopes.recorded")
FLAGS_OF_DENOISING = (SubapertureFlag.INFEASIBLE_STRENGTH, SubapertureFlag.NOT_CONVERGED)
_MOST_LISTED = 20


def warnings_in_words(run: SlopesRun) -> list[str]:
    """Return what is wrong with a run and what to do next, a sentence or two each."""
    lines = []
    for method, summary in zip(run.methods, run.summaries, strict=True):
        prefix = f"{method.name}: " if len(run.methods) > 1 else ""
        lines += [prefix + line for line in _of_method(method, summary)]
    if run.methods[0].n_frames == 1:
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
