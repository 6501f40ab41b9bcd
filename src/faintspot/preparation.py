"""What a pipeline computes once, before the first frame: settings and tables in the kernels' own form."""

from __future__ import annotations

import math
import threading
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from faintspot import presets, spot_tables
from faintspot.errors import InputError
from faintspot.estimate.brightest import most_kept, threshold_rank
from faintspot.estimate.total_variation import ALGORITHMS
from faintspot.kernels import fused, located
from faintspot.kernels.flat_start import NO_TABLE, flat_start_table
from faintspot.requirements import check_parts, is_auto, is_automatic
from faintspot.sensor.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.sensor.psf import PSF
from faintspot.sensor.score import TrainedScore
from faintspot.sensor.settings import Settings

METHODS = {
    "weighted": located.WEIGHTED,
    "matched": located.FITTED,
    "ml": located.FITTED,
    "map": located.POSTERIOR,
    "trained": located.TRAINED,
}
"""Estimators that know the spot, and what the kernel calls them."""
_FLUX_STEP = 1.02  # measured light counts in steps of this factor, so that settings vary slowly;
_POSTERIOR_FLUX_STEP = 1.1  # for "map" in larger ones, as each has its tables
_MOST_LIGHT_E = 9e8  # of a frame's mean sub-aperture: beyond, settings stay the same
_PIXEL_BLUR_PX2 = 0.46  # by so much a pixel raises the square of a spot's full width at half maximum
_USUAL_RANGE_PX = 1.0  # of positions, where no search range is set
_WHOLE_ELECTRONS_BELOW = 0.25  # read noise (e-) that rounding to whole electrons nearly takes away


