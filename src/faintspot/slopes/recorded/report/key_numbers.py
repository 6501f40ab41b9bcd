"""The key numbers of a report: one table, one row for each method."""

from __future__ import annotations

from typing import Any

import numpy as np

from faintspot.base.report.page import Section
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
from faintspot.slopes.recorded.report.run import SlopesRun
from faintspot.slopes.recorded.statistics import (
    MeasuredSlopes,
    error_ratio,
    flux_gain,
    median,
    slope_error,
)

_TEXT = Texts("faintspot.slopes.recorded")


def key_numbers(run: SlopesRun) -> Section:
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


def _record(run: SlopesRun, index: int) -> dict[str, Any]:
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
        "summary": run.summaries[index],
        **_against_truth(run, method),
    }
    if run.truth is None and np.isfinite([gain for gain, _ in comparison.gains[:-1]]).any():
        record["is_last"] = gain.standard_error == 0
        record["relative_gain"] = None if record["is_last"] else gain
        record["noise_at_equal_gain"] = median(comparison.equal_noise(index))
    return record


def _against_truth(run: SlopesRun, method: MeasuredSlopes) -> dict[str, Any]:
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
