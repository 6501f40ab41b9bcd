"""A small convolutional network in JAX. It gives two maps: the denoised image, and weights of a centroid."""

import time
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.typing import NDArray

from benchmarks.yardstick.spots import UnitSpots

_BATCH, _RATE, _LAYERS = 64, 5e-3, ((5, 5, 3, 12), (5, 5, 12, 12), (5, 5, 12, 12), (3, 3, 12, 2))
_FLUX_E, _READ_NOISE_E = (8.0, 1500.0), (0.08, 20.0)
"""Ranges from which those of training are drawn, evenly in their logarithms."""


@dataclass(frozen=True)
class Network:
    """A trained network, the number of noisy images that it saw, and the seconds that it took."""

    weights: Any
    images: int
    seconds: float

    def __call__(self, images: NDArray[Any], flux_e: float, read_noise_e: float) -> tuple[Any, Any]:
        """Return denoised images in electrons, and positions (n, 2) in px."""
        told = (np.full(len(images), value, np.float32) for value in (flux_e, read_noise_e))
        denoised, positions = _applied(self.weights, images.astype(np.float32), *told)
        return np.asarray(denoised), np.asarray(positions, np.float64)


@jax.jit
def _applied(weights: Any, images: Any, flux: Any, read_noise: Any) -> tuple[Any, Any]:
    flux, read_noise = flux[:, None, None], read_noise[:, None, None]
    told = [jnp.broadcast_to(part, images.shape) for part in (10 * read_noise / flux, 3 / jnp.sqrt(flux))]
    values = jnp.stack([10 * images / flux, *told], axis=-1)
    for number, (kernel, offset) in enumerate(weights):
        values = jax.nn.relu(values) if number else values
        values = offset + jax.lax.conv_general_dilated(
            values, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
    logits = values[..., 1]
    share = jax.nn.softmax(logits.reshape(len(logits), -1)).reshape(logits.shape)
    y, x = (jnp.arange(side) - (side - 1) / 2 for side in images.shape[1:])
    return flux * values[..., 0] / 10, jnp.stack([share.sum(1) @ x, share.sum(2) @ y], axis=1)


def trained(spots: UnitSpots, steps: int, seed: int) -> Network:
    """Train on noise-free spots and their mirror images, with noise drawn anew for every batch."""
    rng, began = np.random.default_rng([seed, 7]), time.perf_counter()
    scale = [np.sqrt(2 / np.prod(size[:-1])) for size in _LAYERS]
    weights = [
        (jnp.asarray(rng.normal(0, std, size), jnp.float32), jnp.zeros(size[-1], jnp.float32))
        for std, size in zip(scale, _LAYERS, strict=True)
    ]
    optimiser = optax.adam(optax.cosine_decay_schedule(_RATE, steps))
    state = optimiser.init(weights)

    def loss(weights: Any, images: Any, flux: Any, read_noise: Any, mean_e: Any, truth: Any) -> Any:
        """Return squared errors of positions and images, in units of what is to be expected of each."""
        denoised, positions = _applied(weights, images, flux, read_noise)
        expected = jnp.minimum(1.5 / flux + 40 * (read_noise / flux) ** 2, 0.3)
        of_image = jnp.sum((denoised - mean_e) ** 2, axis=(1, 2)) / (flux + 5 * read_noise**2)
        return jnp.mean(jnp.sum((positions - truth) ** 2, axis=1) / expected + of_image)

    @jax.jit
    def step(weights: Any, state: Any, *batch: Any) -> Any:
        updates, state = optimiser.update(jax.grad(loss)(weights, *batch), state)
        return optax.apply_updates(weights, updates), state

    for _ in range(steps):
        weights, state = step(weights, state, *_batch(spots, rng))
    jax.block_until_ready(weights)
    return Network(weights, steps * _BATCH, time.perf_counter() - began)


def _batch(spots: UnitSpots, rng: np.random.Generator) -> tuple[Any, ...]:
    chosen, sign = rng.integers(len(spots.images), size=_BATCH), rng.choice([-1, 1], size=2)
    unit = spots.images[chosen][:, :: sign[1], :: sign[0]]
    ranges = np.log([_FLUX_E, _READ_NOISE_E])
    flux, read_noise = (np.exp(rng.uniform(low, high, _BATCH)) for low, high in ranges)
    mean_e = flux[:, None, None] * unit
    images = rng.poisson(mean_e) + read_noise[:, None, None] * rng.standard_normal(mean_e.shape)
    truth = spots.position[chosen] * sign
    return tuple(np.asarray(part, np.float32) for part in (images, flux, read_noise, mean_e, truth))
