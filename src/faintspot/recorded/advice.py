"""What the flags of a run mean, and what to do about what went wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from faintspot.base.flags import SubapertureFlag
from faintspot.recorded.statistics import MeasuredSlopes, SlopesSummary

FLAG_MEANINGS = {
    SubapertureFlag.NO_FLUX: "Nothing usable was left of the flux: invalid, slope 0.",
    SubapertureFlag.TOO_MANY_BAD_PIXELS: "More bad pixels than the settings allow: invalid, slope 0.",
    SubapertureFlag.UNLIKE_NEIGHBOURS: "The slope is unlike those of all neighbours: probably a wrong spot.",
    SubapertureFlag.SATURATED: "At least one pixel reached the saturation level.",
    SubapertureFlag.INFEASIBLE_STRENGTH: "noise_std was above 0.9 of the image's rms, and was lowered.",
    SubapertureFlag.NOT_CONVERGED: "The limit of iterations or steps came before the result had settled.",
    SubapertureFlag.OUTLIER_LIKELY: "So faint that more than about 1 % of such slopes are those of noise.",
    SubapertureFlag.AT_SEARCH_LIMIT: "The slope ends at search_range_px, or the window cuts the spot.",
}
FLAGS_OF_DENOISING = (SubapertureFlag.INFEASIBLE_STRENGTH, SubapertureFlag.NOT_CONVERGED)
_MOST_LISTED = 20
_OFTEN_INFEASIBLE = 0.05
# Fraction of the measurements from which a flag is worth a warning, and what to do then.
_ADVICE = {
    SubapertureFlag.TOO_MANY_BAD_PIXELS: (
        0.001,
        "had too many bad pixels",
        "check the bad-pixel map and the flat, or raise max_bad_fraction",
    ),
    SubapertureFlag.SATURATED: (
        0.001,
        "were saturated, which pulls positions towards the centre of the saturated area",
        "expose for less time or lower the camera's gain; check saturation_adu",
    ),
    SubapertureFlag.INFEASIBLE_STRENGTH: (
        _OFTEN_INFEASIBLE,
        "had images hardly noisier than noise_std says the noise is, so that it was lowered there",
        'lower noise_std or set it to "auto"; compare with estimator "brightest"',
    ),
    SubapertureFlag.NOT_CONVERGED: (
        0.10,
        "hit the limit of iterations or steps before the result had settled",
        "raise max_iterations (or tolerance) of a denoising, steps of a fit",
    ),
    SubapertureFlag.AT_SEARCH_LIMIT: (
        0.01,
        "ended at the limit of the search range, or their spots are cut by the window's edge",
        "raise search_range_px, or check that the windows lie on the spots; at low flux noise ends there",
    ),
    SubapertureFlag.UNLIKE_NEIGHBOURS: (
        0.001,
        "were displaced unlike all their neighbours, as a wrong spot is",
        "check their windows (faintspot layout draws them), or leave these sub-apertures out",
    ),
}


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


def warnings_in_words(arms: Sequence[MeasuredSlopes], summaries: Sequence[SlopesSummary]) -> list[str]:
    """Return what is wrong with a run and what to do next, a sentence or two each."""
    lines = []
    for arm, summary in zip(arms, summaries, strict=True):
        prefix = f"{arm.name}: " if len(arms) > 1 else ""
        lines += [prefix + line for line in _of_arm(arm, summary)]
    if arms[0].n_frames == 1:
        lines.append(
            "There is one frame only: no jitter can be given. Measure several frames of the same field."
        )
    fractions = [summary.valid_fraction for summary in summaries]
    if max(fractions) - min(fractions) > 0.01:
        lines.append(
            "The arms differ in how many measurements are valid. Jitter and slope error compare the "
            "measurements that are valid in every arm, which may be the easier ones."
        )
    return lines


def _of_arm(arm: MeasuredSlopes, summary: SlopesSummary) -> list[str]:
    lines = _no_flux(arm)
    if summary.valid_fraction == 0:
        lines.insert(0, "No measurement is valid, so there are no slopes.")
    for flag, (least, what, advice) in _ADVICE.items():
        count = arm.flag_count(flag)
        fraction = count / arm.x.size
        if fraction > least:
            lines.append(f"{percentage(fraction)} of the measurements {what}. Next: {advice}.")
    never = np.flatnonzero(summary.valid_frames == 0)
    if 0 < len(never) < arm.n_subapertures:
        listed = ", ".join(str(number) for number in never[:_MOST_LISTED])
        more = f" and {len(never) - _MOST_LISTED} more" if len(never) > _MOST_LISTED else ""
        lines.append(
            f"{len(never)} of {arm.n_subapertures} sub-apertures were never valid (no. {listed}{more}). "
            "Next: leave them out of the layout if they are outside the pupil."
        )
    return lines


def _no_flux(arm: MeasuredSlopes) -> list[str]:
    dark = arm.flag_count(SubapertureFlag.NO_FLUX)
    fraction = dark / arm.x.size
    if fraction <= 0.01:
        return []
    return [
        f"{percentage(fraction)} of the measurements had no flux. Next: check that the windows lie on the "
        "spots (faintspot layout draws them) and that the dark is right."
    ]
