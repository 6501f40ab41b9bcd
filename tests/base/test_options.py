"""Options as they are declared: what they may be, everywhere and for each sub-aperture."""

import math
from dataclasses import FrozenInstanceError, dataclass
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.base.options import Options, PerSubaperture, check_lengths, is_auto, option
from faintspot.slopes.estimators import estimators


@dataclass(frozen=True, eq=False, kw_only=True)
class Sample(Options):
    """One option of every kind."""

    number: Any = option(1.0, "A number.", low=0.0, high=10.0)
    above: Any = option(1.0, "A number above a bound.", low=0.0, low_open=True)
    whole: Any = option(None, "A whole number.", low=1, high=100, whole=True)
    name: Any = option("a", "A name.", choices=("a", "b"))
    found: Any = option("auto", "A number that is found.", low=0.0, automatic=True)
    one: Any = option(2, "For the whole sensor.", low=1, whole=True, per_subaperture=False)
    kind: Any = option("x", "A name for the whole sensor.", choices=("x", "y"), per_subaperture=False)

    def default_of(self, name: str, pixels: int) -> Any:
        return pixels // 2 if name == "whole" else super().default_of(name, pixels)


class TestOneValue:
    def test_values_are_kept_as_their_type(self) -> None:
        for name, given, kept in (
            ("number", np.float32(0.5), 0.5),
            ("number", 0, 0.0),
            ("number", 10.0, 10.0),
            ("above", 1e-9, 1e-9),
            ("whole", np.int8(7), 7),
            ("whole", 7.0, 7),
            ("whole", None, None),
            ("name", np.str_("b"), "b"),
            ("found", "auto", "auto"),
            ("found", 3.0, 3.0),
            ("one", 5, 5),
            ("kind", "y", "y"),
        ):
            value = getattr(Sample(**{name: given}), name)
            assert value == kept
            assert isinstance(value, type(kept))

    def test_wrong_values_are_refused(self) -> None:
        for words, changes in (
            ("number = 11: expected a number from 0 to 10", {"number": 11}),
            ("above = 0: expected a number above 0", {"above": 0.0}),
            ("name = 'c': expected one of 'a', 'b'", {"name": "c"}),
            ("found = 'best': expected a number or \"auto\"", {"found": "best"}),
            ("one: expected a number, got shape (2,)", {"one": [1, 2]}),
            ("number: expected a number or one per sub-aperture, got shape (1, 2)", {"number": [[1.0, 2.0]]}),
            ("kind", {"kind": ["x"]}),
            ("kind", {"kind": PerSubaperture("x", {1: "y"})}),
            ("number = 11", {"number": [1.0, 11.0]}),
            ("number = 11", {"number": PerSubaperture(1.0, {3: 11.0})}),
            ("number = -1", {"number": PerSubaperture(-1.0, {3: 1.0})}),
            ("whole: expected a value for each sub-aperture", {"whole": PerSubaperture(3, {0: None})}),
            ("name = 'c'", {"name": ["a", "c"]}),
            ("name = 'c'", {"name": PerSubaperture("a", {0: "c"})}),
            ('found: expected "auto" for the whole sensor', {"found": PerSubaperture(1.0, {0: "auto"})}),
            ('found: expected "auto" for the whole sensor', {"found": PerSubaperture("auto", {0: 1.0})}),
            ("found", {"found": ["auto", 1.0]}),
            ("arrays of one length, got number 2, above 3", {"number": [1, 2], "above": [1, 2, 3]}),
        ):
            with refused(words):
                Sample(**changes)


