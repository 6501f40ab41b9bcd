from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tests.experiments.result_cases import (
    BLOCK,
    CYCLES,
    STRENGTHS,
    made_up_interleaved,
    made_up_magnitude,
    small_interleaved,
)

from faintspot.base.errors import InputError
from faintspot.experiments.loop_analysis import (
    NO_TV,
    TV,
    TV_BEST,
    differences_by_flux,
    differences_by_strength,
    gains_in_magnitude,
    group_rows,
    measurements,
    paired_differences,
    regression_lines,
    seeing_of_sets,
)

pytest.importorskip("hcipy")


def test_every_measurement_is_a_row() -> None:
    result = small_interleaved()
    table = measurements(result)
    assert len(table.strehl) == 2 * CYCLES * len(STRENGTHS)
    assert table.frames.tolist() == [40] * len(table.frames)
    np.testing.assert_array_equal(table.method[:3], [0, 1, 2])
    record = result.records[0]
    assert table.strehl[1] == pytest.approx(record.strehl[BLOCK + 20 : 2 * BLOCK].mean())
    assert table.time_s[0] == pytest.approx(40 / record.frame_rate_hz)
    assert table.group(NO_TV).sum() == 2 * CYCLES
    np.testing.assert_array_equal(table.group(TV), table.group(TV_BEST))  # a strength of 0 is in none
    with pytest.raises(InputError, match="group"):
        table.group("some")


def test_r0_is_left_out_where_slopes_were_not_measured() -> None:
    result = small_interleaved()
    lost = dataclasses.replace(result.records[0], valid=np.zeros_like(result.records[0].valid))
    table = measurements(dataclasses.replace(result, records=(lost, result.records[1])))
    assert np.isnan(table.r0_m[table.set_number == 0]).all()
    assert np.isfinite(table.r0_m[table.set_number == 1]).all()
    rows = {row.group: row for row in group_rows(table, 0)}
    assert rows[TV].at_equal_r0 is None
    assert len(seeing_of_sets(dataclasses.replace(result, records=(lost, result.records[1])))) == 1


def test_measurements_without_frames_are_refused() -> None:
    with pytest.raises(InputError, match="no measurement has 20 frames"):
        measurements(dataclasses.replace(small_interleaved(), settle_in_block=BLOCK - 5))


@pytest.mark.parametrize("gain", [0.05, 0.0, -0.05])
def test_the_table_finds_what_was_put_in(gain: float) -> None:
    # The drift is straight, so that it cancels; after the last measurement without TV it does not.
    table = measurements(made_up_interleaved(gain))
    rows = {row.group: row for row in group_rows(table)}
    assert rows[NO_TV].difference is None
    found = rows[TV_BEST].difference
    assert found is not None
    assert found.value == pytest.approx(gain, abs=0.006)
    if gain:
        assert found.decided == np.sign(gain)
    (row,) = differences_by_strength(table)
    assert row.strength_e == pytest.approx(0.8)
    assert row.count == 2 * CYCLES
    assert row.difference.value == pytest.approx(gain, abs=0.006)
    assert np.isnan(paired_differences(table)[table.group(NO_TV)]).all()


def test_lines_are_drawn_for_groups_of_three() -> None:
    lines = regression_lines(measurements(small_interleaved()))
    assert set(lines) == {NO_TV, TV, TV_BEST}
    assert lines[NO_TV].count == 2 * CYCLES


def test_sets_have_an_r0_of_their_own() -> None:
    found = seeing_of_sets(small_interleaved())
    assert [item.set_name for item in found] == list(small_interleaved().set_names)
    for item in found:
        # Two seconds through a small telescope: a quarter is what so few wavefronts allow.
        assert item.seeing.r0_m == pytest.approx(item.true_r0_m, rel=0.25)
        assert item.with_tip_tilt.r0_kolmogorov_m > 1.2 * item.with_tip_tilt.r0_m


def test_gains_in_magnitude_are_those_of_the_curves() -> None:
    result = made_up_magnitude(0.3)
    gains = gains_in_magnitude(result, 1, 0)
    assert list(gains)[:2] == [0.05, 0.1]
    # Straight pieces between points 1 mag apart stand for a curve: a tenth of a magnitude.
    assert gains[0.3].value == pytest.approx(0.3, abs=0.1)
    assert gains[0.3].decided == 1


def test_differences_by_flux_are_paired() -> None:
    result = made_up_magnitude(0.3)
    for estimate, runs in zip(
        differences_by_flux(result, 1, 0), result.strehl[1] - result.strehl[0], strict=True
    ):
        assert estimate.value == pytest.approx(runs.mean())
        assert estimate.high - estimate.low < 0.02  # the air's 0.02 is common to both
