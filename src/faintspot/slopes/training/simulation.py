"""Training a linear score on simulated spots."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between, numbers_between, one_of
from faintspot.base.errors import InputError
from faintspot.base.generators import spawn
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.spots.score import STARTS, TrainedScore, smoothed_peak
from faintspot.slopes.spots.shapes import SMALLEST_SIZE, image_shape, per_spot, spots
from faintspot.slopes.spots.speckled import LARGEST_D_OVER_R0, speckled_spots
from faintspot.slopes.training.fitting import Sample, best_passes, fit_passes, stacked_tables
from faintspot.slopes.training.splines import (
    FINE_SPACING_PX,
    STEPS_PER_PX,
    WIDE_SPACING_PX,
    SplineTables,
    splines_for,
)

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the number of finished and of all trainings (kinds times classes)."""

CLASS_WIDTH = 3.0
"""Largest ratio of the fluxes that one class is trained for."""
MOST_PASSES = 8

_HELD_OUT = 0.25  # of the realisations again, on which the error is measured
_SPECKLED_DRAWS = 3  # noisy images of each speckled spot, which is slow to simulate
_REFERENCE_RANGE_PX = 0.5  # references fall at any phase of the pixels
_SMOOTHING = 0.65  # standard deviation of the smoothing before the peak, in units of lambda / d
_LARGEST_FINE = 1.5  # d / r0, and size times elongation, up to which splines are fine
_FARTHEST_REFERENCE_START = 1.0  # position range, in units of lambda / d, up to which the reference is nearer


