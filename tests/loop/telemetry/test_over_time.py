"""Turbulence against time."""

import csv
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.loop.telemetry.loop_cases import AIR, RATE_HZ, recorded
from tests.refusals import refused

from faintspot.base.errors import InputError
from faintspot.loop.control.identification.open_loop import Measured
from faintspot.loop.control.identification.recording import Recording
from faintspot.loop.telemetry import page as over_time
from faintspot.loop.telemetry.page import Piece, page_of_loop, table_of_pieces, turbulence_over_time
from faintspot.loop.telemetry.report import report_of_loop


def opened(frames: int) -> Any:
    """Slopes of the turbulence without a loop; frames 400 to 800 were lost."""
    loop: Any = recorded()
    mirror = np.zeros_like(loop.slopes)
    mirror[2:] = (loop.commands @ loop.interaction_matrix.T)[:-2]
    seen = (loop.slopes - mirror)[:frames]
    kept = np.r_[0:400, 800:frames]
    return replace(
        loop, slopes=seen[kept], frame=kept, commands=None, interaction_matrix=None, is_closed=False
    )


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn_pictures")
def test_pieces_of_an_open_loop() -> None:
    """r0 of each piece within three errors, also of one that lost half of its frames."""
    loop = opened(1600)
    progress: list[tuple[int, int]] = []
    pieces = turbulence_over_time(loop, 400 * 1.99 / RATE_HZ, lambda *counts: progress.append(counts))
    assert progress == [(1, 2), (2, 2)]
    assert [piece.start_s for piece in pieces] == pytest.approx([0.0, 796 / RATE_HZ])
    for piece in pieces:
        r0 = piece.values["r0 at 500 nm"]
        assert abs(r0.value - AIR.r0_m) < 3 * r0.error < 0.15
        assert not piece.missing
    rows = list(csv.DictReader(table_of_pieces(pieces).splitlines()))
    for piece, row in zip(pieces, rows, strict=True):
        written = float(row["start_s"]), float(row["r0 at 500 nm (m)"])
        assert written == pytest.approx((piece.start_s, piece.values["r0 at 500 nm"].value), rel=1e-4)
    page = page_of_loop(report_of_loop(loop.part(slice(0, 200)), compare=False), pieces).html()
    assert "Against time" in page


def test_pieces_are_all_whole_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[int]] = []

    def report(part: Recording, **_: object) -> None:
        seen.append([part.frame[0], part.frame[-1]])
        raise InputError("not fitted")

    monkeypatch.setattr(over_time, "report_of_loop", report)
    for rate_hz, every_s, frames, rest in ((400.0, 1.1, 440, 0), (500.0, 0.8, 400, 399)):
        seen.clear()
        slopes = np.zeros((3 * frames + rest, 50))
        loop = replace(recorded(), slopes=slopes, frame=7 + np.arange(len(slopes)), commands=None)
        pieces = turbulence_over_time(replace(loop, frame_rate_hz=rate_hz), every_s)
        assert [piece.start_s for piece in pieces] == pytest.approx([0.0, every_s, 2 * every_s])
        assert seen == [[7 + start, 6 + start + frames] for start in (0, frames, 2 * frames)]
    for every_s in (0.1, 1000.0):
        with refused(f"every_s = {every_s:g}"):
            turbulence_over_time(opened(2400), every_s)


def test_table_of_pieces() -> None:
    pieces = [
        Piece(0.0, 2.5, {"r0": Measured("r0", "m", 0.1, 0.02)}),
        Piece(2.5, 2.5, {"noise": Measured("noise", "", 0.3)}, "no r0"),
    ]
    rows = list(csv.reader(table_of_pieces(pieces).splitlines()))
    assert rows == [
        ["start_s", "duration_s", "r0 (m)", "error of r0 (m)", "noise", "error of noise"],
        ["0", "2.5", "0.1", "0.02", "", ""],
        ["2.5", "2.5", "", "", "0.3", ""],
    ]
