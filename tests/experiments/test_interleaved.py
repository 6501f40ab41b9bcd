from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.experiments.experiment_cases import (
    HERE,
    PLAN,
    StopsAfter,
    assert_same_files,
    assert_same_units,
    small,
)

from faintspot.base.errors import InputError
from faintspot.experiments.interleaved import QUICK_PLAN, ObservingPlan, run_interleaved
from faintspot.experiments.loop_results import InterleavedResult
from faintspot.experiments.running import WorkerPool

pytest.importorskip("hcipy")
CAMERA = small().replace("camera", em_gain=100.0, read_noise_e=20.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("interleaved")
    run_interleaved(CAMERA, folder, plan=PLAN, place=HERE)
    return folder


def test_sets(whole: Path) -> None:
    result = InterleavedResult.load(whole)
    assert result.set_names == ("full gain, 2 strengths", "75 % of the gain, 3 strengths")
    assert result.settle_in_block == 20
    np.testing.assert_array_equal(result.strengths[0], [np.nan, 0, 2])
    np.testing.assert_array_equal(result.strengths[1], [np.nan, 0, 1, 2])
    for record, block, number in zip(result.records, result.block, (6, 4), strict=True):
        assert record.frames == len(block) == 60 * number
        np.testing.assert_array_equal(np.bincount(block), [60] * number)
    np.testing.assert_array_equal(result.records[0].method[::60], [0, 1, 2, 0, 1, 2])
    assert result.records[0].labels == ("no TV", "TV 0 e-", "TV 2 e-")


def test_gain_of_the_camera_and_atmosphere_differ(whole: Path) -> None:
    first, second = InterleavedResult.load(whole).records
    assert "em_gain = 100.0" in first.configuration
    assert "em_gain = 75.0" in second.configuration
    assert (first.realisation, second.realisation) == (0, 1)


def test_strength_zero_changes_nothing(whole: Path) -> None:
    """Denoising with strength 0 gives the image back: the same gain as without."""
    for record in InterleavedResult.load(whole).records:
        assert record.centroid_gain[0] == pytest.approx(record.centroid_gain[1], abs=1e-6)


@pytest.mark.parametrize("calls", [2, 300])
def test_interrupted_and_started_again(tmp_path: Path, whole: Path, calls: int) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_interleaved(CAMERA, tmp_path, plan=PLAN, place=WorkerPool(0, progress=StopsAfter(calls)))
    run_interleaved(CAMERA, tmp_path, plan=PLAN, place=HERE)
    assert_same_files(tmp_path, whole, "set-*.npz")
    assert_same_units(tmp_path, whole)


def test_nothing_is_done_twice(whole: Path) -> None:
    run_interleaved(CAMERA, whole, plan=PLAN, place=WorkerPool(0, progress=StopsAfter(0)))


def test_other_plan_is_refused_or_replaces(tmp_path: Path, whole: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "copy")
    shorter = replace(PLAN, block_frames=50, strengths=(2,), em_fractions=(1.0,), repeats=(1,))
    with pytest.raises(InputError, match="belongs to another closed-loop experiment"):
        run_interleaved(CAMERA, folder, plan=shorter, place=HERE)
    result = run_interleaved(CAMERA, folder, plan=shorter, place=HERE, overwrite=True)
    assert [record.frames for record in result.records] == [150]
    assert sorted(path.name for path in folder.glob("set-*.npz")) == ["set-1.npz"]


def test_plans() -> None:
    """Four sets as in the paper, of measurements with 400 frames at least that are scored."""
    for plan in (ObservingPlan(), QUICK_PLAN):
        assert plan.strengths == (8, 20, 8, 20)
        assert plan.em_fractions == (1.0, 1.0, 0.75, 0.75)
        assert plan.block_frames - plan.settle_in_block >= 400
    with pytest.raises(InputError, match="for each set"):
        replace(PLAN, repeats=(1,))
    with pytest.raises(InputError, match=r"plan\.block_frames"):
        replace(PLAN, block_frames=20)
