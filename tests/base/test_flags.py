"""Which slopes are left out, and the line that says so."""

import numpy as np

from faintspot.base.flags import NO_FLAG, SubapertureFlag, are_valid, leave_out

DARK, LIMITED = SubapertureFlag.NO_FLUX, SubapertureFlag.AT_SEARCH_LIMIT
FLAGS = np.array([[DARK, LIMITED, 0, 8], [DARK, 0, 0, 64]], np.uint8)


def test_line_counts_subapertures_and_slopes() -> None:
    for flags, keep, line in (
        (FLAGS, NO_FLAG, "left out 1 of 4 sub-apertures, 1 slope of others: dark, limited"),
        (FLAGS, LIMITED, "left out 1 of 4 sub-apertures: dark"),
        (FLAGS[0], NO_FLAG, "left out 2 of 4 sub-apertures: dark, limited"),
        (FLAGS[:, 1:], NO_FLAG, "left out 1 slope of 6: limited"),
        (FLAGS[:, 2:], NO_FLAG, ""),
    ):
        valid, said = leave_out(flags, keep)
        assert said == line
        np.testing.assert_array_equal(valid, are_valid(flags, keep))


def test_other_causes_are_left_out_and_counted() -> None:
    cut = np.array([False, False, True, False])
    valid, line = leave_out(FLAGS, others={"outside the pupil": cut})
    assert line == "left out 2 of 4 sub-apertures, 1 slope of others: dark, outside the pupil, limited"
    np.testing.assert_array_equal(valid, [[False, False, False, True], [False, True, False, True]])
