"""Methods of a study in one cell: candidates, measured slopes, and errors for every number of kept pixels."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.checks import not_none
from faintspot.experiments.methods import Kind, keeps_every_k
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.base import Estimator, Need
from faintspot.slopes.estimators.built_in.gravity import KeepingBrightest
from faintspot.slopes.estimators.registry import estimator_named
from faintspot.slopes.estimators.sensor import Scene
from faintspot.slopes.pipeline.images import measure_images
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.spots.psf import PSF, spot_psf
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX

if TYPE_CHECKING:
    from faintspot.experiments.study.specification import StudySpecification
    from faintspot.experiments.study.sweep import Cell


Images = NDArray[np.float32]
Bools = NDArray[np.bool_]
Block = tuple[Images, Floats]
"""Images (n, side, side) and the true positions of their spots, (n, 2) px."""
Measured = tuple[Floats, Bools, Floats | None]
"""Positions (n, K, 2), whether they are valid (n, K), and stated standard errors (n, 2), if any, px."""

_KEPT, _OF_SPECKLED = "keep_brightest", ("blur_px", "model_error")
_LEAST_FLUX_E = 1e-3  # a mean of noise may be negative
_TABLE_PIXELS = 1 << 14  # of images at a time, whose tables then stay in the processor's cache

# In a cell ------------------------------------------------------------------------------------------------

Candidate = tuple[tuple[str, float], ...]
"""Options from which a method may choose, in the units of the specification."""


def shown(candidate: Candidate, option: str | None = None) -> float:
    """Return the value of an option, or of the first; NaN where there is none."""
    values = dict(candidate)
    return next(iter(values.values()), math.nan) if option is None else values.get(option, math.nan)


class CellMethods:
    """Methods of a study in one cell: candidates, estimators, and slopes of images.

    Parameters
    ----------
    cell : Cell
    specification : StudySpecification
    flux_e : float, optional
        Mean electrons of an image as measured, for methods without a table. Default: the cell's.
    """

    def __init__(self, cell: Cell, specification: StudySpecification, flux_e: float | None = None) -> None:
        self.cell, self.specification = cell, specification
        self.flux_e = max(cell.flux_e if flux_e is None else flux_e, _LEAST_FLUX_E)
        self.search_range_px = specification.search_range_of(cell)
        self._within_px = min(self.search_range_px, cell.pixels / 2)
        self.kinds = {method: estimator_named(method) for method in specification.estimators}
        self._calibration = Calibration(
            dark=0.0,
            read_noise_e=cell.read_noise_e * cell.em_gain,
            em_gain=cell.em_gain,
            background_e=cell.background_e,
        )

    def candidates(self, method: str) -> list[Candidate]:
        """Return what a method chooses from."""
        axes = self._axes(self.kinds[method])
        return [tuple(zip(axes, values, strict=True)) for values in itertools.product(*axes.values())]

    def estimator(self, method: str, candidate: Candidate) -> Estimator:
        """Return the estimator with a candidate's options."""
        return self.kinds[method](**{name: value * self._unit(name) for name, value in candidate})

    def measure(self, method: str, candidate: Candidate, images: Images) -> Slopes:
        """Return the slopes of images (n, side, side) in photo-electrons."""
        output = images * np.float32(self.cell.em_gain)  # as the camera gives it
        prepared = self._method(self.estimator(method, candidate))
        return measure_images(output, prepared.settings, calibration=self._calibration, **prepared.parts)

    def parts(self, method: str, blocks: Sequence[Block]) -> Sequence[Block]:
        """Return what a method measures at a time: blocks, or all of them where it has no table."""
        if keeps_every_k(self.kinds[method]):
            return blocks
        images, truth = (np.concatenate(part) for part in zip(*blocks, strict=True))
        return [(images, truth)]

    def positions(self, method: str, candidate: Candidate, images: Images) -> Measured:
        """Return the positions in images; K is 1 for a method without a table of all kept pixels."""
        if keeps_every_k(self.kinds[method]):
            estimator: Any = self.estimator(method, candidate)
            return *position_table(estimator, images, self.search_range_px), None
        slopes = self.measure(method, candidate, images)
        positions = np.stack([slopes.x, slopes.y], axis=-1).astype(np.float64)
        stated = np.stack([slopes.standard_error_x, slopes.standard_error_y], axis=-1).astype(np.float64)
        return positions[:, None], np.asarray(slopes.measured)[:, None], stated

    def _method(self, estimator: Estimator) -> Method:
        """Tell an estimator what it has to know."""
        widths: dict[str, object] = {}
        if Need.WIDTH in estimator.needs:
            widths["spot_fwhm_px"], widths["spot_fwhm_y_px"] = self._spot_fwhm_px
        return Method(
            estimator.label,
            Settings(estimator, search_range_px=self._within_px, flux_e=self.flux_e, **widths),
            psf=self._psf if Need.PSF in estimator.needs else None,
        )

    def _axes(self, kind: Kind) -> dict[str, list[float]]:
        """Values of every option that a method chooses, in the units of the specification."""
        listed = {
            name: list(self._listed(name)) for name in kind.declared() if name in self.specification.options
        }
        found_by_table = {_KEPT} if keeps_every_k(kind) else set()
        estimator = kind(**{name: values[0] * self._unit(name) for name, values in listed.items()})
        automatic = {
            name: list(values)
            for name, values in estimator.tuned(self.scene).items()
            if name not in self.specification.options.keys() | found_by_table
        }
        return {**listed, **automatic}

    def _listed(self, option: str) -> tuple[float, ...]:
        if option in _OF_SPECKLED and self.cell.d_over_r0 == 0:
            return (0.0,)
        return tuple(self.specification.options[option])

    def _unit(self, option: str) -> float:
        """Return what a number of the specification is multiplied with."""
        if option in ("noise_std", "threshold_e"):
            return self.cell.pixel_noise_e
        return math.sqrt(math.prod(self._spot_fwhm_px)) if option == "weight_fwhm_px" else 1

    @functools.cached_property
    def scene(self) -> Scene:
        """Knowledge of the cell that estimators have when they tune their own options."""
        cell = self.cell
        return Scene(
            flux_e=self.flux_e,
            read_noise_e=cell.read_noise_e,
            window=(cell.pixels, cell.pixels),
            spot_fwhm_px=FWHM_OF_SIZE_1_PX[cell.profile] * cell.size * math.sqrt(cell.elongation),
            position_range_px=self._within_px,
            elongation=cell.elongation,
            excess_noise=cell.excess_noise,
            background_e=cell.background_e,
            d_over_r0=cell.d_over_r0,
            profile=cell.profile,
        )

    @property
    def _psf(self) -> PSF:
        """The PSF without turbulence, as far out as a window sees it."""
        cell = self.cell
        radius = math.ceil(cell.pixels / 2 + self._within_px) + 2
        return spot_psf(cell.size, cell.elongation, cell.profile, radius)

    @functools.cached_property
    def _spot_fwhm_px(self) -> tuple[float, float]:
        """Width along x and y, without turbulence."""
        along, across = self._psf.fwhm_px[0].tolist()
        return along, across


