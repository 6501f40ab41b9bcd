"""Turbulence against time: the report of each piece of a recording."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from faintspot.base.checks import number_between
from faintspot.base.errors import InputError
from faintspot.base.files import csv_text
from faintspot.loop.control.identification.open_loop import FEWEST_FRAMES, Measured
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.telemetry.report import report_of_loop

_PARTS = ("noise", "turbulence")
_OF_ONE = "layer "
"""Start of names that not every piece has."""


@dataclass(frozen=True)
class Piece:
    """Piece of a recording."""

    start_s: float
    """From the first frame of the recording."""
    duration_s: float
    values: dict[str, Measured]
    """By name; layers are left out, as their number changes."""
    missing: str = ""
    """Reason for missing values."""


def turbulence_over_time(
    loop: Recording, every_s: float, progress: Callable[[int, int], None] = lambda *_: None
) -> list[Piece]:
    """Return noise and turbulence of each piece of a recording.

    Parameters
    ----------
    loop : Recording
    every_s : float
        Length of a piece; a shorter rest at the end is left out.
    progress : callable
        Called with the number of finished pieces and of all.

    Raises
    ------
    InputError
        When a piece is too short, or the recording shorter than one.
    """
    fewest_s = 2 * FEWEST_FRAMES / loop.frame_rate_hz
    # 1.1 s of 400 frames each are 440 frames, without the error of rounding.
    length = round(number_between("every_s", every_s, fewest_s) * loop.frame_rate_hz, 6)
    since = loop.frame - loop.frame[0]
    count = int((since[-1] + 1) / length)
    if count < 1:
        duration = (since[-1] + 1) / loop.frame_rate_hz
        raise InputError(f"every_s = {every_s:g}: expected at most the recording's {duration:g} s")
    pieces = []
    for number in range(count):
        rows = slice(*np.searchsorted(since, [number * length, (number + 1) * length]))
        pieces.append(_piece(loop, rows, number * every_s, every_s))
        progress(number + 1, count)
    return pieces


def table_of_pieces(pieces: Sequence[Piece]) -> str:
    """Return a CSV table: a row for each piece, with value and standard error of each quantity."""
    names = {name: value.unit for piece in pieces for name, value in piece.values.items()}
    header = [f"{name} ({unit})" if unit else name for name, unit in names.items()]
    rows = []
    for piece in pieces:
        known = [piece.values.get(name, Measured(name, "")) for name in names]
        numbers = [number for value in known for number in (value.value, value.error)]
        shown = [f"{number:.6g}" if math.isfinite(number) else "" for number in numbers]
        rows.append([f"{piece.start_s:g}", f"{piece.duration_s:g}", *shown])
    columns = (f"{kind}{text}" for text in header for kind in ("", "error of "))
    return csv_text(["start_s", "duration_s", *columns], rows)


def _piece(loop: Recording, rows: slice, start_s: float, duration_s: float) -> Piece:
    if rows.stop - rows.start < FEWEST_FRAMES:
        return Piece(start_s, duration_s, {}, f"{rows.stop - rows.start} frames, expected {FEWEST_FRAMES}")
    try:
        report = report_of_loop(loop.part(rows), compare=False)
    except InputError as error:
        return Piece(start_s, duration_s, {}, str(error))
    parts = [report.parts[name] for name in _PARTS]
    values = [value for part in parts for value in part.values if not value.name.startswith(_OF_ONE)]
    missing = " ".join(part.missing for part in parts if part.missing)
    return Piece(start_s, duration_s, {value.name: value for value in values}, missing)
