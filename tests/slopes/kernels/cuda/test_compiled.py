"""What the compiler makes of the kernels, which needs no GPU: everything a thread keeps is in registers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from faintspot.slopes.kernels.gravity.gravity import DENOISE, SMOOTH
from faintspot.slopes.kernels.total_variation.denoise import CHAMBOLLE, FGP

HOPPER = (9, 0)


class _Device:
    compute_capability = HOPPER


def array(kind: Any, dimensions: int) -> Any:
    """Numba's type of a contiguous array."""
    from numba.cuda import types

    return types.Array(getattr(types, kind), dimensions, "C")


def assembly(make: Callable[[], Any], arguments: list[Any], monkeypatch: pytest.MonkeyPatch) -> str:
    """Compile a kernel to the GPU's intermediate language."""
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from numba import cuda
    from numba.cuda import dispatcher, types

    from faintspot.slopes.kernels.cuda.availability import simulated

    if simulated():
        pytest.skip("the simulator compiles nothing")
    if not cuda.is_available():  # otherwise the GPU that is here decides
        monkeypatch.setattr(dispatcher, "get_current_device", _Device)
    kinds = [getattr(types, each) if isinstance(each, str) else array(*each) for each in arguments]
    try:
        text, _ = cuda.compile(make().py_func, tuple(kinds), device=False, abi="numba", cc=HOPPER)
    except (ImportError, OSError, RuntimeError) as error:
        pytest.skip(f"needs NVIDIA's compiler library: {error}")
    return str(text)


SLOPES: list[Any] = [
    ("uint16", 2),
    "int32",
    ("int32", 1),
    ("float32", 2),
    "float32",
    ("float32", 3),
    ("int32", 1),
    ("float32", 3),
    ("float32", 1),
    ("float32", 3),
    ("int32", 3),
    ("uint8", 2),
]


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
    ("window", "before", "algorithm"), [((16, 16), DENOISE, FGP), ((10, 10), SMOOTH, CHAMBOLLE)]
)
def test_nothing_spills(
    window: tuple[int, int], before: int, algorithm: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("numba_cuda", reason="needs the extra gpu")
    from faintspot.slopes.kernels.cuda.fused import slopes_kernel

    text = assembly(lambda: slopes_kernel(window, before, algorithm), SLOPES, monkeypatch)
    assert "__local_depot" not in text
    assert ".f64 \t" not in text  # no double precision, which small GPUs do 64 times slower
    assert "0 bytes stack frame, 0 bytes spill stores, 0 bytes spill loads" in linked(text)
