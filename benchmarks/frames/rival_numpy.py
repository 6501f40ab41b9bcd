"""The same algorithm in NumPy, as fast as NumPy goes: many images at once, float32, no temporaries."""

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.kernels.total_variation.sweeps import FGP_STEP

Floats = NDArray[np.float32]


FIRST_MULTIPLIER = 0.4  # lambda of the first iteration from p = 0, in units of the noise: rivals begin there


def momenta(iterations: int) -> Floats:
    """Nesterov's momentum of every iteration."""
    result, age, momentum = np.zeros(iterations, np.float32), 1.0, 0.0
    for i in range(iterations):
        result[i] = momentum
        next_age = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * age * age))
        momentum, age = (age - 1.0) / next_age, next_age
    return result


def locate(images: Floats, keep: int) -> Floats:
    """Keep the brightest pixels ("subtract_next") and take the centre of gravity: (n, ny, nx) -> (n, 2)."""
    n, ny, nx = images.shape
    flat = images.reshape(n, ny * nx)
    threshold = np.partition(flat, ny * nx - keep - 1, axis=1)[:, ny * nx - keep - 1]
    left = np.subtract(flat, threshold[:, None])
    np.maximum(left, 0.0, out=left)
    x = np.arange(nx, dtype=np.float32) - np.float32(0.5 * (nx - 1))
    y = np.arange(ny, dtype=np.float32) - np.float32(0.5 * (ny - 1))
    moments = left @ np.stack([np.tile(x, ny), np.repeat(y, nx), np.ones(ny * nx, np.float32)], axis=1)
    positions: Floats = moments[:, :2] / moments[:, 2:]
    return positions


class NumpyRival:
    """Slopes of images in blocks of `block` images, which should fit the processor's cache.

    Inside, a pixel's images lie side by side (ny, nx, block), so that neighbours are whole rows apart.
    """

    def __init__(self, ny: int, nx: int, block: int, noise_std: float, keep: int, iterations: int) -> None:
        self.block, self.noise_std, self.keep = block, np.float32(noise_std), keep
        self.momenta = momenta(iterations)
        self.image, self.divergence, self.v = (np.empty((ny, nx, block), np.float32) for _ in range(3))
        self.duals = [np.zeros((2, ny, nx, block), np.float32) for _ in range(3)]
        self.extrapolated = np.zeros((2, ny, nx, block), np.float32)

    def __call__(self, images: Floats) -> Floats:
        """Return the positions (n, 2) of images (n, ny, nx)."""
        positions = np.empty((len(images), 2), np.float32)
        for first in range(0, len(images), self.block):
            # The last block repeats some of the one before it, to be full.
            start = min(first, max(0, len(images) - self.block))
            block = images[start : start + self.block]
            positions[start : start + self.block] = locate(self.denoise(block), self.keep)
        return positions

    def _diverge(self, dual: Floats) -> Floats:
        """Write the divergence of a dual field, and return its squared norm in every image."""
        d = self.divergence
        np.add(dual[0], dual[1], out=d)
        np.subtract(d[:, 1:], dual[0, :, :-1], out=d[:, 1:])
        np.subtract(d[1:], dual[1, :-1], out=d[1:])
        np.multiply(d, d, out=self.v)
        norm: Floats = np.add.reduce(self.v.reshape(-1, self.block), axis=0)
        return norm

    def denoise(self, images: Floats) -> Floats:
        """Denoise exactly one block of images."""
        np.copyto(self.image, images.transpose(1, 2, 0))
        v, d, q = self.v, self.divergence, self.extrapolated
        p, previous, new = self.duals
        p.fill(0.0)
        previous.fill(0.0)
        ny, nx, _ = v.shape
        radius = np.float32(np.sqrt(ny * nx)) * self.noise_std
        step = np.float32(FGP_STEP)
        inverse = np.full(self.block, 1.0 / (FIRST_MULTIPLIER * self.noise_std), np.float32)
        for momentum in self.momenta:
            np.subtract(p, previous, out=q)
            np.multiply(q, momentum, out=q)
            np.add(q, p, out=q)
            norm = self._diverge(q)
            np.multiply(self.image, inverse * step, out=v)
            np.multiply(d, step, out=d)
            np.subtract(d, v, out=v)
            np.subtract(v[:, 1:], v[:, :-1], out=new[0, :, :-1])
            np.subtract(v[1:], v[:-1], out=new[1, :-1])
            np.add(new[0, :, :-1], q[0, :, :-1], out=new[0, :, :-1])
            np.add(new[1, :-1], q[1, :-1], out=new[1, :-1])
            np.multiply(new[0], new[0], out=v)
            np.multiply(new[1], new[1], out=d)
            np.add(v, d, out=v)
            np.maximum(v, np.float32(1.0), out=v)
            np.sqrt(v, out=v)
            np.divide(new, v, out=new)
            p, previous, new = new, p, previous
            inverse = np.where(norm > 0.0, np.sqrt(norm) / radius, inverse)
        norm = self._diverge(p)
        np.multiply(d, radius / np.sqrt(norm), out=d)
        np.subtract(self.image, d, out=d)
        return np.ascontiguousarray(d.transpose(2, 0, 1))