class TestEachSubaperture:
    def test_arrays_are_private_and_read_only(self) -> None:
        given = np.array([1.0, 2.0])
        sample = Sample(number=given, name=["a", "b"])
        given[0] = 9.0
        assert sample.number.tolist() == [1.0, 2.0]
        for array in (sample.number, sample.name):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = array[1]
        with pytest.raises(FrozenInstanceError):
            sample.number = 3.0  # type: ignore[misc]

    def test_places_are_private(self) -> None:
        others = {1: 2}
        sample = Sample(whole=PerSubaperture(None, others))
        others[2] = 3
        assert dict(sample.whole.others) == {1: 2}
        assert sample.values("whole", 3, 16).tolist() == [8, 2, 8]

    def test_lengths_of_several_parts(self) -> None:
        check_lengths(Sample(number=[1, 2]), Sample(above=[1, 2]), Sample())
        with refused("arrays of one length, got number 2, above 3"):
            check_lengths(Sample(number=[1, 2]), Sample(above=[1, 2, 3]))


class TestValues:
    def test_defaults_are_filled_in(self) -> None:
        sample = Sample()
        assert sample.values("number", 2, 16).tolist() == [1.0, 1.0]
        assert sample.values("whole", 2, 16).tolist() == [8, 8]
        assert sample.values("name", 2, 16).tolist() == ["a", "a"]
        assert is_auto(sample.found)
        assert not is_auto(Sample(found=[1.0]).found)
        assert math.isnan(Sample().default_of("number", 16))

    def test_values_of_another_sensor_are_refused(self) -> None:
        with refused("number: expected 3 values, one per sub-aperture, got 2"):
            Sample(number=[1, 2]).values("number", 3, 16)
        with refused("number: sub-aperture 3 does not exist; there are 3"):
            Sample(number=PerSubaperture(1.0, {3: 2.0})).values("number", 3, 16)


class TestChanges:
    def test_some_subapertures_are_replaced(self) -> None:
        for where in ([1], (1,), np.array([1])):
            assert Sample().replaced({"number": 3.0}, where).values("number", 3, 16).tolist() == [1, 3, 1]
        each = Sample().replaced({"number": [3.0, 4.0]}, np.array([True, False, True]))
        assert each.values("number", 3, 16).tolist() == [3, 1, 4]
        assert Sample(number=[1, 2]).replaced({"number": 2.5}, 0).number.tolist() == [2.5, 2.0]
        names = Sample(name=["b", "b"]).replaced({"name": "a"}, 1)
        assert names.values("name", 2, 16).tolist() == ["b", "a"]
        assert Sample().replaced({"number": 3.0}) == Sample(number=3.0)

    def test_wrong_replacements_are_refused(self) -> None:
        for words, changes, where in (
            ("numbr: expected one of number, above", {"numbr": 1.0}, None),
            ("one: expected one value for the whole sensor", {"one": 3}, [0]),
            ("as many as `where`, got 3", {"number": [1, 2, 3]}, [0, 1]),
            ("where", {"number": 1.0}, [-1]),
            ("where", {"number": 1.0}, [0.5]),
            ("where", {"number": 1.0}, "all"),
        ):
            with refused(words):
                Sample().replaced(changes, where)

    def test_what_was_chosen(self) -> None:
        assert Sample().chosen() == {}
        assert Sample(number=1.0, whole=3, name="b").chosen() == {"whole": 3, "name": "b"}
        assert list(Sample(number=[1.0, 1.0]).chosen()) == ["number"]

    def test_options_are_equal_if_their_values_are(self) -> None:
        assert Sample(number=[1, 2]) == Sample(number=np.array([1.0, 2.0]))
        assert Sample(number=[1, 2]) != Sample(number=[1, 3])
        assert Sample(number=[1, 1]) != Sample(number=1)
        assert Sample() != 1.0


def test_every_option_of_every_estimator_takes_its_default_and_says_what_it_is() -> None:
    for kind in (*estimators().values(), type(fs.Settings("brightest")._shared)):
        for name, default in kind.defaults().items():
            declared = kind.declared()[name]
            assert declared.meaning.endswith(".")
            checked = declared.checked(name, default)
            assert checked == default
            assert type(checked) is type(default)
