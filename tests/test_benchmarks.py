"""The benchmarks' rivals do the same work as faintspot; nothing here is timed."""

from __future__ import annotations

import pytest
from benchmarks import rivals


@pytest.fixture(scope="module")
def case() -> rivals.Problem:
    return rivals.problem(20)


@pytest.mark.parametrize("block", [8, 20])
def test_numpy_gives_the_same_positions(case: rivals.Problem, block: int) -> None:
    assert rivals.difference(case, rivals.numpy_rival(case, block)) <= rivals.SAME_POSITION_PX


@pytest.mark.parametrize("block", [8, 20])
def test_jax_gives_the_same_positions(case: rivals.Problem, block: int) -> None:
    pytest.importorskip("jax")
    assert rivals.difference(case, rivals.jax_rival(case, block)) <= rivals.SAME_POSITION_PX


@pytest.mark.parametrize("n", list(rivals.GRIDS))
def test_layouts_have_as_many_subapertures_as_they_say(n: int) -> None:
    assert len(rivals.layout_of(n, 8)) == n


def test_scikit_image_converges_to_the_same_positions(case: rivals.Problem) -> None:
    pytest.importorskip("skimage")
    assert rivals.skimage_difference(case, count=2) <= rivals.SAME_SOLUTION_PX
