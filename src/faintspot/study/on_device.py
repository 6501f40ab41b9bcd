"""A cell of a study on a GPU: images drawn there, and measured there by the arms that it has kernels for.

The others measure the same images on the CPU. Images that turbulence has speckled and those of
electron-multiplying detectors are drawn on the CPU.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from faintspot.cuda import every_k
from faintspot.cuda.drawing import drawing_kernel, profile_tables
from faintspot.cuda.flat_start import inverse_pivots
from faintspot.cuda.fused import FEWEST_BLOCKS
from faintspot.cuda.strips import WARP
from faintspot.estimators.base import Estimator
from faintspot.estimators.brightest import BrightestPixels
from faintspot.estimators.smoothed import Smoothed
from faintspot.estimators.thresholded import Thresholded
from faintspot.estimators.total_variation import TotalVariation
from faintspot.study.arms import Images
from faintspot.study.simple_denoisers import BrightestAsTheyAre, MedianFiltered
from faintspot.study.sweep import Cell
from faintspot.study.tables import RULES, Block, Floats, HostTables, Scored, with_truth

_BLOCK_PIXELS = 1 << 22  # of images on the GPU at a time; their positions for every k take twice that
_GAUSSIAN_REACH = 4.0  # standard deviations, as scipy.ndimage.gaussian_filter
_BEFORE: dict[type[Estimator], int] = {
    BrightestPixels: every_k.NOTHING,
    BrightestAsTheyAre: every_k.NOTHING,
    TotalVariation: every_k.DENOISE,
    Smoothed: every_k.SMOOTH,
    MedianFiltered: every_k.MEDIAN,
}
"""What the kernel does before it sorts the pixels."""


class DeviceBlock:
    """A block in the GPU's memory, which unpacks to images and truth as one in the host's does."""

    def __init__(self, on_device: Any, truth_on_device: Any) -> None:
        self.on_device, self.truth_on_device = on_device, truth_on_device

    @functools.cached_property
    def images(self) -> Images:
        """Images (n, side, side), brought over when asked for."""
        images: Images = self.on_device.copy_to_host()
        return images

    @functools.cached_property
    def truth(self) -> Floats:
        """True positions (n, 2), px."""
        truth: Floats = self.truth_on_device.copy_to_host()
        return truth

    def __iter__(self) -> Iterator[Any]:
        return iter((self.images, self.truth))


def draws(cell: Cell) -> bool:
    """Whether the GPU draws the images of a cell."""
    return cell.d_over_r0 == 0 and cell.em_gain == 1


def realisations(cell: Cell, study_seed: int, first: int, count: int) -> Iterator[DeviceBlock]:
    """Yield blocks of images drawn on the GPU, the mean background subtracted, and true positions.

    Parameters
    ----------
    cell : Cell
    study_seed : int
    first, count : int
        Images have numbers, on which, with the seed, alone they depend: from `first` on.
    """
    key = cuda.to_device(cell.seed(study_seed).generate_state(2, np.uint32).astype(np.uint64))
    spot = (cell.flux_e, cell.profile, cell.size, cell.elongation)
    tables, per_px = map(cuda.to_device, profile_tables(cell.pixels, cell.position_range_px, *spot))
    block = max(1, _BLOCK_PIXELS // cell.pixels**2)
    for start in range(first, first + count, block):
        n = min(block, first + count - start)
        images = cuda.device_array((n, cell.pixels**2), np.float32)
        truth = cuda.device_array((n, 2), np.float64)
        drawing_kernel(cell.pixels)[max(n, FEWEST_BLOCKS), WARP](
            key,
            np.int64(start),
            np.float64(cell.position_range_px),
            tables,
            per_px,
            np.float64(cell.background_e),
            np.float64(cell.read_noise_e),
            images,
            truth,
        )
        yield DeviceBlock(images.reshape(n, cell.pixels, cell.pixels), truth)


def brought(block: Block) -> DeviceBlock:
    """Bring images that were drawn on the CPU to the GPU."""
    return DeviceBlock(*(cuda.to_device(np.ascontiguousarray(part)) for part in block))


def gaussian_taps(std_px: float) -> NDArray[np.float32]:
    """Return the taps of a Gaussian along both axes, (2, 1 + reach), the central one first."""
    away = np.arange(int(_GAUSSIAN_REACH * std_px + 0.5) + 1)
    taps = np.exp(-0.5 * np.square(away / std_px))
    taps /= 2.0 * taps.sum() - 1.0
    return np.stack([taps, taps]).astype(np.float32)


class DeviceTables:
    """Measures blocks on the GPU; see `faintspot.study.tables.Tables`.

    Parameters
    ----------
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.
    """

    def __init__(self, search_range_px: float = math.inf) -> None:
        self._search_range_px, self._host = search_range_px, HostTables(search_range_px)
        self._memory: dict[tuple[int, int], tuple[Any, Any]] = {}  # used again: to get some takes long

    def takes(self, kind: type[Estimator]) -> bool:
        """See `Tables`."""
        return kind is Thresholded or self._host.takes(kind)

    def sums(
        self, estimators: Sequence[Any], block: DeviceBlock, *, moments: bool
    ) -> tuple[Floats, Floats | None]:
        """See `Tables`."""
        if not self._has_kernel(estimators[0]):
            return self._host.sums(estimators, Block(block.images, block.truth), moments=moments)
        every = [self._sums(self._positions(each, block)[0], block) for each in estimators]
        found = np.stack([sums.copy_to_host() for sums in every], axis=1)
        if not moments:
            return found[every_k.ERROR], None
        parts = [with_truth(found[every_k.X :, c], block.truth) for c in range(len(estimators))]
        return found[every_k.ERROR], np.stack(parts, axis=1)

    def scored(self, estimator: Any, block: DeviceBlock, columns: Sequence[int]) -> Scored:
        """See `Tables`."""
        if not self._has_kernel(estimator):
            return self._host.scored(estimator, Block(block.images, block.truth), columns)
        positions, valid = self._positions(estimator, block)
        sums = self._sums(positions, block).copy_to_host()
        chosen = np.stack([positions[column].copy_to_host() for column in columns], axis=1)
        lit = np.stack([valid[column].copy_to_host() for column in columns], axis=1)
        errors = sums[[every_k.ERROR, every_k.ERROR_SQUARED]]
        return Scored(chosen.astype(np.float64), lit.astype(bool), errors)

    def _has_kernel(self, estimator: Estimator) -> bool:
        return type(estimator) in _BEFORE or isinstance(estimator, Thresholded)

    def _positions(self, estimator: Any, block: DeviceBlock) -> tuple[Any, Any]:
        """Positions (K, n, 2) and validity (K, n) on the GPU, which the next call may overwrite."""
        n, side = block.on_device.shape[:2]
        launched = max(n, FEWEST_BLOCKS), WARP
        limits = np.float64(estimator.flux_floor), np.float64(self._search_range_px)
        if isinstance(estimator, Thresholded):
            positions, valid = self._tables_of(1, n)
            kernel = every_k.thresholded_kernel(side)[launched]
            kernel(block.on_device, np.float32(estimator.threshold_e), *limits, positions, valid)
            return positions, valid
        positions, valid = self._tables_of(side**2 - 1, n)

        def option(name: str) -> Any:
            return estimator.values(name, 1, side**2)[0]

        before = _BEFORE[type(estimator)]
        denoises, smooths = before == every_k.DENOISE, before == every_k.SMOOTH
        taps = gaussian_taps(float(option("smoothing_px"))) if smooths else np.zeros((2, 1), np.float32)
        every_k.positions_kernel(side, before, RULES[estimator.rule])[launched](
            block.on_device,
            np.float32(option("noise_std") if denoises else 0.0),
            np.float32(option("tolerance") if denoises else 0.0),
            np.int32(option("max_iterations") if denoises else 0),
            cuda.to_device(inverse_pivots((side, side))),
            cuda.to_device(taps),
            *limits,
            positions,
            valid,
        )
        return positions, valid

    def _tables_of(self, k: int, n: int) -> tuple[Any, Any]:
        """Memory for positions and validity."""
        if (k, n) not in self._memory:
            tables = cuda.device_array((k, n, 2), np.float32), cuda.device_array((k, n), np.uint8)
            self._memory[k, n] = tables
        return self._memory[k, n]

    def _sums(self, positions: Any, block: DeviceBlock) -> Any:
        """Sums over the images, (6, K), on the GPU."""
        sums = cuda.device_array((6, len(positions)), np.float64)
        blocks = max(len(positions), FEWEST_BLOCKS)
        every_k.sums_kernel()[blocks, WARP](positions, block.truth_on_device, sums)
        return sums
