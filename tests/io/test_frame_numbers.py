"""Numbers that are missing, and sources that begin anew."""

from itertools import pairwise

import numpy as np

from faintspot.io.frame_numbers import LARGEST_GAP, all_left_out, left_out

NUMBERS = [0, 1, 4, 4, 2, 3, LARGEST_GAP + 4, 2 * LARGEST_GAP + 6, 2**63 - 1, 0, 1]
EXPECTED = [0, 2, -1, -1, 0, LARGEST_GAP, -1, -1, -1, 0]


def test_what_is_missing_between_two_numbers() -> None:
    assert [left_out(*both) for both in pairwise(NUMBERS)] == EXPECTED


def test_an_array_gives_the_same() -> None:
    np.testing.assert_array_equal(all_left_out(NUMBERS), EXPECTED)
    assert all_left_out(NUMBERS[:1]).shape == (0,)
