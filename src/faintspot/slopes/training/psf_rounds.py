"""Learning PSFs round by round: register every spot with the PSF so far, stack, fit, again."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from faintspot.base.arrays import Floats
from faintspot.base.errors import InputError
from faintspot.base.flags import KEEPABLE, SubapertureFlag, leave_out
from faintspot.base.statistics import FWHM_TO_STD
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.frame_checks import MeanFrame
from faintspot.slopes.pipeline.light import MeanLight
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.pipeline.slope_pipeline import SlopePipeline
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.psf_fit import FIRST_FORM, choose_form, fit_psf, samples_of
from faintspot.slopes.training.registration import (
    Integers,
    PSFTables,
    Registered,
    Stack,
    Sums,
    register,
    stack_spots,
    start,
)

_START_WIDTHS_PX = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
_START_SPOTS = 500
_START_STEPS, _LATER_STEPS = 5, 3
_DRAWN_SPOTS = 5000  # spots times draws of each: with fewer, the draws' own noise would count
_CHOICES = 2  # last rounds but one in which the form is chosen
_PSFS_COMPARED = 4
_LARGEST_ERROR_PX = 1.0
FEWEST_SPOTS = 20
_TELLING_ATTENUATION = 0.3
_NARROW, _HOPELESS = 0.8, 0.97  # mean resultant length of the phases: spread of 0.11 px and 0.04 px


@dataclass(frozen=True)
class LearningOptions:
    """Options of PSF learning; see `faintspot.slopes.training.psf_learning`."""

    radius_px: int
    oversampling: int
    rounds: int
    search_px: float


def gaussian_psf(fwhm_px: float, options: LearningOptions) -> PSF:
    """Return a round Gaussian PSF, pixels included."""
    std = np.hypot(fwhm_px * FWHM_TO_STD, 1 / np.sqrt(12))
    reach = options.radius_px * options.oversampling
    profile = np.exp(-0.5 * (np.arange(-reach, reach + 1) / options.oversampling / std) ** 2)
    return PSF(np.outer(profile, profile), options.oversampling)


def measured_width(stack: Stack) -> float:
    """Return the FWHM of the Gaussian that the images answer to most strongly, px."""
    images = stack.images[:: max(1, len(stack.images) // _START_SPOTS)]

    def response(fwhm_px: float) -> float:
        std = fwhm_px * FWHM_TO_STD
        peaks = scipy.ndimage.gaussian_filter(images, std, mode="constant", axes=(1, 2)).max(axis=(1, 2))
        return std * float(peaks.mean())  # a kernel of unit energy: the noise is the same at all widths

    return max(_START_WIDTHS_PX, key=response)


class Learning:
    """PSFs that are learnt round by round from spots, with the background of each.

    Parameters
    ----------
    stack : Stack
    index : (n,) array of int
        PSF of each spot.
    psf : PSF
        PSFs to begin with.
    options : LearningOptions
    """

    def __init__(self, stack: Stack, index: Integers, psf: PSF, options: LearningOptions) -> None:
        self.stack, self.index, self.psf, self.options = stack, index, psf, options
        self.background_e = np.zeros(len(psf.samples))
        """Electrons per pixel, for each PSF."""
        self.form = FIRST_FORM
        self.spots: Registered | None = None

    def part(self, batch: Integers, index: Integers) -> Learning:
        """Return the learning of a batch of PSFs; where there is one PSF so far, every one begins with it.

        Parameters
        ----------
        batch : (n_psfs,) array of int
        index : (n,) array of int
            PSF of each spot.
        """
        first = batch if len(self.psf.samples) > 1 else np.zeros_like(batch)
        chosen = np.flatnonzero((index >= batch[0]) & (index <= batch[-1]))
        if chosen.size == 0:
            raise InputError(f"index: expected spots for each PSF, got none for {batch[0]} to {batch[-1]}")
        psf = psf_of(self.psf.samples[first], self.psf.oversampling)
        part = Learning(self.stack.part(chosen), index[chosen] - batch[0], psf, self.options)
        part.background_e, part.form = self.background_e[first], self.form
        part.spots = None if self.spots is None else self.spots.part(chosen)
        return part

    def learn(self, rounds: int, rng: np.random.Generator, progress: Callable[[], object]) -> None:
        """Register the spots and fit the PSFs, that many times.

        Raises
        ------
        InputError
            When too few spots are bright enough.
        """
        halves = rng.permutation(len(self.index)) % 2 == 0
        draws = -(-_DRAWN_SPOTS // len(self.index))
        for to_come in reversed(range(rounds)):
            spots, tables = self.register()
            good = bright_enough(spots)
            if good.sum() < FEWEST_SPOTS:
                raise InputError(
                    f"images: expected at least {FEWEST_SPOTS} spots whose position can be measured to "
                    f"{_LARGEST_ERROR_PX:g} px, got {good.sum()} of {len(good)}"
                )
            stack, index, spots = self.stack.part(good), self.index[good], spots.part(good)
            sums = stack_spots(stack, tables, index, spots, self.background_e, halves[good], draws, rng)
            count = np.bincount(index, minlength=len(sums))
            if 0 < to_come <= _CHOICES:
                self._choose_form(sums, count, rng)
            self._refit(tables, sums, count)
            progress()

    def register(self) -> tuple[Registered, PSFTables]:
        """Measure the spots anew; return them and the tables of the PSFs."""
        tables, search_px = PSFTables.of(self.psf, self.options.radius_px), self.options.search_px
        images = self.stack.without(self.background_e[self.index])
        spots, steps = self.spots, _LATER_STEPS
        if spots is None:
            spots, steps = start(images, tables, self.index, self.psf.fwhm_px, search_px), _START_STEPS
        self.spots = register(images, tables, self.index, spots, search_px, steps)
        return self.spots, tables

    def _choose_form(self, sums: list[tuple[Sums, Sums]], count: Integers, rng: np.random.Generator) -> None:
        """Choose how freely the PSFs follow the data, from some with enough spots."""
        enough = np.flatnonzero(count >= FEWEST_SPOTS)
        if enough.size:
            compared = rng.permutation(enough)[:_PSFS_COMPARED]
            n_spots = float(count[compared].sum())
            self.form = choose_form([sums[i] for i in compared], n_spots, self.options.radius_px)

    def _refit(self, tables: PSFTables, sums: list[tuple[Sums, Sums]], count: Integers) -> None:
        """Fit the PSFs to the sums of so many spots each; one with too few spots stays unchanged."""
        options, samples = self.options, []
        for i, (first, second) in enumerate(sums):
            plane: Floats = tables.value[i].astype(np.float64)
            if count[i] >= FEWEST_SPOTS:
                fit = fit_psf(first.combined(second), self.form, options.radius_px)
                if fit.plane.sum() > 0:
                    plane, self.background_e[i] = fit
            samples.append(samples_of(plane, options.radius_px, options.oversampling))
        self.psf = psf_of(np.stack(samples), options.oversampling)


def bright_enough(spots: Registered) -> NDArray[np.bool_]:
    """Return which spots tell their position."""
    return np.all(spots.error_px < _LARGEST_ERROR_PX, axis=1)  # type: ignore[no-any-return]


def psf_of(samples: Floats, oversampling: int) -> PSF:
    """Return the PSFs with these samples."""
    return PSF(samples, oversampling, np.arange(len(samples)) if len(samples) > 1 else None)


def check_phases(index: Integers, spots: Registered) -> None:
    """Warn when spots lie at too few sub-pixel phases for the PSF between the pixels to be seen.

    Their spread follows from the phases' mean resultant length, with the part of it taken out that errors of
    the registration explain.

    Raises
    ------
    InputError
        When all PSFs' spots lie at one phase.
    """
    good = bright_enough(spots)
    kinds, count = index[good], np.bincount(index[good])
    narrow, hopeless = np.zeros((2, len(count)), bool)
    used = np.maximum(count, 1)
    for axis in range(2):
        turn = np.exp(2j * np.pi * spots.positions[good, axis])
        length = np.abs(np.bincount(kinds, turn.real) + 1j * np.bincount(kinds, turn.imag)) / used
        loss = np.bincount(kinds, np.exp(-2 * (np.pi * spots.error_px[good, axis]) ** 2)) / used
        sure = length - 2 * (1 - length**2) / np.sqrt(2 * used)  # less two standard errors
        telling = (loss > _TELLING_ATTENUATION) & (count >= FEWEST_SPOTS)
        narrow |= telling & (sure > _NARROW * loss)
        hopeless |= telling & (sure > _HOPELESS * loss)
    hint = "move the spots by fractions of a pixel, or learn one PSF for many sub-apertures"
    if hopeless[count > 0].all():
        raise InputError(f"frames: expected spots at many sub-pixel positions, got one for each PSF; {hint}")
    if narrow.any():
        warnings.warn(
            f"{np.count_nonzero(narrow)} of {len(count)} PSFs: spots differ by less than about 0.1 px in "
            f"sub-pixel position, so the PSF between the pixels is a guess; {hint}",
            stacklevel=3,
        )


_CLEARLY_LIT = 5.0  # of the median sub-aperture: a fifth of its flux would still show
_DOUBTFUL = (SubapertureFlag.TOO_MANY_BAD_PIXELS, *KEEPABLE.values())


def usable_subapertures(
    frames: NDArray[np.generic], layout: Layout, calibration: Calibration
) -> tuple[NDArray[np.bool_], str]:
    """Return which sub-apertures show spots, (n,), and the line that says which are left out.

    A sub-aperture is left out if the mean frame shows it dark while most are clearly lit, or if most frames
    flag its slope as limited, unlike its neighbours', or of too many bad pixels.

    Parameters
    ----------
    frames : (h, w) or (n_frames, h, w) array, ADU
    layout : Layout
    calibration : Calibration

    Raises
    ------
    InputError
        If none is left.
    """
    pipeline = SlopePipeline(layout, Settings("brightest"), calibration)
    frames = frames.reshape(-1, *layout.frame_shape)
    found = pipeline(frames).flags
    flags = np.zeros(len(layout), np.uint8)
    for flag in _DOUBTFUL:
        flags[2 * np.count_nonzero(found & flag, axis=0) > len(found)] |= int(flag)
    light = MeanLight(layout, pipeline.light_test.maps, pipeline.plan.typical_fwhm_px)
    mean = MeanFrame(layout.frame_shape)
    mean.add(frames)
    significance = light.significances(mean.mean)
    if np.median(significance) > _CLEARLY_LIT:
        flags[significance < 1.0] |= int(SubapertureFlag.NO_FLUX)
    usable, line = leave_out(flags)
    if not usable.any():
        raise InputError(f"frames: expected spots in the sub-apertures, {line}")
    return usable, line
