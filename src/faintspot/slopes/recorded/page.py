"""Report page of a slopes run: its methods, their comparison, and what each table and picture is."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.flags import SubapertureFlag, leave_out
from faintspot.base.report.page import POSITIONS, Part, Report, Section, Table, configuration_section
from faintspot.base.report.texts import Texts, percentage
from faintspot.base.statistics import UNKNOWN, Estimate
from faintspot.slopes.recorded import pictures, statistics
from faintspot.slopes.recorded.statistics import MeasuredSlopes, median
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.wavefront import certify, fit_wavefront
from faintspot.slopes.wavefront.figure import wavefront_figure
from faintspot.slopes.wavefront.files import certificate_table, remarks

_TEXT = Texts("faintspot.slopes.recorded")
NO_LAYOUT = "Not drawn: the layout of the sub-apertures is not known."
_KNOWN = 0.1  # standard error of a relative gain above which it counts as unknown
_DIFFERENT = 0.05  # difference of centroid gains that is worth a warning
_SURELY = 3.0  # standard errors
_MOST_LISTED = 20


@dataclass(frozen=True)
class SlopesRun:
    """Slopes of frames that were measured in one or several ways.

    Parameters
    ----------
    methods : sequence of MeasuredSlopes
        Others are compared with the last one; methods with frames of their own are each taken by themselves.
    layout : Layout or None
        None leaves the maps out, which the page says.
    shown : Example, Followed or str
        Frame of the pictures, or why there is none; "" leaves it out.
    truth : array (n_frames, n_subapertures, 2), optional
        True x, y, px from each sub-aperture's centre. Then no wavefront is fitted.
    unit : str
        Unit of the flux: "ADU" where the camera's gain is unknown.
    """

    methods: Sequence[MeasuredSlopes]
    layout: Layout | None
    shown: pictures.Example | pictures.Followed | str = ""
    truth: Floats | None = None
    unit: str = "e-"

    @cached_property
    def same_frames(self) -> bool:
        """Whether all methods have the same frames."""
        return all(np.array_equal(method.number, self.methods[0].number) for method in self.methods)

    @cached_property
    def valid(self) -> list[NDArray[np.bool_]]:
        """Compared measurements of each method: those valid in every method of the same frames."""
        valid = [method.valid for method in self.methods]
        return [np.logical_and.reduce(valid)] * len(valid) if self.same_frames else valid

    @cached_property
    def jitters(self) -> list[Floats]:
        """Jitter of each sub-aperture by method, px."""
        return [statistics.jitter(*pair) for pair in zip(self.methods, self.valid, strict=True)]

    @cached_property
    def noise_px(self) -> list[Floats]:
        """Noise of each sub-aperture by method, from consecutive frames; NaN where there are none."""
        return [statistics.frame_to_frame_noise(*pair) for pair in zip(self.methods, self.valid, strict=True)]

    @cached_property
    def gains(self) -> list[Estimate]:
        """Centroid gain of each method relative to the last one; NaN where it is not known."""
        last, valid = self.methods[-1], self.valid[-1]
        if len(self.methods) == 1 or not self.same_frames:
            return [UNKNOWN] * len(self.methods)
        gains = [statistics.relative_gain(method, last, valid) for method in self.methods]
        return [gain if gain.standard_error < _KNOWN else UNKNOWN for gain in gains]

    def equal_noise_px(self, index: int) -> Floats:
        """Return the noise of a method at the gain of the last one."""
        equal: Floats = self.noise_px[index] / self.gains[index].value
        return equal

    def verdict(self) -> str:
        """Name the method with the least noise at equal gain, if the errors allow it."""
        levels = [median(self.equal_noise_px(index)) for index in range(len(self.methods))]
        if len(levels) < 2 or self.methods[0].n_frames < 2:
            return ""
        if not np.isfinite(levels).all():
            return str(_TEXT["numbers.unknown_gain"])
        best, second = np.argsort(levels)[:2]
        difference = self.equal_noise_px(second) - self.equal_noise_px(best)
        difference = difference[np.isfinite(difference)]
        size, error = float(difference.mean()), float(difference.std() / max(len(difference) - 1, 1) ** 0.5)
        for method, other in ((best, second), (second, best)):
            gain = self.gains[method]
            error = float(np.hypot(error, levels[other] * gain.standard_error / gain.value))
        names = {"best": self.methods[best].name, "second": self.methods[second].name}
        if len(difference) < 2 or size < _SURELY * error:
            return _TEXT("numbers.equal", **names)
        return _TEXT("numbers.least", **names, size=size, error=error)


def slopes_report(
    run: SlopesRun,
    *,
    title: str,
    facts: Mapping[str, str],
    configurations: Mapping[str, str],
    warnings: Sequence[str] = (),
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
    """
    n_frames, n = run.methods[0].slopes.x.shape
    return Report(
        title=title,
        facts={**facts, "Frames": str(n_frames), "Sub-apertures": _sensor_in_words(n, run.layout)},
        sections=[
            *slopes_sections(run),
            *(configuration_section(text, name) for name, text in configurations.items()),
        ],
        warnings=[*warnings, *warnings_in_words(run)],
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
    last, lines = run.methods[-1].name, list[str]()
    for method, gain in zip(run.methods, run.gains, strict=True):
        if abs(gain.value - 1) > max(_DIFFERENT, _SURELY * gain.standard_error):
            lines.append(_TEXT("numbers.different_gain", gain, name=method.name, last=last))
    for method in run.methods:
        prefix = f"{method.name}: " if len(run.methods) > 1 else ""
        lines += [prefix + line for line in _of_method(method)]
    if run.methods[0].n_frames == 1:
        lines.append(_TEXT["warnings.one_frame"])
    if np.ptp([method.valid.mean() for method in run.methods]) > 0.01:
        lines.append(_TEXT["warnings.not_alike"])
    return lines


def _of_method(method: MeasuredSlopes) -> list[str]:
    lines = [] if method.valid.any() else [_TEXT["warnings.none_valid"]]
    _, left_out = leave_out(method.slopes.flags, method.slopes.keep)
    lines += [f"{left_out.capitalize()}."] if left_out else []
    for flag, (most, advice) in _TEXT["advice"].items():
        fraction = method.flag_count(SubapertureFlag[flag]) / method.valid.size
        if fraction > most:
            lines.append(f"{percentage(fraction)} of the measurements {advice}")
    never = np.flatnonzero(method.valid_frames == 0)
    if 0 < len(never) < method.n_subapertures:
        listed = ", ".join(map(str, never[:_MOST_LISTED])) + (", ..." if len(never) > _MOST_LISTED else "")
        counts = {"count": len(never), "all": method.n_subapertures, "listed": listed}
        lines.append(_TEXT("warnings.never_valid", **counts))
    return lines


def _key_numbers(run: SlopesRun) -> Section:
    """Return the table of all methods: errors where the truth is known, noise, and the rest."""
    records = [method_numbers(run, index) for index in range(len(run.methods))]
    table = _TEXT.table("numbers", records, last=run.methods[-1].name, together=len(records) > 1)
    if run.truth is None:
        return _TEXT.section("numbers", run.verdict(), table)
    values = {"low": run.truth.min(), "high": run.truth.max(), "count": np.count_nonzero(run.valid[-1])}
    return _TEXT.section("numbers", _TEXT("numbers.truth", values), table)


def method_numbers(run: SlopesRun, index: int) -> dict[str, object]:
    """Return the numbers of a method; None where they say nothing."""
    method, gain, noise = run.methods[index], run.gains[index], median(run.noise_px[index])
    error = centroid_gain = None
    if run.truth is not None:
        error, centroid_gain = statistics.slope_error(method, run.truth, run.valid[-1])
    ranked = run.truth is None and any(np.isfinite(other.value) for other in run.gains[:-1])
    scale = None if run.layout is None else run.layout.pixel_scale_arcsec
    return {
        "method": method.name,
        "error": error,
        "gain": centroid_gain,
        "noise": noise,
        "noise_arcsec": None if scale is None else noise * scale,
        "relative_gain": (gain if gain.standard_error else Estimate(1.0)) if ranked else None,
        "noise_at_equal_gain": median(run.equal_noise_px(index)) if ranked else None,
        "stated_error": method.stated_error_px,
        "jitter": median(run.jitters[index]),
        "valid": float(method.valid.mean()),
        "flux": method.median_flux_e,
        "unit": run.unit,
    }


def _frame(run: SlopesRun) -> list[Section]:
    if isinstance(run.shown, str):
        return [_TEXT.section("frame", missing=run.shown)] if run.shown else []
    if isinstance(run.shown, pictures.Followed):
        figure, largest = pictures.followed_figure(run.shown), run.shown.largest_pitches
        return [_TEXT.section("followed", figure, largest=largest)]
    return [_TEXT.section("frame", pictures.sensor_figure(run.shown), pictures.steps_figure(run.shown))]


def _flux(run: SlopesRun) -> Section:
    rows = []
    for name, meaning in _TEXT["flags"].items():
        counts = [method.flag_count(SubapertureFlag[name]) for method in run.methods]
        if any(counts):
            pairs = zip(counts, run.methods, strict=True)
            cells = [f"{count} ({percentage(count / method.valid.size)})" for count, method in pairs]
            rows.append([name, *cells, meaning])
    table = _TEXT.table("flux.flags", rows, [*(method.name for method in run.methods), "meaning"])
    if run.layout is None:
        return _TEXT.section("flux", table, missing=NO_LAYOUT)
    return _TEXT.section("flux", table, pictures.maps_figure(run.methods, run.jitters, run.layout, run.unit))


def _slopes(run: SlopesRun) -> Section:
    if run.layout is None:
        return _TEXT.section("slopes", missing=NO_LAYOUT)
    return _TEXT.section("slopes", pictures.arrows_figure(run.methods, run.layout))


def _wavefront(run: SlopesRun) -> list[Section]:
    """Return the section with the wavefronts fitted to the slopes of each method; none without a layout."""
    if run.layout is None or run.truth is not None:
        return []
    parts: list[Part] = []
    text, missing = [_TEXT["wavefront.about"]], []
    for number, method in enumerate(run.methods):
        try:
            wavefront = fit_wavefront(method.slopes, run.layout)
        except InputError as error:
            missing.append(f"Wavefront of {method.name!r}: {error}.")
            continue
        text += [line for line in remarks(wavefront) if line not in text]
        figure = wavefront_figure(wavefront, run.layout, method.name, file=f"wavefront-{number + 1}")
        parts += [Table(*certificate_table(certify(wavefront), wavefront.unit), method.name), figure]
    return [Section("wavefront", "Wavefront", [*text, *parts], " ".join(missing))]
