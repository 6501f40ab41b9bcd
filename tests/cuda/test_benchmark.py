"""The benchmark's rival does the same work as faintspot, and says what is missing; nothing here is timed."""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks import gpu, rivals


def test_arrays_give_the_same_positions() -> None:
    case = rivals.problem(20)
    positions = gpu.array_rival(np, case.images)()
    assert np.abs(positions - case.slopes()).max() <= rivals.SAME_POSITION_PX


def test_pytorch_gives_the_same_positions() -> None:
    torch = pytest.importorskip("torch")
    case = rivals.problem(20)
    positions = np.asarray(gpu.array_rival(torch, torch.as_tensor(case.images))())
    assert np.abs(positions - case.slopes()).max() <= rivals.SAME_POSITION_PX


def test_without_a_gpu_it_says_how_to_measure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "_missing", lambda: "no NVIDIA GPU")
    (table,) = gpu.run()
    assert table.rows == []
    assert table.notes == ["not measured: no NVIDIA GPU", f"on a machine with a GPU: {gpu.COMMAND}"]
