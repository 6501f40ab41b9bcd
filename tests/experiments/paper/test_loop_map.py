"""Where denoising pays in a loop: winners and gains of cells, and what each cell simulates."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.experiments.result_cases import result_of

from faintspot.base.report.page import Table
from faintspot.experiments.closed_loop.results import MagnitudeResult
from faintspot.experiments.paper import loop_map
from faintspot.experiments.paper.loop_map import METHODS, R0_M, cells_of, loop_map_page, run_loop_map
from faintspot.loop.simulation.configuration import LoopConfiguration

FLUXES = np.array([10.0, 100.0])
SCATTER = np.array([-0.02, 0.01, 0.0, 0.01])  # of the turbulence, common to all methods


def result(*means: tuple[float, float]) -> MagnitudeResult:
    """Strehl ratios of `METHODS` at both fluxes, which differ only by 0.001 between realisations."""
    own = 0.001 * np.array([[1, -1, 1, -1], [1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, -1, 1], [-1, -1, 1, 1]])
    strehl = np.array(means)[:, :, None] + SCATTER + own[:, None]
    return result_of(METHODS, FLUXES, strehl)


def test_a_winner_is_above_all_others_and_the_gain_of_tv_is_paired() -> None:
    found = result((0.1, 0.4), (0.12, 0.39), (0.1, 0.4), (0.1, 0.4), (0.2, 0.4))
    faint, bright = cells_of(found, 0.18, "3 e-")
    assert (faint.r0_m, faint.camera, faint.photons, bright.photons) == (0.18, "3 e-", 10, 100)
    assert (faint.winner, bright.winner) == ("map", "")
    assert [faint.strehl["map"].value, bright.strehl["tv"].value] == pytest.approx([0.2, 0.39])
    # Own deviations of the two differ by 0, 2, -2 and 0 thousandths: 0.00163 between realisations.
    assert faint.gain.value == pytest.approx(0.02)
    assert faint.gain.standard_error == pytest.approx(0.00163 / 2, rel=0.01)
    assert (faint.gain.decided, bright.gain.decided) == (1, -1)


def test_the_page_counts_winners_and_has_every_number() -> None:
    pytest.importorskip("matplotlib")
    cells = [
        cell
        for r0 in R0_M
        for cell in cells_of(result((0.1, 0.4), (0.12, 0.39), (0.1, 0.4), (0.1, 0.4), (0.2, 0.4)), r0, "3 e-")
    ]
    (section,) = loop_map_page(cells).sections
    assert "in 2 of 4 cells and lowers it in 2" in str(section.parts[0])
    assert "maximum a posteriori in 2" in str(section.parts[0]).replace("with a prior on the position", "")
    (table,) = (part for part in section.parts if isinstance(part, Table))
    assert len(table.rows) == 4
    assert all(len(row) == len(table.header) for row in table.rows)


def test_every_cell_simulates_its_own_turbulence_and_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated: list[tuple[Any, ...]] = []

    def run_magnitude(
        loop: LoopConfiguration, folder: Path, methods: object, *_: object, **__: object
    ) -> Any:
        camera = loop.camera
        simulated.append((loop.atmosphere.r0_m, camera.read_noise_e / camera.em_gain, folder))
        return result(*[(0.1, 0.2)] * 5)

    monkeypatch.setattr(loop_map, "run_magnitude", run_magnitude)
    cells = run_loop_map(tmp_path / "map", quick=True)
    assert len(cells) == 2 * len(simulated) == 20
    assert [row[:2] for row in simulated] == [
        (r0, noise) for r0 in R0_M for noise in (0.1, 1.0, 3.0, 16.0, 0.1)
    ]
    assert len({row[2] for row in simulated}) == 10