def packed_calibration(layout: Layout, calibration: Calibration, width: int) -> NDArray[np.float32]:
    """Dark and scale of every sub-aperture's pixels in the kernel's own order, to be read as one stream.

    Shape (n_groups, pixels, 2, W); the last group repeats its last sub-aperture.
    """
    n_groups = -(-len(layout) // width)
    windows = layout.images(calibration.maps(layout.frame_shape)).reshape(2, len(layout), layout.pixels)
    lanes = windows[:, np.minimum(np.arange(n_groups * width), len(layout) - 1)]
    return np.ascontiguousarray(lanes.reshape(2, n_groups, width, layout.pixels).transpose(1, 3, 0, 2))


Arguments = tuple[NDArray[np.float32], tuple[Any, ...], tuple[int, int, int] | None]
"""What a kernel takes: tables of settings, other arguments, and the shape of its scratch memory."""


class Preparation:
    """Settings of every sub-aperture and tables of the spot, for every level of light that occurs.

    Parameters
    ----------
    layout, settings, calibration, psf, score
        As `SlopePipeline`.
    zero : (n, 2) array
        Reference positions, px from the windows' centres.
    width : int
        SIMD lanes.

    Raises
    ------
    InputError
        When the parts do not fit together.
    """

    def __init__(
        self,
        layout: Layout,
        settings: Settings,
        calibration: Calibration,
        psf: PSF | None,
        score: TrainedScore | None,
        zero: NDArray[np.float64],
        width: int,
    ) -> None:
        self._layout, self._settings, self._calibration = layout, settings, calibration
        self._psf, self._score, self._width = psf, score, width
        self._n = len(layout)
        check_parts(
            settings, calibration, psf, score, lacks_width=bool(np.isnan(self.spot_fwhm_px).any()), n=self._n
        )
        noise = calibration.read_noise_photoelectrons
        known = noise is not None
        self.round_electrons = (
            settings.estimator in ("ml", "map")
            and noise is not None
            and noise < _WHOLE_ELECTRONS_BELOW
            and calibration.em_gain == 1
            and calibration.background_e == 0
        )
        self.variance = (
            0.0 if noise is None else noise**2 + calibration.excess_noise * calibration.background_e
        )
        if self.round_electrons and noise is not None:
            # What rounding leaves: an electron too much or too little where the noise is beyond one half.
            self.variance = float(erfc(0.5 / (noise * math.sqrt(2.0)))) if noise > 0 else 0.0
        self._fixed = self._fixed_table(zero, known)
        self._tables: list[NDArray[np.float32]] = []
        self._arguments: Arguments | None = None
        self._variants: dict[int, int] = {}
        self._lock = threading.RLock()
        self._posteriors: list[spot_tables.PosteriorTables] = []
        self._extent = float(np.abs(zero).max() + self._fixed[fused.RANGE].max())
        if not self.needs_light:
            self._add(self._each("flux_e"))

    # What is asked for ------------------------------------------------------------------------------

    @property
    def estimator(self) -> str:
        """Name of the estimator."""
        return self._settings.estimator

    @property
    def steps(self) -> int:
        """Number of steps of an iterated estimator; of "trained", its passes."""
        if self.estimator == "trained":
            return 0 if self._score is None else self._score.passes
        return self._settings.steps or presets.steps(self._settings.preset, self.estimator)

    @property
    def from_peak(self) -> bool:
        """Whether the estimator begins at the smoothed image's peak."""
        if self.estimator == "trained":
            return self._score is not None and self._score.start == "peak"
        return self.estimator != "map"

    @cached_property
    def before(self) -> int:
        """What is done to an image before the centre of gravity."""
        if self.estimator == "smoothed":
            return fused.SMOOTH
        denoises = self.estimator == "cog" and np.any(self._each("denoise"))
        return fused.DENOISE if denoises else fused.NOTHING

    @cached_property
    def start(self) -> NDArray[np.float32]:
        """What the denoising's start is computed from; no elements where it begins at zero."""
        if presets.starts_flat(self._settings.preset) and self.before == fused.DENOISE:
            return flat_start_table(*self._layout.window)
        return NO_TABLE

    @property
    def needs_light(self) -> bool:
        """Whether the light must be measured in every frame."""
        automatic = is_automatic(self._settings)
        uses = self.estimator in ("map", "trained") or (automatic and self.estimator in ("cog", "smoothed"))
        return uses and self._settings.flux_e is None

    @cached_property
    def model(self) -> spot_tables.SpotModel:
        """Profiles of the spots or weights; one that is not used where none is needed."""
        window, width = self._layout.window, self._width
        if self.estimator == "weighted":
            spot = self.spot_fwhm_px
            factor = self._each("weight_fwhm_px") / np.sqrt(spot.prod(axis=1))
            weight = spot * np.where(np.isnan(factor), 1.0, factor)[:, None]
            return spot_tables.model_of_weights(weight, spot, self._psf, window, width)
        if self._psf is not None and self.estimator in METHODS:
            return spot_tables.model_of_psf(self._psf, self._n, window, width)
        spot = np.full((self._n, 2), 2.0)
        return spot_tables.model_of_weights(spot, spot, None, window, width)

    @cached_property
    def taps(self) -> NDArray[np.float32]:
        """Taps of every sub-aperture's smoothing, (n, 2, 1 + reach)."""
        if self.estimator == "smoothed":
            std = np.repeat(self._each("smoothing_px")[:, None], 2, axis=1)
            return spot_tables.gaussian_taps(std, self._layout.window)
        if self.estimator == "trained" and self._score is not None:
            std = np.full((self._n, 2), max(self._score.smoothing_px, 0.1))
            return spot_tables.gaussian_taps(std, self._layout.window)
        if self.estimator not in METHODS:
            return np.ones((self._n, 2, 1), np.float32)  # not used
        return np.ascontiguousarray(self.model.taps[self.model.index])

    @cached_property
    def score(self) -> tuple[Any, ...]:
        """Tables, steps per pixel and margin of the trained score."""
        if self._score is None or self.estimator != "trained":
            return np.zeros((1, 1, 1, 1, 2, 1, 1), np.float32), 1, 0
        return spot_tables.score_tables(self._score, self._layout.window, self._width)

    @cached_property
    def no_prior(self) -> NDArray[np.float32]:
        """The prior of slopes that nobody has predicted: 0."""
        return np.zeros((1, 2, self._n), np.float32)

    def arguments(self) -> Arguments:
        """Return what the kernel takes, made anew only where there is new light.

        Returns
        -------
        tables : (n_variants, rows, n) float32
        arguments : tuple
            What `locate_groups` takes after the prior, or `slopes_of_groups` after the variants.
        shape : (int, int, int) or None
            Of the scratch memory: rank, taps and positions of the posterior.
        """
        with self._lock:
            if self._arguments is None or len(self._arguments[0]) != len(self._tables):
                self._arguments = self._new_arguments()
            return self._arguments

    def _new_arguments(self) -> Arguments:
        tables = np.stack(self._tables)
        if self.estimator not in METHODS:
            denoising = (self.before, ALGORITHMS[self._settings.algorithm], self.start)
            return tables, (*denoising, self.taps), None
        if len(self._posteriors) > 1:
            self._posteriors = [spot_tables.joined(self._posteriors)]
        posterior = self._posteriors[0] if self._posteriors else spot_tables.NO_POSTERIOR
        arguments = (
            METHODS[self.estimator],
            self.steps,
            self.from_peak,
            self.round_electrons,
            self.taps,
            self.model.tables,
            posterior.arguments,
            self.score,
        )
        return tables, arguments, (self.model.rank, self.taps.shape[2], len(posterior.grid))

    @cached_property
    def spot_fwhm_px(self) -> NDArray[np.float64]:
        """Full width at half maximum of every spot along x and y, (n, 2); NaN where unknown."""
        along, across = (self._each(name).astype(np.float64) for name in ("spot_fwhm_px", "spot_fwhm_y_px"))
        given = np.column_stack([along, np.where(np.isnan(across), along, across)])
        if self._psf is None:
            return given
        learnt = self._psf.fwhm_px[self._psf.index_of(self._n)]
        return np.where(np.isnan(given), learnt, given)

    # Light ------------------------------------------------------------------------------------------

    def variants(self, light_e: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return the variant of frames with that much light per sub-aperture; make those that are new."""
        with np.errstate(invalid="ignore"):
            light = np.clip(np.nan_to_num(light_e, nan=1.0, posinf=_MOST_LIGHT_E), 1.0, _MOST_LIGHT_E)
        step = _POSTERIOR_FLUX_STEP if self.estimator == "map" else _FLUX_STEP
        levels = np.rint(np.log(light) / math.log(step)).astype(np.int64)
        with self._lock:  # several threads may measure frames with one pipeline
            for level in np.unique(levels).tolist():
                if level not in self._variants:
                    self._add(np.full(self._n, step**level))
                    self._variants[level] = len(self._tables) - 1
        return np.array([self._variants[level] for level in levels.tolist()], np.int64)

    def _add(self, flux_e: NDArray[np.float64]) -> None:
        """Add the settings' table of a light level."""
        table = self._fixed.copy()
        table[fused.FLUX] = np.nan_to_num(flux_e)
        if self.estimator in ("cog", "smoothed"):
            self._add_strength(table, flux_e)
        elif self.estimator == "trained" and self._score is not None:
            classes = self._score.flux_class(flux_e)
            kinds = 0 if self._score.index is None else self._score.index
            table[fused.KIND] = kinds * len(self._score.flux_e) + classes
            levels = [self._score.standard_error(float(flux)) for flux in np.unique(flux_e)]
            errors = np.stack(levels)[np.unique(flux_e, return_inverse=True)[1]]
            own = np.arange(self._n) if self._score.index is not None else 0
            errors = errors[np.arange(self._n), own]
            table[fused.TRAINED_ERROR_X], table[fused.TRAINED_ERROR_Y] = errors.T
        elif self.estimator == "map":
            table[fused.KIND] = self._add_posterior(flux_e)
        self._tables.append(table)

    def _add_posterior(self, flux_e: NDArray[np.float64]) -> NDArray[np.int64]:
        """Make the posterior's tables of a light level; return each sub-aperture's."""
        assert self._psf is not None
        planes = self._psf.index_of(self._n)
        floors = self._each("weight_floor")
        kinds, which = np.unique(np.column_stack([planes, flux_e, floors]), axis=0, return_inverse=True)
        fwhm = float(self._psf.fwhm_px.min())
        grid, spacing = spot_tables.posterior_grid(self._extent, fwhm, self._layout.window)
        made = spot_tables.posterior_tables(
            self._psf,
            kinds[:, 0].astype(np.int64),
            kinds[:, 1],
            self.variance + kinds[:, 2] * kinds[:, 1],
            self._calibration.excess_noise,
            grid,
            spacing,
            self._layout.window,
            self._width,
        )
        before = sum(len(part.tables) for part in self._posteriors)
        self._posteriors.append(made)
        return before + which.reshape(-1)

    def _add_strength(self, table: NDArray[np.float32], flux_e: NDArray[np.float64]) -> None:
        """Strength of the denoising and number of kept pixels; "auto" ones from the light."""
        settings, pixels = self._settings, self._layout.pixels
        strength = settings.noise_std
        facts: dict[str, Any] = {}
        if is_automatic(self._settings):
            from faintspot.estimate.automatic import automatic_kept_pixels, automatic_strength

            facts = {
                "flux_e": flux_e,
                "read_noise_e": self._calibration.read_noise_photoelectrons,
                "pixels": pixels,
                "excess_noise": self._calibration.excess_noise,
                "background_e": self._calibration.background_e,
                **self._spot_facts(),
            }
        if self.estimator == "cog":
            value = automatic_strength(**facts) if is_auto(strength) else self._each("noise_std")
            table[fused.STRENGTH] = np.where(self._each("denoise"), value, 0.0)
        if is_auto(settings.keep_brightest):
            method = (
                "smoothed"
                if self.estimator == "smoothed"
                else "none"
                if self.before == fused.NOTHING
                else "tv"
            )
            keep = automatic_kept_pixels(**facts, method=method)
        else:
            keep = self._each("keep_brightest")
        rules = self._each("rule")
        for rule in np.unique(rules):
            selected = rules == rule
            limit = most_kept(pixels, rule)
            if keep[selected].max() > limit:
                ny, nx = self._layout.window
                raise InputError(
                    f"settings.keep_brightest = {keep[selected].max()}: expected at most {limit} "
                    f"with rule {str(rule)!r} in windows of {ny} x {nx} pixels"
                )
            table[fused.RANK, selected] = threshold_rank(keep[selected], rule)
            table[fused.SUBTRACT, selected] = rule != "threshold"

    def _spot_facts(self) -> dict[str, Any]:
        """What the automatic rules ask about the spots: their width before the pixels blur them."""
        fwhm = self.spot_fwhm_px
        optical = np.sqrt(np.maximum(fwhm**2 - _PIXEL_BLUR_PX2, 0.25 * fwhm**2))
        reach = np.where(np.isfinite(self._fixed[fused.RANGE]), self._fixed[fused.RANGE], _USUAL_RANGE_PX)
        return {
            "spot_fwhm_px": np.sqrt(optical.prod(axis=1)),
            "elongation": optical.max(axis=1) / optical.min(axis=1),
            "position_range_px": reach,
        }

    # Once -------------------------------------------------------------------------------------------

    def _each(self, name: str) -> NDArray[Any]:
        return self._settings.values(name, self._n, self._layout.pixels)

    def _fixed_table(self, zero: NDArray[np.float64], noise_is_known: bool) -> NDArray[np.float32]:
        """The settings that do not depend on the light."""
        table = np.zeros((fused.SETTING_ROWS, self._n), np.float32)
        table[fused.ZERO_X], table[fused.ZERO_Y] = zero.T
        search = self._each("search_range_px")
        table[fused.RANGE] = np.where(np.isnan(search), np.inf, search)
        table[fused.MOST_BAD] = np.floor(self._each("max_bad_fraction") * self._layout.pixels)
        table[fused.VARIANCE] = self.variance if noise_is_known else -1.0
        excess = self._calibration.excess_noise
        table[fused.EXCESS], table[fused.ERROR_SCALE] = excess, self._each("error_scale")
        for row, name in (
            (fused.TOLERANCE, "tolerance"),
            (fused.LIMIT, "max_iterations"),
            (fused.FLOOR, "flux_floor"),
        ):
            table[row] = self._each(name)
        if self.estimator == "thresholded":
            table[fused.LEVEL], table[fused.SUBTRACT] = self._each("threshold_e"), 1.0
        if self.estimator in METHODS:
            model, index = self.model, self.model.index
            table[fused.MODEL] = index
            table[fused.START_LIGHT] = model.start_light[index]
            table[fused.GAIN_X], table[fused.GAIN_Y] = model.gain[index].T
            table[fused.LEAST_LIGHT] = self._least_light(table[fused.RANGE])
        if self.estimator in ("ml", "map"):
            table[fused.WEIGHT_FLOOR], table[fused.WEIGHT_EXCESS] = self._each("weight_floor"), excess
            table[fused.MODEL_ERROR] = self._each("model_error")
        if self.estimator == "map":
            table[fused.PRIOR_WEIGHT] = np.nan_to_num(self._each("prior_std_px") ** -2.0)
        return table

    def _least_light(self, search_range_px: NDArray[np.float32]) -> NDArray[np.float64]:
        """Light of every sub-aperture below which outliers are to be expected; 0 for "trained"."""
        if self.estimator == "trained":
            return np.zeros(self._n)
        if self._psf is None:
            widths, index = np.unique(self.spot_fwhm_px, axis=0, return_inverse=True)
            spots, index = spot_tables.gaussian_psf(widths), index.reshape(-1)
        else:
            spots, index = self._psf, self._psf.index_of(self._n)
        table: NDArray[np.float64] = np.column_stack([index, search_range_px])
        pairs, which = np.unique(table, axis=0, return_inverse=True)
        excess, side = self._calibration.excess_noise, max(self._layout.window)
        light = [
            spot_tables.least_light(spots, int(plane), self.variance, excess, float(reach), side)
            for plane, reach in pairs
        ]
        least: NDArray[np.float64] = np.array(light)[which.reshape(-1)]
        return least
