"""The benchmarks' rivals do the same work as faintspot; nothing here is timed."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.frames import layouts, rivals, simulated_arrays


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


@pytest.mark.slow
def test_layouts_are_judged_by_the_truth() -> None:
    array = simulated_arrays.plain_small(1)[0]
    assert layouts.verdict(array) == ("right", "")
    assert layouts.verdict(replace(array, geometry="hexagonal"))[0] == "WRONG"
    for other in (
        replace(array, nodes=2 * array.nodes, spots=2 * array.spots),
        replace(array, nodes=array.nodes + 8, spots=array.spots + 8),
    ):
        assert layouts.verdict(other)[0] == "WRONG"
    dark = replace(array, flux=np.where(np.arange(len(array.flux)) < 2, 0.0, 1.0))
    assert "2 of 16 windows belong to no lenslet" in layouts.verdict(dark)[1]
    noise = replace(array, frame=np.random.default_rng(1).normal(size=(50, 50)))
    assert layouts.verdict(noise)[0] == "refused"
