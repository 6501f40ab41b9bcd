"""The benchmark says what is missing; nothing here is timed."""

from __future__ import annotations

import pytest
from benchmarks import gpu


def test_without_a_gpu_it_says_how_to_measure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gpu, "_missing", lambda: "no NVIDIA GPU")
    (table,) = gpu.run()
    assert table.rows == []
    assert table.notes == ["not measured: no NVIDIA GPU", f"on a machine with a GPU: {gpu.COMMAND}"]
