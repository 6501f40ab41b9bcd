"""What the compiler makes of the kernels, which needs no GPU: everything a thread keeps is in registers."""

from __future__ import annotations

from typing import Any

import pytest

from faintspot.kernels.fused import DENOISE, SMOOTH
from faintspot.kernels.total_variation import CHAMBOLLE, FGP

HOPPER = (9, 0)


class _Device:
    compute_capability = HOPPER


def assembly(window: tuple[int, int], before: int, algorithm: int, monkeypatch: pytest.MonkeyPatch) -> str:
    """Compile a kernel for frames of uint16 to the GPU's intermediate language."""
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from numba import cuda
    from numba.cuda import dispatcher, types

    from faintspot.cuda.availability import simulated
    from faintspot.cuda.fused import slopes_kernel

    if simulated():
        pytest.skip("the simulator compiles nothing")
    if not cuda.is_available():  # otherwise the GPU that is here decides
        monkeypatch.setattr(dispatcher, "get_current_device", _Device)

    def array(kind: Any, dimensions: int) -> Any:
        return types.Array(kind, dimensions, "C")

    real, whole = types.float32, types.int32
    signature = (
        array(types.uint16, 2),
        whole,
        array(whole, 1),
        array(real, 2),
        real,
        array(real, 3),
        array(whole, 1),
        array(real, 3),
        array(real, 3),
        array(whole, 3),
        array(types.uint8, 2),
    )
    kernel = slopes_kernel(window, before, algorithm).py_func
    try:
        text, _ = cuda.compile(kernel, signature, device=False, abi="numba", cc=HOPPER)
    except (ImportError, OSError, RuntimeError) as error:
        pytest.skip(f"needs NVIDIA's compiler library: {error}")
    return str(text)


def linked(text: str) -> str:
    """Translate to machine code; return what the linker says about it."""
    linker = pytest.importorskip("cuda.bindings.nvjitlink", reason="needs the extra gpu")
    handle = linker.create(4, ["-arch=sm_90", "-verbose", "-Xptxas=-v", "-O3"])
    code = text.encode()
    linker.add_data(handle, linker.InputType.PTX, code, len(code), "slopes")
    linker.complete(handle)
    said = bytearray(linker.get_info_log_size(handle))
    linker.get_info_log(handle, said)
    return said.decode()


@pytest.mark.parametrize(
    ("window", "before", "algorithm"),
    [
        ((8, 8), DENOISE, FGP),
        ((16, 16), DENOISE, FGP),
        ((10, 10), SMOOTH, CHAMBOLLE),
    ],
)
def test_nothing_spills(
    window: tuple[int, int], before: int, algorithm: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = assembly(window, before, algorithm, monkeypatch)
    assert "__local_depot" not in text
    assert ".f64 \t" not in text  # no double precision, which small GPUs do 64 times slower
    assert "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads" in linked(text)
