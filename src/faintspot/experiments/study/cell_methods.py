"""Methods of a study in one cell: candidates, measured slopes, and errors for every number of kept pixels."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from faintspot.experiments.methods import Kind, keeps_every_k, score_for_scene
from faintspot.loop.simulation.methods import Method
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.estimators.base import Estimator, Need
from faintspot.slopes.estimators.built_in.gravity import KeepingBrightest
from faintspot.slopes.estimators.registry import estimator_named
from faintspot.slopes.estimators.scene import Scene
from faintspot.slopes.kernels.gravity import every_k
from faintspot.slopes.pipeline.images import measure_images
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.simulate import Detector
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.score import TrainedScore
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX

if TYPE_CHECKING:
    from faintspot.experiments.study.specification import StudySpecification
    from faintspot.experiments.study.sweep import Cell


Images = NDArray[np.float32]
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Block = tuple[Images, Floats]
"""Images (n, side, side) and the true positions of their spots, (n, 2) px."""
Measured = tuple[Floats, Bools, Floats | None]
"""Positions (n, K, 2), whether they are valid (n, K), and stated standard errors (n, 2), if any, px."""

_KEPT = "keep_brightest"
_TRAINING = 1  # word that is added to a cell's seed
_LEAST_FLUX_E = 1e-3  # a mean of noise may be negative

# In a cell ------------------------------------------------------------------------------------------------

Candidate = tuple[tuple[str, float], ...]
"""Options from which a method may choose, in the units of the specification."""


def shown(candidate: Candidate, option: str | None = None) -> float:
    """Return the value of an option, or of the first; NaN where there is none."""
    values = dict(candidate)
    return next(iter(values.values()), math.nan) if option is None else values.get(option, math.nan)


def detector_of(cell: Cell) -> Detector:
    """Return the camera of a cell."""
    return Detector(
        read_noise_e=cell.read_noise_e * cell.em_gain, background_e=cell.background_e, em_gain=cell.em_gain
    )


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
        self.cell, self._specification = cell, specification
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
        made = self._method(self.estimator(method, candidate))
        return measure_images(output, made.settings, calibration=self._calibration, **made.parts)

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
        told: dict[str, Any] = {}
        if Need.WIDTH in estimator.needs:
            told["spot_fwhm_px"], told["spot_fwhm_y_px"] = self._spot_fwhm_px
        return Method(
            estimator.label,
            Settings(estimator, search_range_px=self._within_px, flux_e=self.flux_e, **told),
            psf=self._psf if Need.PSF in estimator.needs else None,
            score=self._score if Need.SCORE in estimator.needs else None,
        )

    def _axes(self, kind: Kind) -> dict[str, list[float]]:
        """Values of every option that a method chooses, in the units of the specification."""
        listed = {
            name: list(self._listed(name)) for name in kind.declared() if name in self._specification.LISTED
        }
        found_by_table = {_KEPT} if keeps_every_k(kind) else set()
        made = kind(**{name: values[0] * self._unit(name) for name, values in listed.items()})
        own = {
            name: list(values)
            for name, values in made.tuned(self.scene).items()
            if name not in self._specification.LISTED.keys() | found_by_table
        }
        return {**listed, **own}

    def _listed(self, option: str) -> tuple[float, ...]:
        key, only_speckled = self._specification.LISTED[option]
        if only_speckled and self.cell.d_over_r0 == 0:
            return (0.0,)
        return tuple(getattr(self._specification, key))

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
        return _psf_of(cell.profile, cell.size, cell.elongation, radius)

    @functools.cached_property
    def _spot_fwhm_px(self) -> tuple[float, float]:
        """Width along x and y, without turbulence."""
        along, across = self._psf.fwhm_px[0].tolist()
        return along, across

    @functools.cached_property
    def _score(self) -> TrainedScore:
        """Trained on spots of a seed of their own."""
        cell = self.cell
        entropy = [*cell.seed(self._specification.seed).entropy, _TRAINING]  # type: ignore[misc]
        rng = np.random.default_rng(np.random.SeedSequence(entropy))
        scene = replace(self.scene, position_range_px=cell.position_range_px)
        return score_for_scene(scene, detector_of(cell), rng, search_range_px=self._within_px)


@functools.lru_cache(maxsize=16)
def _psf_of(profile: str, size: float, elongation: float, radius_px: float) -> PSF:
    return PSF.analytic(profile, size=size, elongation=elongation, radius_px=radius_px)


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
    prepared = _prepared(estimator, images)
    positions = np.empty((len(images), prepared.shape[1] - 1, 2))
    valid = np.empty(positions.shape[:2], np.bool_)
    how = images.shape[-1], every_k.SUBTRACT_NEXT, estimator.flux_floor, search_range_px
    every_k.positions_of_every_k(prepared, *how, 0, len(images), positions, valid)
    return positions, valid


def _prepared(estimator: KeepingBrightest, images: Images) -> Images:
    """Return the images (n, pixels) in which the brightest pixels are found."""
    denoised = estimator.denoised(images)
    assert denoised is not None
    return np.ascontiguousarray(denoised).reshape(len(images), -1)


def moments_of(positions: Floats, truth: Floats) -> Floats:
    """Sums that a regression of (n, K, 2) positions on the truth needs, (8, K)."""
    x, y = positions[..., 0], positions[..., 1]
    whole = [len(truth), *truth.sum(axis=0), np.square(truth).sum()]
    own = [x.sum(axis=0), y.sum(axis=0), np.square(positions).sum(axis=(0, 2))]
    across = (x * truth[:, :1]).sum(axis=0) + (y * truth[:, 1:]).sum(axis=0)
    same = np.repeat(np.array(whole)[:, None], positions.shape[1], axis=1)
    return np.concatenate([same, np.stack([*own, across])])


def errors_of(positions: Floats, truth: Floats) -> Floats:
    """Return (|dx| + |dy|) / 2 in single precision."""
    errors: NDArray[np.float32] = np.abs(positions - truth).mean(axis=-1).astype(np.float32)
    return errors.astype(np.float64)