@dataclass(frozen=True)
class _Kind:
    """The spots of one kind of sub-aperture."""

    profile: str
    shape: tuple[int, int]
    d_over_r0: float
    natural_tilt: bool
    size: float
    elongation: float
    angle_deg: float

    def symmetry(self) -> str:
        """Symmetry of the spots, one of `SplineTables`."""
        if self.angle_deg % 90 and (self.elongation > 1 or self.profile == "diffraction"):
            return "point"
        return "round" if self.elongation == 1 and self.shape[0] == self.shape[1] else "aligned"

    def basis(self, search_range_px: float) -> SplineTables:
        """Splines wide and fine enough for the spots."""
        wide = max(self.d_over_r0, self.size * self.elongation) > _LARGEST_FINE
        spacing = WIDE_SPACING_PX if wide else FINE_SPACING_PX
        return splines_for(spacing, 0.5 * max(self.shape) + search_range_px, self.symmetry())

    def unit_spots(
        self, n: int, position_range_px: float, rng: np.random.Generator
    ) -> tuple[Floats, Floats, Floats]:
        """Return images (n, ny, nx) with 1 electron on average, true positions and references (n, 2)."""
        position_rng, phase_rng = spawn(rng, 2)
        draws = _SPECKLED_DRAWS if self.d_over_r0 else 1
        reference = position_rng.uniform(-_REFERENCE_RANGE_PX, _REFERENCE_RANGE_PX, (-(-n // draws), 2))
        positions = reference + position_rng.uniform(-position_range_px, position_range_px, reference.shape)
        if self.d_over_r0:
            images, truth = speckled_spots(
                len(positions),
                positions=positions,
                d_over_r0=self.d_over_r0,
                natural_tilt=self.natural_tilt,
                shape=self.shape,
                size=self.size,
                rng=phase_rng,
            )
        else:
            truth = positions
            images = spots(
                positions,
                shape=self.shape,
                profile=self.profile,
                size=self.size,
                elongation=self.elongation,
                angle_deg=self.angle_deg,
            )
        images /= images.sum() / len(images)
        # All draws of a spot are neighbours: a held-out spot has not been trained on.
        repeated = (np.repeat(part, draws, axis=0)[:n] for part in (images, truth, reference))
        return tuple(repeated)  # type: ignore[return-value]


@dataclass(frozen=True)
class _Training:
    """Training parameters shared by all kinds and classes."""

    camera: Detector
    edges: Floats
    """(n_classes, 2): lowest and highest flux of each class, electrons."""
    position_range_px: float
    search_range_px: float
    passes: int
    realisations: int
    start: str = "reference"
    smoothing_px: float = 0.0

    def noisy(
        self, unit: Floats, truth: Floats, reference: Floats, level: int, rng: np.random.Generator
    ) -> Sample:
        """Return noisy images of a flux class."""
        flux_rng, noise_rng = spawn(rng, 2)
        low, high = np.log(self.edges[level])
        flux = np.exp(flux_rng.uniform(low, high, len(unit)))
        images = self.camera.to_electrons(self.camera.expose(unit * flux[:, None, None], noise_rng))
        electrons = images.astype(np.float64) - _dark_level_e(self.camera, unit.shape[1:])
        half = self.search_range_px
        start = reference
        if self.start == "peak":
            start = smoothed_peak(electrons, self.smoothing_px, reference, half)
        relative = electrons / flux[:, None, None]
        return Sample(relative, truth, start, reference - half, reference + half)

    def kind(
        self, kind: _Kind, rng: np.random.Generator, done: Callable[[], None]
    ) -> tuple[NDArray[np.float32], Floats]:
        """Train all classes of one kind: tables (n_classes, passes, 2, ...) and errors (n_classes, 2), px."""
        n = self.realisations
        spot_rng, *class_rngs = spawn(rng, 1 + len(self.edges))
        unit = kind.unit_spots(math.ceil(n * (1 + _HELD_OUT)), self.position_range_px, spot_rng)
        basis = kind.basis(self.search_range_px)
        tables, errors = [], []
        for level, class_rng in enumerate(class_rngs):
            sample = self.noisy(*unit, level, class_rng)
            fitted = fit_passes(sample.part(slice(n)), basis, self.passes)
            best, error = best_passes(sample.part(slice(n, None)), fitted)
            tables.append(best)
            errors.append(error)
            done()
        return np.stack(tables), np.stack(errors)


def train_estimator(
    *,
    flux_e: ArrayLike,
    detector: Detector | None = None,
    shape: tuple[int, int] = (16, 16),
    profile: str = "diffraction",
    size: ArrayLike = 1.0,
    elongation: ArrayLike = 1.0,
    angle_deg: ArrayLike = 0.0,
    d_over_r0: float = 0.0,
    natural_tilt: bool = False,
    position_range_px: float = 1.0,
    search_range_px: float | None = None,
    start: str | None = None,
    passes: int = 3,
    realisations: int = 20_000,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
) -> TrainedScore:
    """Train the linear score on simulated spots.

    Each pass is a ridge regression of the remaining position error on projections of the image on cubic
    B-splines around the position so far, with the symmetry of the spots built in. The estimate is close to
    the mean of the positions that the image allows: at low flux it tends to the start, and its gain falls
    below 1 (see `position_range_px`).

    Parameters
    ----------
    flux_e : float or (float, float)
        Electrons of a spot within its window, on average over the positions. One number trains one class at
        that flux; a range (faintest, brightest) trains classes, evenly spaced in log flux, of at most a
        factor 3 each, with fluxes drawn from across the class.
    detector : Detector, optional
        Default: 0.1 e- read noise and nothing else. Background and dark current are subtracted, their noise
        stays.
    shape : (int, int)
        Rows and columns of a window, px.
    profile, size, elongation, angle_deg
        The spot's shape, see `spots.shapes`; size, elongation and angle may be (n_subapertures,)
        arrays: sub-apertures that are alike share a kind, and each kind takes its own training.
    d_over_r0 : float
        Side of the sub-aperture in units of the Fried parameter at the sensing wavelength. Above 0 the spots
        are those of `faintspot.slopes.spots.speckled.speckled_spots`. When unsure, train for the larger one.
    natural_tilt : bool
        Whether the turbulence's own tilt adds to the positions, as without a corrector in front.
    position_range_px : float
        Training positions are uniform within plus and minus this around the reference on each axis: the
        prior. Spots twice as far away as that may be lost; a range of 3 px costs nothing near the
        diffraction limit with flux enough to see the spot. References fall anywhere within 0.5 px of the
        window's centre.
    search_range_px : float, optional
        Estimates stay within plus and minus this around the reference. Default: half the longer side.
    start : {"reference", "peak"}, optional
        Where the first pass starts. Default: the reference, where positions are within lambda / d of it,
        else the peak of the smoothed image.
    passes : int
        Most passes, 1 to 8. At low flux fewer are better; those left out are tables of zeros.
    realisations : int
        Spots to train on for each kind and class; a quarter as many again measure the error.
    rng : numpy.random.Generator, optional
        Where spots and noise come from.
    progress : callable, optional
        Called after every class with the number of finished trainings and of all.

    Returns
    -------
    TrainedScore

    Raises
    ------
    InputError
        When a value is not finite, out of its range or of the wrong shape.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> rng = np.random.default_rng(1)
    >>> score = fs.train_estimator(flux_e=50.0, shape=(8, 8), realisations=4000, rng=rng)
    >>> print(score.standard_error(50.0).round(2))
    [[0.11 0.11]]
    >>> layout, settings = fs.Layout.grid((7, 7), pixels=8), fs.Settings("trained", flux_e=50.0)
    >>> pipeline = fs.SlopePipeline(layout, settings, score=score)
    """
    spot_shapes, index = _kinds_of_spots(size, elongation, angle_deg)
    training = _checked_training(
        detector,
        flux_e,
        position_range_px,
        search_range_px,
        passes,
        realisations,
        max(image_shape("shape", shape)),
    )
    common = (
        profile,
        image_shape("shape", shape),
        _turbulence(d_over_r0, profile, spot_shapes),
        natural_tilt,
    )
    kinds = [_Kind(*common, *row) for row in spot_shapes.tolist()]
    training = replace(training, **_start(start, kinds, position_range_px))
    finished = itertools.count(1)

    def done() -> None:
        if progress is not None:
            progress(next(finished), len(kinds) * len(training.edges))

    trained = [
        training.kind(kind, kind_rng, done)
        for kind, kind_rng in zip(kinds, spawn(rng, len(kinds)), strict=True)
    ]
    return TrainedScore(
        tables=stacked_tables([tables for tables, _ in trained]),
        flux_e=np.sqrt(training.edges.prod(axis=1)),
        standard_error_px=np.stack([errors for _, errors in trained]),
        steps_per_px=STEPS_PER_PX,
        start=training.start,
        smoothing_px=training.smoothing_px,
        index=index,
    )


def flux_classes(flux_e: ArrayLike) -> Floats:
    """Return the lowest and highest flux of each class, (n_classes, 2) electrons, for a flux or a range."""
    flux: Floats = numbers_between("flux_e", flux_e, 0.0, low_open=True)
    if flux.shape not in ((), (2,)) or flux.flat[0] > flux.flat[-1]:
        raise InputError(
            f"flux_e: expected one number, or the faintest and the brightest, got {flux.tolist()}"
        )
    low, high = float(flux.min()), float(flux.max())
    count = max(1, math.ceil(math.log(high / low) / math.log(CLASS_WIDTH) - 1e-9))
    borders = np.geomspace(low, high, count + 1)
    return np.stack([borders[:-1], borders[1:]], axis=1)


def _checked_training(
    detector: object,
    flux_e: ArrayLike,
    position_range_px: float,
    search_range_px: float | None,
    passes: int,
    realisations: int,
    side: int,
) -> _Training:
    camera = Detector(read_noise_e=0.1) if detector is None else detector
    if not isinstance(camera, Detector):
        raise InputError(f"detector: expected a Detector or None, got {type(detector).__name__}")
    search = 0.5 * side if search_range_px is None else search_range_px
    return _Training(
        camera,
        flux_classes(flux_e),
        number_between("position_range_px", position_range_px, 0.0, low_open=True),
        number_between("search_range_px", search, 0.0, low_open=True),
        passes=int(number_between("passes", passes, 1, MOST_PASSES, integer=True)),
        realisations=int(number_between("realisations", realisations, 100, integer=True)),
    )


def _turbulence(d_over_r0: object, profile: str, spot_shapes: Floats) -> float:
    strength = number_between("d_over_r0", d_over_r0, 0.0, LARGEST_D_OVER_R0)
    if strength and (profile != "diffraction" or np.any(spot_shapes[:, 1] != 1)):
        raise InputError(f"d_over_r0 = {strength:g}: expected profile 'diffraction' and elongation 1")
    return strength


def _start(start: str | None, kinds: list[_Kind], position_range_px: float) -> dict[str, Any]:
    """Start of the first pass, and the smoothing for the peak (of the narrowest spots)."""
    width = 2 * min(kind.size for kind in kinds)
    near = position_range_px <= _FARTHEST_REFERENCE_START * width and not any(k.natural_tilt for k in kinds)
    chosen = ("reference" if near else "peak") if start is None else one_of("start", start, STARTS)
    return {"start": chosen, "smoothing_px": _SMOOTHING * width}


def _kinds_of_spots(
    size: ArrayLike, elongation: ArrayLike, angle_deg: ArrayLike
) -> tuple[Floats, NDArray[np.int64] | None]:
    """Return size, elongation and angle of each kind, and the kind of each sub-aperture or None."""
    names = ("size", "elongation", "angle_deg")
    values = [
        finite_array(name, value) for name, value in zip(names, (size, elongation, angle_deg), strict=True)
    ]
    n = max(value.size for value in values)
    rows = np.stack([per_spot(name, value, n) for name, value in zip(names, values, strict=True)], axis=1)
    numbers_between("size", rows[:, 0], SMALLEST_SIZE)
    numbers_between("elongation", rows[:, 1], 1.0)
    kinds, index = np.unique(rows, axis=0, return_inverse=True)
    single = all(value.ndim == 0 for value in values)
    return kinds, None if single else index.reshape(-1).astype(np.int64)


def _dark_level_e(camera: Detector, shape: tuple[int, ...]) -> Floats:
    """Mean electrons of background, dark current and hot pixels, which a calibrated image is without."""
    level = np.broadcast_to(np.add(camera.dark_e, camera.background_e), shape).copy()
    for row, column, electrons in camera.hot_pixels:
        level[int(row), int(column)] += electrons
    return level
