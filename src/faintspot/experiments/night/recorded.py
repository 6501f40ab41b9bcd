"""A night from the telemetry of a closed loop whose methods alternated; its page, numbers and text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.report.page import Report, Section
from faintspot.base.report.texts import Texts
from faintspot.base.statistics import Estimate
from faintspot.experiments.night.analysis import Difference, differences
from faintspot.experiments.night.page import (
    night_page,
    night_summary,
    night_summary_text,
    plain,
    plain_record,
)
from faintspot.experiments.night.protocol import Night
from faintspot.experiments.night.recorded_methods import MeasuredStrehl, RecordedMethods, conditions_of
from faintspot.experiments.night.simulated import r0_of_slopes
from faintspot.io.telemetry import CLOSED_LOOP, Telemetry, read_telemetry
from faintspot.loop.control.configuration import RecordedControl
from faintspot.loop.telemetry.alternation import (
    AlternatingLoop,
    RelativeGains,
    Turn,
    TurnPhase,
    open_loop_slopes,
    phase_of_turn,
    relative_gains,
    turns_of,
)
from faintspot.loop.telemetry.choices import unseen_m2
from faintspot.loop.telemetry.recorded_loop import control_of, frame_rate, system_numbers
from faintspot.slopes.sensor.pupil import side_m

SCIENCE_WAVELENGTH_M = 1.65e-6
_MOST_BLOCKS = 400  # of a night: the analysis compares each with all others
_FRAMES_OF_R0 = 500  # of the turns of all methods
_FEWEST_TURNS = 5  # of each method


@dataclass(frozen=True, eq=False)
class RecordedNight:
    """A night with how its blocks were made."""

    night: Night
    methods: RecordedMethods
    gains: RelativeGains
    settle_frames: tuple[int, ...]
    """(methods,): frames at the beginning of a turn that are not scored."""
    turns: int
    turns_in_block: int
    is_measured: bool
    """Whether Strehl ratios were measured, not estimated from slopes."""
    shared_phase_error_rad2: Floats
    """(B,): as `Night.shared_error`, of the residual phase."""


def alternates(path: str | Path) -> bool:
    """Return whether a store holds telemetry of several methods that alternated in a closed loop."""
    telemetry = read_telemetry(path, images=False)
    return len(np.unique(telemetry.method[telemetry.loop == CLOSED_LOOP])) > 1


def recorded_night(
    path: str | Path,
    *,
    configuration: str | Path | None = None,
    system: str | Path | None = None,
    strehl: MeasuredStrehl | None = None,
    settle_frames: int | None = None,
) -> RecordedNight:
    """Return the night of a recording of `faintspot realtime record`.

    Parameters
    ----------
    path : path
    configuration : path, optional
        faintspot.toml with [control]. Default: as recorded.
    system : path, optional
        TOML with sizes that the recording lacks, or that replace its own.
    strehl : MeasuredStrehl, optional
        Default: Strehl ratios are estimated from slopes.
    settle_frames : int, optional
        Frames at the beginning of each turn that are not scored. Default: `RecordedMethods.settle_frames`.

    Raises
    ------
    InputError
        When the loop was not closed with several methods, turns are too short, no exposure is within one, or
        control or sizes are not known.
    """
    if settle_frames is not None:
        settle_frames = int(number_between("settle_frames", settle_frames, 1, integer=True))
    telemetry = read_telemetry(path, images=False)
    try:
        control = control_of(telemetry.attributes, configuration)
        if control is None:
            raise InputError("control: not recorded; give the engine's configuration with --config")
        methods = RecordedMethods.of(telemetry, control)
        values = {} if system is None else system_numbers(Path(system))
        loop = _loop(telemetry, control, methods, values)
        wavelength_m = values.get("science_wavelength_m", SCIENCE_WAVELENGTH_M)
        return _night(loop, telemetry, methods, strehl, settle_frames, str(path), wavelength_m)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _loop(
    telemetry: Telemetry, control: RecordedControl, methods: RecordedMethods, values: Mapping[str, float]
) -> AlternatingLoop:
    layout = telemetry.attributes["layout"]
    known: dict[str, float | None] = {
        **{name: layout.get(name) for name in ("pixel_scale_arcsec", "subaperture_m", "diameter_m")},
        **values,
    }
    cells = np.asarray(layout["cells"], np.int64)
    side = side_m(cells, known["subaperture_m"], known["diameter_m"], telemetry.flags)
    scale = known["pixel_scale_arcsec"]
    if side is None or scale is None:
        missing = "pixel_scale_arcsec" if side is not None else "subaperture_m or diameter_m"
        raise InputError(f"{missing}: unknown; give it in a TOML file with --system")
    if control.interaction.shape != (telemetry.slopes.shape[1], telemetry.commands.shape[1]):
        raise InputError(
            f"interaction_matrix: expected shape {(telemetry.slopes.shape[1], telemetry.commands.shape[1])}, "
            f"got {control.interaction.shape}"
        )
    return AlternatingLoop(
        np.where(np.tile(telemetry.valid, 2), telemetry.slopes, np.nan),
        telemetry.commands,
        control.interaction,
        cells,
        frame_rate(telemetry.unix_time_s, telemetry.frame),
        frame=telemetry.frame,
        time_s=telemetry.unix_time_s,
        method=np.where(telemetry.loop == CLOSED_LOOP, methods.number[telemetry.method], -1),
        conditions=conditions_of(telemetry)[0],
        delay_frames=control.options.delay_frames,
        subaperture_m=side,
        pixel_scale_arcsec=scale,
        outer_scale_m=values.get("outer_scale_m"),
    )


def _night(
    loop: AlternatingLoop,
    telemetry: Telemetry,
    methods: RecordedMethods,
    strehl: MeasuredStrehl | None,
    settle_frames: int | None,
    source: str,
    wavelength_m: float,
) -> RecordedNight:
    settle = [frames if settle_frames is None else settle_frames for frames in methods.settle_frames]
    turns = turns_of(loop, settle)
    _check(turns, methods, settle)
    relative = relative_gains(loop, turns, methods.groups, methods.reference)
    gains = methods.centroid_gain * relative.gain / math.exp(float(np.log(relative.gain).mean()))
    found = [_Scored.of(loop, turn, float(gains[turn.method]), strehl) for turn in turns]
    kept = [scored for scored in found if scored is not None]
    if not kept:
        raise InputError("slopes: expected half of them measured in some turns, found none")
    if strehl is not None and not any(len(scored.strehl) for scored in kept):
        longest = max(loop.time_s[turn.end - 1] - loop.time_s[turn.scored] for turn in turns)
        raise InputError(
            f"--strehl: no exposure lies within the {longest:.3g} s or less of a turn that are scored; "
            "expected shorter exposures, longer turns (--every) or Unix times"
        )
    together = _cycles_together(kept)
    begin_s = float(loop.time_s[turns[0].scored])
    columns = []
    for parts in _groups(kept, methods.reference, together):
        # Of all methods' turns together, so that no method passes for better seeing.
        turns_of_group = [scored.turn for part in parts for scored in part]
        atmosphere, residual, run = open_loop_slopes(loop, turns_of_group, gains.tolist())
        r0 = r0_of_slopes(atmosphere, residual, loop.site, loop.outer_scale_m, run=run)
        columns += [
            _column(loop, part, r0, relative, wavelength_m, begin_s, strehl is not None) for part in parts
        ]
    arrays: dict[str, Any] = {name: np.array([column[name] for column in columns]) for name in columns[0]}
    shared_phase = arrays.pop("shared_phase")
    conditions, numbers = np.unique(arrays.pop("conditions"), return_inverse=True)
    unknown = np.full(len(columns), math.nan)
    night = Night(
        labels=methods.labels,
        settings=methods.settings,
        reference=methods.reference,
        set_names=tuple(conditions_of(telemetry)[1][number] for number in conditions),
        set_number=numbers,
        strength=np.array(methods.strength_e)[arrays["method"]],
        true_r0_m=unknown,
        paired_strehl=unknown,
        overhead_s=together * float(np.mean(settle)) / loop.frame_rate_hz,
        wavelength_m=wavelength_m,
        source=source,
        configuration="",
        **arrays,
    )
    made = len(kept), together, strehl is not None, shared_phase
    return RecordedNight(night, methods, relative, tuple(settle), *made)


def _check(turns: Sequence[Turn], methods: RecordedMethods, settle: Sequence[int]) -> None:
    """Refuse a recording without a few turns of each method."""
    for number, label in enumerate(methods.labels):
        count = sum(turn.method == number for turn in turns)
        if count < _FEWEST_TURNS:
            raise InputError(
                f"{label}: {count} turns with enough frames after the first {settle[number]}, expected "
                f"{_FEWEST_TURNS}; record longer, or alternate with a larger --every"
            )


@dataclass(frozen=True, eq=False)
class _Scored:
    """A turn with its measured values."""

    turn: Turn
    phase: TurnPhase
    strehl: Floats
    """Strehl ratios of the exposures within it."""

    @classmethod
    def of(
        cls, loop: AlternatingLoop, turn: Turn, gain: float, strehl: MeasuredStrehl | None
    ) -> _Scored | None:
        phase = phase_of_turn(loop, turn, gain)
        if phase is None:
            return None
        exposures = np.zeros(0)
        if strehl is not None:
            # The last row of a frame arrives up to a frame time after its exposure.
            frame_s = 1 / loop.frame_rate_hz
            begin_s, end_s = loop.time_s[turn.scored] - 2 * frame_s, loop.time_s[turn.end - 1]
            exposures = strehl.of_interval(float(begin_s), float(end_s))
        return cls(turn, phase, exposures)


def _cycles_together(scored: Sequence[_Scored]) -> int:
    """Return how many cycles make a block of each method: enough frames for r0, and not too many blocks."""
    cycles = int(np.unique([each.turn.method for each in scored], return_counts=True)[1].min())
    frames = sum(each.turn.end - each.turn.begin for each in scored)
    together = max(math.ceil(len(scored) / _MOST_BLOCKS), math.ceil(_FRAMES_OF_R0 * cycles / frames))
    return max(1, min(together, cycles // _FEWEST_TURNS))


def _groups(scored: Sequence[_Scored], reference: int, together: int) -> list[list[list[_Scored]]]:
    """Return the turns of neighbouring cycles, by method, the reference first.

    A cycle begins with each turn of the reference, and with other conditions.
    """
    cycles: dict[int, int] = {}
    groups: dict[tuple[int, int], dict[int, list[_Scored]]] = {}
    for each in scored:
        conditions = each.turn.conditions
        begins = each.turn.method == reference or conditions not in cycles
        cycles[conditions] = cycles.get(conditions, -1) + begins
        group = groups.setdefault((conditions, cycles[conditions] // together), {})
        group.setdefault(each.turn.method, []).append(each)
    return [
        [group[method] for method in sorted(group, key=lambda number: (number != reference, number))]
        for group in groups.values()
    ]


def _column(
    loop: AlternatingLoop,
    block: Sequence[_Scored],
    r0: tuple[float, float],
    relative: RelativeGains,
    wavelength_m: float,
    begin_s: float,
    is_measured: bool,
) -> dict[str, float]:
    """Return the values of a block by their names in `Night`."""
    method, wave = block[0].turn.method, (2 * math.pi / wavelength_m) ** 2
    turns = [scored.turn for scored in block]
    frames = np.array([turn.end - turn.scored for turn in turns])
    variance = np.array([scored.phase.variance_m2 for scored in block])
    residual = float(frames @ variance / frames.sum())
    error = float(
        np.sqrt(np.square(frames * [scored.phase.error_m2 for scored in block]).sum()) / frames.sum()
    )
    phase = wave * (residual + unseen_m2(loop.site.subaperture_m, r0[0]))
    middles = [float(loop.time_s[turn.scored : turn.end].mean()) for turn in turns]
    duration = float(frames.sum()) / loop.frame_rate_hz
    relative_error = float(relative.error[method] / relative.gain[method])
    of_gain = 2 * wave * max(residual, 0.0) * (relative_error if math.isfinite(relative_error) else 0.0)
    values = {
        "method": method,
        "conditions": block[0].turn.conditions,
        "start_s": float(np.average(middles, weights=frames)) - begin_s - duration / 2,
        "duration_s": duration,
        "phase_rad2": phase,
        "phase_error_rad2": wave * error,
        "r0_m": r0[0],
        "r0_error_m": r0[1],
        "shared_phase": of_gain,
    }
    if is_measured:
        exposures = np.concatenate([scored.strehl for scored in block])
        few = len(exposures) < 2
        mean = float(exposures.mean()) if len(exposures) else math.nan
        spread = math.nan if few else float(exposures.std(ddof=1)) / math.sqrt(len(exposures))
        return {**values, "strehl": mean, "strehl_error": spread, "shared_error": 0.0}
    ratio = math.exp(-phase) if math.isfinite(phase) else math.nan
    return {**values, "strehl": ratio, "strehl_error": ratio * wave * error, "shared_error": ratio * of_gain}


_TEXT = Texts("faintspot.experiments.night")


def page_of_recording(recorded: RecordedNight) -> Report:
    """Return the page of a night, with its residual phase and how its blocks were made."""
    night, page = recorded.night, night_page(recorded.night)
    phase = _TEXT.table("phase", phase_differences(recorded), reference=night.labels[night.reference])
    sections = [*page.sections, _TEXT.section("phase", phase), _blocks_section(recorded)]
    return replace(page, sections=sections)


def summary_of_recording(recorded: RecordedNight) -> dict[str, object]:
    """Return the numbers of the page as plain values for JSON; null is not known."""
    night, gains = recorded.night, recorded.gains
    return {
        **night_summary(night),
        "strehl": "measured" if recorded.is_measured else "estimated from slopes",
        "phase_rad2": [plain_record(each, ("name", "measured")) for each in phase_differences(recorded)],
        "centroid_gain_of_control": recorded.methods.centroid_gain,
        "relative_centroid_gain": {
            label: {"value": plain(gain), "standard_error": plain(error)}
            for label, gain, error in zip(
                night.labels, gains.gain.tolist(), gains.error.tolist(), strict=True
            )
        },
        "settle_frames": dict(zip(night.labels, recorded.settle_frames, strict=True)),
        "turns": recorded.turns,
        "cycles_in_block": recorded.turns_in_block,
        "remarks": _remarks(recorded),
    }


def text_of_recording(recorded: RecordedNight) -> str:
    """Return verdicts and differences, and what a reader must know of them, as lines of text."""
    return "\n".join([night_summary_text(recorded.night), *_remarks(recorded)])


def phase_differences(recorded: RecordedNight) -> list[Difference]:
    """Return the residual phase variance of each group minus that of the reference [rad^2]."""
    night = recorded.night
    return differences(replace(night, strehl=night.phase_rad2, shared_error=recorded.shared_phase_error_rad2))


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
        leaning=", ".join(recorded.methods.leaning) or None,
    )
