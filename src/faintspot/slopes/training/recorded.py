"""Training a linear score on recorded frames alone, by splitting their photons."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between, numbers_between, one_of, real_array
from faintspot.base.errors import InputError
from faintspot.base.generators import spawn
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.score import STARTS, TrainedScore, smoothed_peak, table_sums
from faintspot.slopes.training.fitting import Sample, fit_passes
from faintspot.slopes.training.simulation import MOST_PASSES, flux_classes
from faintspot.slopes.training.splines import STEPS_PER_PX, SYMMETRIES, SplineTables, splines_for
from faintspot.slopes.training.usable import usable_subapertures

Floats = NDArray[np.float64]
Progress = Callable[[int, int], None]
"""Called with the number of finished and of all trainings (kinds times classes)."""

_HELD_OUT = 0.2  # of the frames, on which the error is measured
_FEWEST_IMAGES = 100  # of a kind and class
_MOST_SPLIT_IMAGES = 100_000  # of a kind and class beyond which there is one draw only: bounds the memory


@dataclass(frozen=True)
class _Splitter:
    """Splitter of images into two parts with uncorrelated noise."""

    fraction: float
    read_variance: float
    """Photo-electrons squared."""
    excess_noise: float
    smoothing_px: float
    start: str
    search_range_px: float
    target_radius_px: float

    def sample(
        self,
        images: Floats,
        flux: Floats,
        subaperture_flux: Floats,
        reference: Floats,
        rng: np.random.Generator,
    ) -> tuple[Sample, Floats]:
        """Split images (n, ny, nx) once; return the sample and the variance (n, 2) of its positions' noise.

        With p the fraction, A = p g + z and B = (1 - p) g - z, where z has the variance p (1 - p) v and v is
        an unbiased estimate of the variance of g in its pixel: A and B do not covary on average. Where noise
        makes v negative, z is zero; the covariance that this leaves is taken off the regression's moments.
        """
        p = self.fraction
        variance = self.variance(images)
        usable = np.maximum(variance, 0.0)
        z = rng.standard_normal(images.shape) * np.sqrt(p * (1 - p) * usable)
        part_a = p * images + z
        lever = self.levers(images.shape[1:], reference)
        weights = (
            lever / subaperture_flux[:, None, None, None]
        )  # of the pixels, in the centre of gravity: (n, 2, ny, nx)
        moments = np.einsum("naij,nij->na", weights, images * (1 - p) - z) / (1 - p)
        target_variance = (1 - p) ** 2 * variance + p * (1 - p) * usable
        noise = np.einsum("naij,nij->na", weights**2, target_variance) / (1 - p) ** 2
        start = reference
        if self.start == "peak":
            start = smoothed_peak(part_a, self.smoothing_px, reference, self.search_range_px)
        illuminated = flux[:, None, None]
        sample = Sample(
            (part_a / (p * illuminated)).astype(np.float32),
            reference + moments,
            start,
            reference - self.search_range_px,
            reference + self.search_range_px,
            (weights * ((variance - usable) / illuminated)[:, None]).astype(np.float32),
        )
        return sample, noise

    def variance(self, images: Floats) -> Floats:
        """Unbiased estimate of the variance of each pixel; negative where noise is."""
        variance: Floats = self.excess_noise * images + self.read_variance
        return variance

    def near(self, shape: tuple[int, ...], reference: Floats) -> NDArray[np.bool_]:
        """Return the mask of pixels that count in the centre of gravity: (n, ny, nx)."""
        x, y = _distances(shape, reference)
        near: NDArray[np.bool_] = np.hypot(x, y) <= self.target_radius_px
        return near

    def levers(self, shape: tuple[int, ...], reference: Floats) -> Floats:
        """Distance of the pixels that count from the reference in x and y, else 0: (n, 2, ny, nx)."""
        levers: Floats = np.stack(_distances(shape, reference), axis=1)
        return levers * self.near(shape, reference)[:, None]


def _distances(shape: tuple[int, ...], reference: Floats) -> tuple[Floats, Floats]:
    """Distance of each pixel from the reference in x and y: (n, ny, nx) each."""
    ny, nx = shape
    y = np.arange(ny) - 0.5 * (ny - 1) - reference[:, 1:]
    x = np.arange(nx) - 0.5 * (nx - 1) - reference[:, :1]
    x, y = np.broadcast_arrays(x[:, None, :], y[:, :, None])
    return x, y


def train_from_frames(
    frames: ArrayLike,
    layout: Layout,
    calibration: Calibration,
    *,
    reference: ArrayLike = 0.0,
    search_range_px: float | None = None,
    start: str = "peak",
    smoothing_px: float = 1.3,
    symmetry: str = "round",
    node_spacing_px: float = 0.5,
    index: ArrayLike | None = None,
    passes: int = 3,
    fraction: float = 0.7,
    draws: int = 8,
    target_radius_px: float | None = None,
    rng: np.random.Generator | None = None,
    progress: Progress | None = None,
) -> TrainedScore:
    """Train the linear score on recorded frames, without knowing where their spots are.

    Each image is split into two parts whose noises are not correlated. The regression's features come from
    one, its target is the centre of gravity of the other: that is noisy, but right on average, and the
    regression needs no more. The features' part has less flux; its photon and read noise keep their
    proportion, and the score is meant for the whole images' flux, for which it is a little too cautious. The
    standard errors are those of the part, which has more noise than whole images. Where images are few and
    the read noise high they are rough, and have come out a third too small.

    Near the diffraction limit and with `target_radius_px` = 5, 16,000 images give errors from 1 % (50 e-,
    0.1 e- read noise) to 10 % (100 e-, 3 e-) above those of training with a known truth, 4,000 images 3 % to
    26 %. Without a radius the loss is 60 % and 225 % at 100 e-, 3 e-.

    Parameters
    ----------
    frames : (n_frames, h, w) array, ADU
        Spots must move from frame to frame as they will in use: that is the prior. Values must be neither
        rounded to electrons nor clipped at the dark level. Sub-apertures that are dark, limited or unlike
        their neighbours are left out, which a warning says.
    layout : Layout
    calibration : Calibration
        Its read noise must be known; that, background and multiplication gain give the images' noise.
    reference : array that broadcasts to (n_subapertures, 2)
        Reference positions, px from the window's centre.
    search_range_px : float, optional
        Estimates stay within plus and minus this around the reference. Default: half the longer side.
    start : {"reference", "peak"}
        Where the first pass starts: at the reference, or at the peak of the smoothed image.
    smoothing_px : float
        Standard deviation of the smoothing for start "peak".
    symmetry : {"round", "aligned", "point"}
        Of the spots: x and y alike; each alike when mirrored, as when elongated along rows or columns; only
        alike when turned by half a turn.
    node_spacing_px : float
        Distance of the spline's nodes: 0.5 for spots near the diffraction limit, 1 for wider ones, or where
        images are few and the read noise high.
    index : (n_subapertures,) array of int, optional
        Kind of each sub-aperture, each trained on its own images, of which it wants some thousands. Default:
        all together.
    passes : int
        1 to 8.
    fraction : float
        Part of the flux that the features are made of.
    draws : int
        Times that each image is split, at most: more help as long as images are few, so that there are fewer
        draws of more than 10,000 images or so.
    target_radius_px : float, optional
        Pixels farther from the reference are left out of the centre of gravity: much less read noise, and a
        gain that is smaller by the flux that moves across the border. 5 px suits spots that are not
        speckled; speckled ones want all pixels. Default: no limit.
    rng : numpy.random.Generator, optional
        Where the splits come from.
    progress : callable, optional
        Called after every class with the number of finished trainings and of all.

    Returns
    -------
    TrainedScore
        With classes of at most a factor 3 in the frames' mean flux.

    Raises
    ------
    InputError
        For frames that are not finite or without flux, too few images, or a value out of range.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> from faintspot.slopes.training import train_from_frames
    >>> rng = np.random.default_rng(1)
    >>> images, _ = fs.slopes.simulate.subapertures(4000, shape=(8, 8), flux_e=200.0, rng=rng)
    >>> layout, camera = fs.Layout.grid((1, 1), pixels=8), fs.Calibration(read_noise_e=0.1)
    >>> score = train_from_frames(images, layout, camera, rng=np.random.default_rng(2))
    >>> print(score.standard_error(200.0).round(2))
    [[0.06 0.06]]
    """
    stack, home = _images_and_reference(frames, layout, calibration, reference)
    half = 0.5 * max(stack.shape[2:]) if search_range_px is None else search_range_px
    radius = stack.shape[2] + stack.shape[3] if target_radius_px is None else target_radius_px
    splitter = _Splitter(
        fraction=number_between("fraction", fraction, 0.05, 0.95),
        read_variance=_read_variance(calibration),
        excess_noise=calibration.excess_noise,
        smoothing_px=number_between("smoothing_px", smoothing_px, 0.0, 32.0),
        start=one_of("start", start, STARTS),
        search_range_px=number_between("search_range_px", half, 0.0, low_open=True),
        target_radius_px=number_between("target_radius_px", radius, 1.0),
    )
    spacing = number_between("node_spacing_px", node_spacing_px, 0.25, 4.0)
    farthest = 0.5 * max(stack.shape[2:]) + splitter.search_range_px
    basis = splines_for(spacing, farthest, one_of("symmetry", symmetry, SYMMETRIES))
    n_passes = int(number_between("passes", passes, 1, MOST_PASSES, integer=True))
    n_draws = int(number_between("draws", draws, 1, integer=True))
    kinds = _checked_kinds(index, stack.shape[1])
    usable, left_out = usable_subapertures(np.asarray(frames), layout, calibration)
    if left_out:
        warnings.warn(f"score: {left_out}", stacklevel=2)
    recorded, kinds_used = _Recorded.of(stack[:, usable], splitter, home[usable]), kinds[usable]
    levels, flux_e = recorded.classes()
    trained = []
    n_kinds = int(kinds.max()) + 1
    for number, kind_rng in enumerate(spawn(rng, n_kinds * len(flux_e))):
        kind, level = divmod(number, len(flux_e))
        members = (np.flatnonzero(levels == level), np.flatnonzero(kinds_used == kind))
        trained.append(recorded.train(members, splitter, basis, n_passes, n_draws, kind_rng))
        if progress is not None:
            progress(number + 1, n_kinds * len(flux_e))
    tables, errors = (np.stack(part) for part in zip(*trained, strict=True))
    return TrainedScore(
        tables=tables.reshape(n_kinds, len(flux_e), *tables.shape[1:]),
        flux_e=flux_e,
        standard_error_px=errors.reshape(n_kinds, len(flux_e), 2),
        steps_per_px=STEPS_PER_PX,
        start=start,
        smoothing_px=smoothing_px,
        index=None if index is None else kinds,
    )


@dataclass(frozen=True)
class _Recorded:
    """Recorded images with their flux."""

    images: Floats
    """(n_frames, n_subapertures, ny, nx)."""
    flux: Floats
    """(n_frames,): mean of the windows' sums."""
    relative_flux: Floats
    """(n_subapertures,): light within the target's radius, in units of the frame's flux."""
    reference: Floats
    """(n_subapertures, 2)."""

    @classmethod
    def of(cls, images: Floats, splitter: _Splitter, reference: Floats) -> _Recorded:
        """Measure the flux."""
        flux = images.sum(axis=(2, 3)).mean(axis=1)
        near = splitter.near(images.shape[2:], reference)
        relative = np.sum(images.mean(axis=0) * near, axis=(1, 2))
        if flux.min() <= 0 or relative.min() <= 0:
            raise InputError(
                f"frames: expected flux in every frame and sub-aperture, got {flux.min():.3g} e- a spot "
                f"in the faintest frame and {relative.min():.3g} e- in the faintest sub-aperture"
            )
        return cls(images, flux, relative / flux.mean(), reference)

    def classes(self) -> tuple[NDArray[np.int64], Floats]:
        """Class of each frame, and the classes' mean fluxes; none without frames."""
        borders = flux_classes((self.flux.min(), self.flux.max()))[1:, 0]
        _, levels = np.unique(np.searchsorted(borders, self.flux), return_inverse=True)
        counts = np.bincount(levels)
        flux: Floats = np.exp(np.bincount(levels, weights=np.log(self.flux)) / counts)
        return levels, flux

    def train(
        self,
        members: tuple[NDArray[np.int64], NDArray[np.int64]],
        splitter: _Splitter,
        basis: SplineTables,
        passes: int,
        draws: int,
        rng: np.random.Generator,
    ) -> tuple[NDArray[np.float32], Floats]:
        """Train one kind and class on some frames and sub-apertures: tables and errors (2,) in px."""
        frames, subapertures = members
        held_out = max(1, round(_HELD_OUT * len(frames)))
        if (len(frames) - held_out) * len(subapertures) < _FEWEST_IMAGES:
            raise InputError(
                f"frames: expected at least {_FEWEST_IMAGES} images of each kind and flux class to train on, "
                f"got {(len(frames) - held_out) * len(subapertures)}"
            )
        train_rng, error_rng = spawn(rng, 2)
        draws = max(1, min(draws, _MOST_SPLIT_IMAGES // (len(frames) * len(subapertures))))
        parts = [
            self.split(frames[:-held_out], subapertures, splitter, draw)[0]
            for draw in spawn(train_rng, draws)
        ]
        tables = fit_passes(Sample.together(parts), basis, passes)
        return tables, self.standard_error(
            frames[-held_out:], subapertures, splitter, basis, tables, error_rng
        )

    def standard_error(
        self,
        frames: NDArray[np.int64],
        subapertures: NDArray[np.int64],
        splitter: _Splitter,
        basis: SplineTables,
        tables: NDArray[np.float32],
        rng: np.random.Generator,
    ) -> Floats:
        """Measure the error (2,) of a part's positions, px; never below what the last pass's noise gives."""
        sample, target_noise = self.split(frames, subapertures, splitter, rng)
        final, errors = sample.rms_errors(tables)
        squares = errors[-1] ** 2 - target_noise.mean(axis=0)
        images, flux = self.flux_of(frames, subapertures)[:2]
        variance = np.maximum(splitter.variance(images), 0.0) / (splitter.fraction * flux**2)[:, None, None]
        least = table_sums(variance, final, tables[-1] ** 2, STEPS_PER_PX).mean(axis=0)
        if basis.symmetry == "round":
            squares, least = np.full(2, squares.mean()), np.full(2, least.mean())
        standard_error: Floats = np.sqrt(np.maximum(squares, least))
        return standard_error

    def flux_of(
        self, frames: NDArray[np.int64], subapertures: NDArray[np.int64]
    ) -> tuple[Floats, Floats, Floats]:
        """Images of some frames and sub-apertures, their expected flux, and their flux within the radius."""
        images = self.images[np.ix_(frames, subapertures)].reshape(-1, *self.images.shape[2:])
        flux = np.repeat(self.flux[frames], len(subapertures))
        return images, flux, flux * np.tile(self.relative_flux[subapertures], len(frames))

    def split(
        self,
        frames: NDArray[np.int64],
        subapertures: NDArray[np.int64],
        splitter: _Splitter,
        rng: np.random.Generator,
    ) -> tuple[Sample, Floats]:
        """Split the images of some frames and sub-apertures once."""
        reference = np.tile(self.reference[subapertures], (len(frames), 1))
        return splitter.sample(*self.flux_of(frames, subapertures), reference, rng)


def _images_and_reference(
    frames: ArrayLike, layout: Layout, calibration: Calibration, reference: ArrayLike
) -> tuple[Floats, Floats]:
    """Electrons (n_frames, n_subapertures, ny, nx), and references (n_subapertures, 2) from the windows."""
    raw = real_array("frames", frames)
    if raw.ndim != 3:
        raise InputError(f"frames: expected shape (n, h, w), got {raw.shape}")
    if layout.bin > 1:
        raise InputError(
            f"layout.bin = {layout.bin}: expected 1, spots are learnt from frames that are not binned"
        )
    images = SlopePipeline(layout, Settings("brightest"), calibration).explain(raw).calibrated
    home = finite_array("reference", reference).astype(np.float64)
    if home.shape not in ((), (2,), (len(layout), 2)):
        raise InputError(f"reference: expected shape ({len(layout)}, 2), got {home.shape}")
    return images.astype(np.float64), np.broadcast_to(home, (len(layout), 2)) + layout.offsets


def _read_variance(calibration: Calibration) -> float:
    """Variance of an unlit pixel, photo-electrons squared."""
    read_noise = calibration.read_noise_photoelectrons
    if read_noise is None:
        raise InputError("calibration.read_noise_e: expected a number (electrons), got none")
    return read_noise**2 + calibration.excess_noise * calibration.background_e


def _checked_kinds(index: ArrayLike | None, n_subapertures: int) -> NDArray[np.int64]:
    """Kind of each sub-aperture; every kind has some."""
    if index is None:
        return np.zeros(n_subapertures, np.int64)
    kinds = numbers_between("index", index, 0, 2**31, integer=True).astype(np.int64)
    if kinds.shape != (n_subapertures,) or len(np.unique(kinds)) != kinds.max() + 1:
        raise InputError(
            f"index: expected {n_subapertures} kinds, counted from 0 without gaps, got shape {kinds.shape}"
        )
    return kinds
