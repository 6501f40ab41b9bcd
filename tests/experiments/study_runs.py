"""A study that takes a second, and what the tests of runs ask of it."""

from pathlib import Path

import xarray

from faintspot.experiments import StudySpecification, Sweep

SPECIFICATION = StudySpecification(
    "small",
    [
        Sweep("flux", flux_e=[10, 30, 100, 300], pixels=[6, 8]),
        Sweep("noise", read_noise_e=[0.1, 3], pixels=8),
    ],
    realisations=200,
    fixed_k=(10, 40),
)
N_CELLS = 9  # 100 e- and 0.1 e- on 8 x 8 pixels is in both sweeps


def files(store: Path) -> dict[str, bytes]:
    """Return all files of a store."""
    return {str(p.relative_to(store)): p.read_bytes() for p in store.rglob("*") if p.is_file()}


def assert_same(store: Path, uninterrupted: Path) -> None:
    """Both stores have the same files, bit for bit."""
    found, expected = files(store), files(uninterrupted)
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []


def assert_identical(found: xarray.Dataset, expected: xarray.Dataset) -> None:
    """Same values (bit for bit), coordinates and attributes."""
    xarray.testing.assert_identical(found, expected)
