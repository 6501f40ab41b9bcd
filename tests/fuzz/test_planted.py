"""The faults that are planted are those of today's sources."""

from collections import Counter

from tests.fuzz.planted import SOURCES, faults
from tests.shared_data import ROOT


def test_each_fault_changes_one_place_and_names_tests_that_are_there() -> None:
    """Otherwise the table of planted.toml rots."""
    found = faults()
    places = {fault.name: (SOURCES / fault.file).read_text("utf-8").count(fault.old) for fault in found}
    assert Counter(places.values()) == {1: len(found)}, places
    tests = [test for fault in found for test in fault.tests]
    assert [test for test in tests if not (ROOT / "tests" / test.partition("::")[0]).is_file()] == []
