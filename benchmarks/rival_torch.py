"""The same algorithm in PyTorch, on one thread, compiled where there is a C++ compiler.

Set up as its documentation recommends for inference on a processor: no gradients (`torch.inference_mode`,
https://docs.pytorch.org/docs/stable/generated/torch.autograd.grad_mode.inference_mode.html), the whole
function given to `torch.compile`, whose C++ backend fuses the element-wise steps and vectorises them
(https://docs.pytorch.org/docs/stable/generated/torch.compile.html), shapes fixed (`dynamic=False`), and
`torch.set_num_threads(1)` for the comparison on one processor. `channels_last` is for convolutions: of the
possible orders, a pixel's images side by side (ny, nx, n) is the one that vectorises.

Tried, on 36 images: not compiled 61 us per image, one iteration compiled 33, all compiled 22.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.rival_numpy import FIRST_MULTIPLIER, momenta
from faintspot.kernels.sweeps import FGP_STEP


def compiles() -> bool:
    """Whether `torch.compile` finds the compiler that it needs."""
    return any(shutil.which(name) for name in (os.environ.get("CXX", "g++"), "g++", "clang++"))


def _padded(v: Any, amounts: tuple[int, ...]) -> Any:
    from torch.nn.functional import pad  # type: ignore[import-not-found, unused-ignore]

    return pad(v, amounts)


def _divergence(px: Any, py: Any) -> Any:
    """Divergence of a field whose px is zero in the last column, and py in the last row."""
    left, above = _padded(px[:, :-1], (0, 0, 1, 0)), _padded(py[:-1], (0, 0, 0, 0, 1, 0))
    return (px - left) + (py - above)


def _gradient(v: Any) -> tuple[Any, Any]:
    right, below = v[:, 1:] - v[:, :-1], v[1:] - v[:-1]
    return _padded(right, (0, 0, 0, 1)), _padded(below, (0, 0, 0, 0, 0, 1))


def _denoise(g: Any, noise_std: float, momentum: Sequence[float]) -> Any:
    """Denoise images (ny, nx, n)."""
    import torch  # type: ignore[import-not-found, unused-ignore]

    radius = float(np.sqrt(g.shape[0] * g.shape[1]) * noise_std)
    px, py = torch.zeros_like(g), torch.zeros_like(g)
    old_px, old_py = px, py
    inverse = torch.full((g.shape[2],), 1.0 / (FIRST_MULTIPLIER * noise_std))
    for factor in momentum:
        qx, qy = px + factor * (px - old_px), py + factor * (py - old_py)
        d = _divergence(qx, qy)
        norm = (d * d).sum((0, 1))
        gx, gy = _gradient(d - g * inverse)
        new_px, new_py = qx + FGP_STEP * gx, qy + FGP_STEP * gy
        shrink = torch.rsqrt(torch.clamp(new_px * new_px + new_py * new_py, min=1.0))
        old_px, old_py, px, py = px, py, new_px * shrink, new_py * shrink
        inverse = torch.where(norm > 0.0, torch.sqrt(norm) / radius, inverse)
    d = _divergence(px, py)
    return g - d * (radius / torch.sqrt((d * d).sum((0, 1))))


def _locate(images: Any, keep: int) -> Any:
    """Brightest pixels ("subtract_next") and centre of gravity of images (n, ny, nx)."""
    import torch

    n, ny, nx = images.shape
    flat = images.reshape(n, ny * nx)
    left = torch.relu(flat - torch.topk(flat, keep + 1).values[:, keep:])
    x = (torch.arange(nx) - 0.5 * (nx - 1)).repeat(ny)
    y = (torch.arange(ny) - 0.5 * (ny - 1)).repeat_interleave(nx)
    return (left @ torch.stack([x, y], dim=1)) / left.sum(dim=1, keepdim=True)


def torch_rival(
    images: NDArray[np.float32],
    block: int,
    noise_std: float,
    keep: int,
    iterations: int,
    *,
    compiled: bool = True,
) -> Callable[[], NDArray[np.float32]]:
    """Return a function of no argument that computes the positions (n, 2) of the images (n, ny, nx)."""
    # One process compiles: a pool of them would compete with what is measured. Read when torch is imported.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    import torch

    torch.set_num_threads(1)
    momentum = [float(value) for value in momenta(iterations)]
    n = len(images)

    def one_block(part: Any) -> Any:
        denoised = _denoise(part.permute(1, 2, 0).contiguous(), noise_std, momentum)
        return _locate(denoised.permute(2, 0, 1), keep)

    function = torch.compile(one_block, dynamic=False) if compiled and compiles() else one_block
    stack = torch.from_numpy(images)
    # The last block repeats some of the one before it, to be full.
    starts = [min(first, max(0, n - block)) for first in range(0, n, block)]

    def run() -> NDArray[np.float32]:
        positions = np.empty((n, 2), np.float32)
        with torch.inference_mode():
            for start in starts:
                positions[start : start + block] = function(stack[start : start + block]).numpy()
        return positions

    return run
