"""The key numbers of a report: one table, one row for each method."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from faintspot.base.report.page import Section, Table
from faintspot.base.report.texts import Texts
from faintspot.slopes.recorded.report.advice import percentage
from faintspot.slopes.recorded.statistics import (
    Floats,
    Jitter,
    MeasuredSlopes,
    SlopesSummary,
    error_ratio,
    flux_gain,
    frame_to_frame_noise,
    median,
    relative_gain,
    slope_error,
)

_TEXT = Texts("faintspot.slopes.recorded")

_KNOWN = 0.1  # standard error of a relative gain above which it counts as unknown
_DIFFERENT = 0.05  # difference of centroid gains that is worth a warning
_SURELY = 3.0  # standard errors
_GAIN, _EQUAL = "relative gain", "noise at equal gain (px)"


@dataclass(frozen=True)
class Comparison:
    """Noise and centroid gain of the methods of a run, from the slopes alone."""

    methods: Sequence[MeasuredSlopes]
    noise_px: Sequence[Floats]
    """Noise of each sub-aperture from consecutive frames; NaN where there are none."""
    gains: Sequence[tuple[float, float]]
    """Centroid gain relative to the last method, and its standard error; NaN where it is not known."""

    @classmethod
    def of(cls, methods: Sequence[MeasuredSlopes], valid: Sequence[NDArray[np.bool_]]) -> Comparison:
        """Measure the methods, each over its valid measurements; gains only where the frames are the same."""
        noise = [frame_to_frame_noise(method, used) for method, used in zip(methods, valid, strict=True)]
        last, unknown = methods[-1], (np.nan, np.nan)
        same = len(methods) > 1 and all(np.array_equal(method.number, last.number) for method in methods)
        gains = [relative_gain(method, last, valid[-1]) if same else unknown for method in methods]
        return cls(methods, noise, [gain if gain[1] < _KNOWN else unknown for gain in gains])

    def equal_noise(self, index: int) -> Floats:
        """Return the noise of a method at the gain of the last one, px."""
        equal: Floats = self.noise_px[index] / self.gains[index][0]
        return equal

    def warnings(self) -> list[str]:
        """Return a warning where the centroid gains of two methods differ."""
        pairs = list(zip(self.methods, self.gains, strict=True))[:-1]
        name = self.methods[-1].name
        return [
            _TEXT("numbers.different_gain", name=method.name, last=name, gain=gain, error=error)
            for method, (gain, error) in pairs
            if abs(gain - 1) > max(_DIFFERENT, _SURELY * error)
        ]

    def verdict(self) -> str:
        """Name the method with the least noise at equal gain, if the errors allow it."""
        levels = [median(self.equal_noise(index)) for index in range(len(self.methods))]
        if len(levels) < 2 or self.methods[0].n_frames < 2:
            return ""
        if not np.isfinite(levels).all():
            return str(_TEXT["numbers.unknown_gain"])
        best, second = np.argsort(levels)[:2]
        difference = self.equal_noise(second) - self.equal_noise(best)
        difference = difference[np.isfinite(difference)]
        size, error = float(difference.mean()), float(difference.std() / max(len(difference) - 1, 1) ** 0.5)
        for method, other in ((best, second), (second, best)):
            gain, gain_error = self.gains[method]
            error = float(np.hypot(error, levels[other] * gain_error / gain))
        names = {"best": self.methods[best].name, "second": self.methods[second].name}
        if len(difference) < 2 or size < _SURELY * error:
            return _TEXT("numbers.equal", **names)
        return _TEXT("numbers.least", **names, size=size, error=error)


def key_numbers(
    comparison: Comparison,
    summaries: Sequence[SlopesSummary],
    jitters: Sequence[Jitter],
    valid: NDArray[np.bool_],
    truth: Floats | None,
    scale_arcsec: float | None,
) -> Section:
    """Return the table of all methods: errors where the truth is known, noise, and the rest."""
    methods = comparison.methods
    rows = [
        _noise_cells(comparison, index, scale_arcsec) | _other_cells(method, summary, scatter)
        for index, (method, summary, scatter) in enumerate(zip(methods, summaries, jitters, strict=True))
    ]
    text = [verdict] if truth is None and (verdict := comparison.verdict()) else []
    if truth is not None:
        errors, note = _truth_cells(methods, truth, valid)
        rows = [error | row for error, row in zip(errors, rows, strict=True)]
        text.append(note)
    columns = [name for name in dict.fromkeys(chain(*rows)) if any(row.get(name, "–") != "–" for row in rows)]
    if not np.isfinite([gain for gain, _ in comparison.gains[:-1]]).any() or truth is not None:
        columns = [name for name in columns if name not in (_GAIN, _EQUAL)]
    table = Table(
        ["method", *columns],
        [
            [method.name, *(row.get(name, "–").replace(" ", "\u00a0") for name in columns)]
            for method, row in zip(methods, rows, strict=True)
        ],
        caption=_caption(methods, columns),
    )
    return Section("numbers", "Key numbers", tables=[table], text=text)


def number_text(value: float, unit: str, digits: int) -> str:
    """Return a number with that many significant digits; a dash where there is none."""
    if not np.isfinite(value):
        return "–"
    text = f"{value:#.{digits}g}".rstrip(".")
    if "e" in text:
        text = f"{value:.0f}" if abs(value) >= 1 else f"{value:.1e}"
    return f"{text} {unit}".rstrip()


def _caption(methods: Sequence[MeasuredSlopes], columns: Sequence[str]) -> str:
    """Return what the columns mean, of those that are there."""
    n_frames, n = methods[0].x.shape
    alike = all(method.n_frames == n_frames for method in methods)
    counted = f": {n_frames} × {n} = {n_frames * n}" if alike else ""
    meanings = {
        "noise (px)": "Noise: standard deviation of a slope per axis from differences of successive frames, "
        "median of the sub-apertures; it includes motion that is as fast as the frames.",
        _GAIN: f"Relative gain: centroid gain over that of {methods[-1].name!r}, from motion and "
        "aberrations that both see in neighbouring frames.",
        _EQUAL: "Noise at equal gain: noise over relative gain. It ranks the methods.",
        "stated error (px)": "Stated error: median standard error that the estimator gives, per axis.",
        "jitter (px)": "Jitter: standard deviation of a slope over all frames, median of the sub-apertures; "
        "it includes all motion.",
    }
    shown = " ".join(text for name, text in meanings.items() if name in columns)
    together = _TEXT["numbers.together"] if alike else ""
    return f"One measurement is one sub-aperture in one frame{counted}. {shown}" + together * (
        len(methods) > 1
    )


def _noise_cells(comparison: Comparison, index: int, scale_arcsec: float | None) -> dict[str, str]:
    noise = median(comparison.noise_px[index])
    gain, error = comparison.gains[index]
    cells = {
        "noise (px)": number_text(noise, "", 3),
        _GAIN: "1" if error == 0 else f"{gain:.3f} ± {error:.3f}" if np.isfinite(gain) else "–",
        _EQUAL: number_text(median(comparison.equal_noise(index)), "", 3),
    }
    if scale_arcsec is not None:
        cells["noise (arcsec)"] = number_text(noise * scale_arcsec, "", 3)
    return cells


def _other_cells(method: MeasuredSlopes, summary: SlopesSummary, scatter: Jitter) -> dict[str, str]:
    return {
        "stated error (px)": number_text(method.standard_error_px, "", 3),
        "jitter (px)": number_text(median(scatter.px), "", 3),
        "valid": percentage(summary.valid_fraction),
        "median flux": number_text(summary.median_flux_e, "e-", 3),
    }


def _truth_cells(
    methods: Sequence[MeasuredSlopes], truth: Floats, valid: NDArray[np.bool_]
) -> tuple[list[dict[str, str]], str]:
    """Return the cells that need the truth, by method, and what to say about them."""
    cells = []
    last = methods[-1]
    for method in methods:
        error, gain = slope_error(method, truth, valid)
        cells_of = {
            "slope error R (px)": f"{number_text(error.value, '', 4)} ± "
            + number_text(error.standard_error, "", 2),
            "centroid gain": number_text(gain, "", 3),
        }
        cells.append(cells_of | (_against(method, last, truth, valid) if len(methods) > 1 else {}))
    shared = "valid" if len(methods) == 1 else "valid in every method"
    note = _TEXT(
        "numbers.truth", low=truth.min(), high=truth.max(), count=np.count_nonzero(valid), shared=shared
    )
    if len(methods) > 1:
        note += _TEXT("numbers.flux_gain", last=last.name)
    return cells, note


def _against(
    method: MeasuredSlopes, last: MeasuredSlopes, truth: Floats, valid: NDArray[np.bool_]
) -> dict[str, str]:
    ratio, error = error_ratio(method, last, truth, valid)
    names = f"R of {last.name!r} / R", f"flux gain against {last.name!r}"
    if method is last or not np.isfinite(ratio):
        return dict.fromkeys(names, "–")
    low, high = flux_gain(ratio)
    return {names[0]: f"{ratio:.3f} ± {number_text(error, '', 2)}", names[1]: f"{low:.2f} to {high:.2f}"}