def position_table(
    estimator: KeepingBrightest, images: Images, search_range_px: float = math.inf
) -> tuple[Floats, Bools]:
    """Return the position in every image for every number k of kept pixels.

    Parameters
    ----------
    estimator : KeepingBrightest
        What it says of the number of pixels does not count.
    images : (n, side, side) array, float32
    search_range_px : float
        Positions beyond plus or minus this become it, on each axis.

    Returns
    -------
    positions : (n, K, 2) array
        For k = 1 to K = side^2 - 1, px.
    valid : (n, K) array, bool
        Whether there was flux. Where not, the position counts as (0, 0).
    """
    prepared = np.ascontiguousarray(not_none(estimator.denoised(images))).reshape(len(images), -1)
    n, pixels = prepared.shape
    positions, valid = np.empty((n, pixels - 1, 2)), np.empty((n, pixels - 1), np.bool_)
    step = max(1, _TABLE_PIXELS // pixels)
    for start in range(0, n, step):
        part = slice(start, start + step)
        centres, valid[part] = _centres_of_every_k(prepared[part], images.shape[-1], estimator.flux_floor)
        np.clip(centres, -search_range_px, search_range_px, out=positions[part])
    return positions, valid


def _centres_of_every_k(images: Images, side: int, flux_floor: float) -> tuple[Floats, Bools]:
    """Return the centres of gravity (n, K, 2) of the k brightest pixels above the next, and validity (n, K).

    With g the pixels by falling value and t the next one, sum(g - t) and sum((g - t) x) follow from the
    cumulative sums of g, g x and x.
    """
    order = _brightest_first(images)
    values = np.take_along_axis(images, order, axis=1).astype(np.float64)
    kept, following = values[:, :-1], values[:, 1:]
    left = np.cumsum(kept, axis=1) - np.arange(1, values.shape[1]) * following
    largest = np.abs(values[:, [0, -1]]).max(axis=1, keepdims=True)
    valid = (left > flux_floor * largest) & (left > 0)
    inverse = np.divide(1.0, left, out=np.zeros_like(left), where=valid)
    offsets = np.arange(side) - 0.5 * (side - 1)
    centres = [
        (np.cumsum(kept * away, axis=1) - following * np.cumsum(away, axis=1)) * inverse
        for away in (offsets[order[:, :-1] % side], offsets[order[:, :-1] // side])
    ]
    return np.stack(centres, axis=-1), valid


def _brightest_first(images: Images) -> NDArray[np.int64]:
    """Return the indices (n, pixels) of the pixels by falling value; ties keep their order.

    Bits of float32, as an unsigned integer that grows while the value falls, and the index are sorted as one
    number, which is several times faster than a stable sort of the values.
    """
    bits = images.view(np.uint32)
    keys = np.where(bits >> 31, bits, ~bits & 0x7FFFFFFF).astype(np.uint64)
    both = np.sort(keys << 32 | np.arange(images.shape[1], dtype=np.uint64), axis=1)
    return (both & 0xFFFFFFFF).astype(np.int64)


def moments_of(positions: Floats, truth: Floats) -> Floats:
    """Sums that a regression of (n, K, 2) positions on the truth needs, (8, K)."""
    x, y = positions[..., 0], positions[..., 1]
    of_truth = [len(truth), *truth.sum(axis=0), np.square(truth).sum()]
    of_positions = [x.sum(axis=0), y.sum(axis=0), np.square(positions).sum(axis=(0, 2))]
    across = (x * truth[:, :1]).sum(axis=0) + (y * truth[:, 1:]).sum(axis=0)
    same = np.repeat(np.array(of_truth)[:, None], positions.shape[1], axis=1)
    return np.concatenate([same, np.stack([*of_positions, across])])


def errors_of(positions: Floats, truth: Floats) -> Floats:
    """Return (|dx| + |dy|) / 2 in single precision."""
    away = np.abs(positions - truth)
    errors: NDArray[np.float32] = (0.5 * (away[..., 0] + away[..., 1])).astype(np.float32)
    return errors.astype(np.float64)
