"""The benchmarks' rivals do the same work as faintspot; nothing here is timed."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
from benchmarks import rival_others, rivals, study, sweeps
from benchmarks.rival_torch import torch_rival
from numpy.typing import NDArray


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


@pytest.mark.parametrize("block", [8, 20])
def test_torch_gives_the_same_positions(case: rivals.Problem, block: int) -> None:
    pytest.importorskip("torch")
    rival = torch_rival(
        case.images, block, rivals.NOISE_STD, rivals.KEEP, rivals.ITERATIONS, compiled=False
    )  # compiling takes half a minute, and changes nothing but rounding
    assert rivals.difference(case, rival) <= rivals.SAME_POSITION_PX


def test_opencv_denoises_images_of_8_bits(case: rivals.Problem) -> None:
    pytest.importorskip("cv2")
    observed = rival_others.eight_bit(case.images)
    denoised = rival_others.opencv_rival(case.images, 20)()
    assert observed.max(axis=(1, 2)).tolist() == [255] * len(observed)
    assert denoised.shape == case.images.shape
    assert variation(denoised) < variation(observed)


def test_prox_tv_solves_the_anisotropic_problem(case: rivals.Problem) -> None:
    pytest.importorskip("prox_tv")
    images, weight = case.images[:3], 0.5
    denoised = rival_others.prox_tv_rival(images, np.full(3, weight))()

    def functional(solution: NDArray[np.float64]) -> float:
        return 0.5 * float(((solution - images) ** 2).sum()) + weight * variation(solution)

    rng = np.random.default_rng(1)
    nearby = [denoised + rng.normal(0.0, 0.05, denoised.shape) for _ in range(20)]
    assert functional(denoised) < min(functional(each) for each in nearby)


def variation(images: NDArray[Any]) -> float:
    values = images.astype(np.float64)
    return float(np.abs(np.diff(values, axis=1)).sum() + np.abs(np.diff(values, axis=2)).sum())


@pytest.mark.parametrize("n", list(rivals.GRIDS))
def test_layouts_have_as_many_subapertures_as_they_say(n: int) -> None:
    assert len(rivals.layout_of(n, 8)) == n


def test_scikit_image_converges_to_the_same_positions(case: rivals.Problem) -> None:
    pytest.importorskip("skimage")
    assert rivals.skimage_difference(case, count=2) <= rivals.SAME_SOLUTION_PX


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
@pytest.mark.parametrize("width", [4, 8, 16])
def test_cpp_gives_the_same_fields(width: int) -> None:
    library = sweeps.cpp_library()
    assert library is not None
    assert sweeps.largest_difference(library, width) <= rivals.SAME_FIELD


def test_the_straightforward_study_gives_the_same_slope_errors() -> None:
    pytest.importorskip("skimage")
    plain, tv = study.differences(10)
    assert plain <= study.SAME_PLAIN_PX
    assert tv <= 2 * study.SAME_TV_PX  # of fewer images than the benchmark's 30
