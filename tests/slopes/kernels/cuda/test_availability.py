from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.slopes.kernels.cuda.availability import check_cuda

LAYOUT = fs.Layout.grid((2, 2), pixels=8)
SETTINGS = fs.Settings(noise_std=0.5)


def test_unknown_device_is_refused() -> None:
    with pytest.raises(fs.InputError, match="device = 'tpu': expected one of 'cpu', 'cuda'"):
        fs.SlopePipeline(LAYOUT, SETTINGS, device="tpu")


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec

    def find(name: str, *rest: Any) -> Any:
        return None if name == "numba_cuda" else found(name, *rest)

    monkeypatch.setattr(importlib.util, "find_spec", find)
    with pytest.raises(fs.MissingExtraError, match=r"faintspot\[gpu\]"):
        fs.SlopePipeline(LAYOUT, SETTINGS, device="cuda")


def test_without_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from numba import cuda

    monkeypatch.setattr(cuda, "is_available", lambda: False)
    with refused('use device="cpu", or set NUMBA_ENABLE_CUDASIM=1'):
        check_cuda()


def test_noise_map_is_refused() -> None:
    """The kernel of the GPU has one variance for each sub-aperture."""
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from faintspot.slopes.pipeline.device import DevicePipeline

    calibration = fs.Calibration(read_noise_e=np.ones(LAYOUT.frame_shape))
    plan = fs.SlopePipeline(LAYOUT, SETTINGS, calibration).plan
    with refused("calibration.read_noise_e", 'device="cpu"'):
        DevicePipeline(LAYOUT, calibration, plan)
