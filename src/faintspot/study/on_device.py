"""A cell of a study on a GPU: images drawn and measured there, by all arms that know nothing of the spot.

Estimators measure the same images on the CPU. Images that turbulence has speckled and those of
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

from faintspot import presets
from faintspot.cuda import every_k
from faintspot.cuda.drawing import drawing_kernel, profile_tables
from faintspot.cuda.fused import FEWEST_BLOCKS
from faintspot.cuda.strips import WARP
from faintspot.kernels import scoring
from faintspot.study.arms import FLUX_FLOOR, Images
from faintspot.study.sweep import Cell
from faintspot.study.tables import Block, Floats, Scored, with_truth

_BLOCK_PIXELS = 1 << 22  # of images on the GPU at a time; their positions for every k take twice that
_GAUSSIAN_REACH = 4.0  # standard deviations, as scipy.ndimage.gaussian_filter
_BEFORE = {"tv": every_k.DENOISE, "gaussian": every_k.SMOOTH, "median": every_k.MEDIAN}


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
    cell : Cell
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.

    Raises
    ------
    InputError
        When the images are too large for a warp.
    """

    def __init__(self, cell: Cell, search_range_px: float) -> None:
        self._cell, self._search_range_px = cell, search_range_px
        self._memory: dict[tuple[int, int], tuple[Any, Any]] = {}  # used again: to get some takes long

    def sums(
        self, arm: str, candidates: Sequence[float], block: DeviceBlock, *, moments: bool
    ) -> tuple[Floats, Floats | None]:
        """See `Tables`."""
        every = [self._sums(self._positions(arm, c, block)[0], block) for c in candidates]
        found = np.stack([sums.copy_to_host() for sums in every], axis=1)
        if not moments:
            return found[every_k.ERROR], None
        parts = [with_truth(found[every_k.X :, c], block.truth) for c in range(len(candidates))]
        return found[every_k.ERROR], np.stack(parts, axis=1)

    def scored(self, arm: str, candidate: float, block: DeviceBlock, columns: Sequence[int]) -> Scored:
        """See `Tables`."""
        positions, valid = self._positions(arm, candidate, block)
        sums = self._sums(positions, block).copy_to_host()
        chosen = np.stack([positions[column].copy_to_host() for column in columns], axis=1)
        lit = np.stack([valid[column].copy_to_host() for column in columns], axis=1)
        errors = sums[[every_k.ERROR, every_k.ERROR_SQUARED]]
        return Scored(chosen.astype(np.float64), lit.astype(bool), errors)

    def _positions(self, arm: str, candidate: float, block: DeviceBlock) -> tuple[Any, Any]:
        """Positions (K, n, 2) and validity (K, n) on the GPU, which the next call may overwrite."""
        side, n = self._cell.pixels, len(block.on_device)
        k = 1 if arm == "thresholded" else side**2 - 1
        positions, valid = self._tables_of(k, n)
        launched = max(n, FEWEST_BLOCKS), WARP
        level = np.float32(0.0 if math.isnan(candidate) else candidate * self._cell.pixel_noise_e)
        limits = np.float64(FLUX_FLOOR), np.float64(self._search_range_px)
        if arm == "thresholded":
            kernel = every_k.thresholded_kernel(side)[launched]
            kernel(block.on_device, level, *limits, positions, valid)
            return positions, valid
        rule = scoring.THRESHOLD if arm == "threshold" else scoring.SUBTRACT_NEXT
        taps = gaussian_taps(candidate) if arm == "gaussian" else np.zeros((2, 1), np.float32)
        solver = presets.of_denoising("accurate")
        every_k.positions_kernel(side, _BEFORE.get(arm, every_k.NOTHING), rule)[launched](
            block.on_device,
            level,
            np.float32(solver["tolerance"]),
            np.int32(solver["max_iterations"]),
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
