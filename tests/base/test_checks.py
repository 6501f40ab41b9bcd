from typing import Any

import numpy as np
import pytest
from tests.refusals import refused
from tests.slopes.estimators.image_cases import BAD_IMAGES

from faintspot.base import checks
from faintspot.base.errors import InputError


class TestRealArray:
    @pytest.mark.parametrize("dtype", ["i1", "u8", ">i4", "f2", ">f8", "f4", "g"])
    def test_real_array_is_returned_without_a_copy(self, dtype: str) -> None:
        array = np.ones((2, 2), dtype)
        assert checks.real_array("value", array) is array

    def test_bool_counts_as_integer(self) -> None:
        assert checks.real_array("value", [True, False]).tolist() == [1, 0]

    def test_nan_may_pass(self) -> None:
        assert np.isnan(checks.real_array("value", np.nan))
        with refused("value", "1 NaN or infinite of 1"):
            checks.finite_array("value", np.nan)

    def test_what_is_no_number_is_refused(self) -> None:
        for bad in ({}, object(), [None], [1, "a"], np.array([1, None]), b"abc", {1, 2}):
            with refused("value"):
                checks.real_array("value", bad)

    @pytest.mark.parametrize(
        ("given", "used"),
        [("u1", "f4"), ("i2", "f4"), ("u2", "f4"), ("i4", "f8"), ("f4", "f4"), ("f8", "f8"), ("?", "f4")],
    )
    def test_masked_values_are_nan(self, given: str, used: str) -> None:
        masked = np.ma.MaskedArray(np.ones((2, 2), given), mask=[[False, True], [False, False]])
        array = checks.real_array("value", masked)
        assert array.dtype == np.dtype(used)
        assert not isinstance(array, np.ma.MaskedArray)
        np.testing.assert_array_equal(array, [[1, np.nan], [1, 1]])
        with refused("value", "1 NaN or infinite of 4"):
            checks.finite_array("value", masked)

    def test_masked_array_without_masked_values(self) -> None:
        array = checks.real_array("value", np.ma.MaskedArray(np.ones((2, 2), "u2"), mask=False))
        assert array.dtype == np.uint16
        assert not isinstance(array, np.ma.MaskedArray)

    def test_masked_things_that_are_no_numbers(self) -> None:
        for dtype in ("c8", "U3", "M8[s]", "O"):
            with refused("value"):
                checks.real_array("value", np.ma.MaskedArray(np.zeros(2, dtype), mask=[True, False]))


class TestImageStack:
    @pytest.mark.parametrize(
        ("given", "used"),
        [("f2", "f4"), ("f4", "f4"), (">f4", "f4"), ("f8", "f8"), ("i2", "f8"), ("?", "f8")],
    )
    def test_stacks_keep_float32_and_make_others_float64(self, given: str, used: str) -> None:
        stack = checks.image_stack("images", np.ones((3, 2, 2), given))
        assert stack.dtype == np.dtype(used)
        assert stack.dtype.isnative

    def test_stacks_are_contiguous(self) -> None:
        array = np.arange(24.0).reshape(4, 6)[::2, ::-1]
        stack = checks.image_stack("images", array)
        assert stack.flags.c_contiguous
        assert np.array_equal(stack, array)

    def test_smallest_integer_has_a_magnitude(self) -> None:
        for value in (-(2**63), 2**63 - 1):
            assert checks.image_stack("images", np.full((2, 2), value))[0, 0] == float(value)

    @pytest.mark.parametrize(("bad", "words"), BAD_IMAGES)
    def test_image_stacks_of_wrong_values_are_refused(self, bad: Any, words: str) -> None:
        with refused("images", words):
            checks.image_stack("images", bad)


class TestNumbers:
    def test_ends_of_the_range(self) -> None:
        assert checks.numbers_between("value", [0, 1], 0.0, 1.0).tolist() == [0.0, 1.0]
        with refused("value = 0", "above 0 to 1"):
            checks.numbers_between("value", [0, 1], 0.0, 1.0, low_open=True)
        with refused("value = 0", "above 0"):
            checks.number_between("value", 0, 0.0, low_open=True)
        with refused("value = -1", "at least 0"):
            checks.number_between("value", -1, 0.0)
        with refused("value = 3", "up to 2"):
            checks.number_between("value", 3, high=2.0)

    def test_integers_are_whole_numbers_of_any_type(self) -> None:
        result = checks.numbers_between("value", [1.0, 2.0], integer=True)
        assert result.dtype == np.int64
        assert checks.number_between("value", np.uint8(7), integer=True) == 7.0
        with refused("value = 2.5", "whole number"):
            checks.numbers_between("value", [1, 2.5], integer=True)

    def test_arrays_are_not_one_number(self) -> None:
        for bad in ([1.0], [[1.0]], [1.0, 2.0]):
            with refused("value", "one number"):
                checks.number_between("value", bad)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, "1", None, 1j, [], {}, [[1], [1, 2]]])
    def test_numbers_that_are_none_are_refused(self, bad: Any) -> None:
        with refused("value"):
            checks.number_between("value", bad)


def test_errors_have_one_line() -> None:
    error = InputError("two\nlines", name="a", value="b\nc", where="d\ne")
    assert str(error) == "d e: a = 'b\\nc': two lines"


def test_one_of_returns_known_values_and_refuses_others() -> None:
    assert checks.one_of("colour", "red", ["red", "green"]) == "red"
    for bad in ("blue", None, 1, ["red"], "", "Red"):
        with refused("colour", "'red', 'green'"):
            checks.one_of("colour", bad, ["red", "green"])
