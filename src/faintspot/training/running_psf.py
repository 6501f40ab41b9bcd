"""A PSF that follows the sensor: learnt on, frame by frame, with the past slowly forgotten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from faintspot.base.checks import finite_array, number_between, numbers_between
from faintspot.base.errors import InputError
from faintspot.camera.calibration import Calibration
from faintspot.sensor.layout import Layout
from faintspot.spots.psf import PSF
from faintspot.training.psf_learning import checked_options, frame_stack, image_stack
from faintspot.training.psf_rounds import LearningOptions, State, refitted, registered, stacked
from faintspot.training.registration import Floats, Registered, Stack, Tables, start
from faintspot.training.stacking import Sums

_OVERSAMPLING = 4
_DRAWS = 4  # of each spot's position


class RunningPSF:
    """A PSF learnt on while the sensor runs.

    Every update registers the new spots with the PSF so far, and adds them to sums in which older spots
    count less and less; from time to time the PSF is fitted anew.

    Parameters
    ----------
    psf : PSF
        To begin with: learnt before, analytic, or a guess.
    layout : Layout, optional
        Of the frames that `update` gets. Without it `update` gets stacks of images of single spots.
    calibration : Calibration, optional
        Default: frames are in electrons already.
    forgetting : float
        Factor on the weight of all earlier spots at each update, above 0 up to 1: after 1 / (1 - forgetting)
        updates a spot counts a third.
    refit_every : int
        Updates from one fit to the next. A fit takes some hundredths of a second for each PSF.
    rng : numpy.random.Generator, optional

    Raises
    ------
    InputError
        For values out of range.

    Examples
    --------
    >>> import numpy as np, faintspot as fs
    >>> images, _ = fs.simulate.subapertures(2000, shape=(8, 8), flux_e=200.0, rng=np.random.default_rng(1))
    >>> guess = fs.PSF.analytic(size=1.5)
    >>> running = fs.RunningPSF(guess, refit_every=1)
    >>> for block in np.split(images, 10):
    ...     psf = running.update(block)
    >>> print(f"{guess.fwhm_px.mean():.1f} -> {psf.fwhm_px.mean():.1f} px")
    2.7 -> 1.9 px
    """

    def __init__(
        self,
        psf: PSF,
        layout: Layout | None = None,
        *,
        calibration: Calibration | None = None,
        forgetting: float = 0.99,
        refit_every: int = 10,
        rng: np.random.Generator | None = None,
    ) -> None:
        self.layout = layout
        self.calibration = Calibration() if calibration is None else calibration
        self.forgetting = number_between("forgetting", forgetting, 0.0, 1.0, low_open=True)
        self.refit_every = int(number_between("refit_every", refit_every, 1, 2**31, integer=True))
        self._rng = np.random.default_rng() if rng is None else rng
        self._index = psf.index
        self._state = State(psf, np.zeros(len(psf.samples)))
        self._sums: list[tuple[Sums, Sums]] = []
        self._count = np.zeros(len(psf.samples))
        self._chosen_with = 0.0
        self._updates = 0

    @property
    def psf(self) -> PSF:
        """The PSF so far, with the index of the one that it began with."""
        return PSF(self._state.psf.samples, self._state.psf.oversampling, self._index)

    @property
    def background_e(self) -> NDArray[np.float64]:
        """Constant flux left in the images, electrons per pixel, for each PSF."""
        return self._state.background_e.copy()

    def update(
        self, frames: ArrayLike, positions: ArrayLike | None = None, *, index: ArrayLike | None = None
    ) -> PSF:
        """Learn from a frame (h, w) or frames (n, h, w), or without a layout from images (n, ny, nx).

        Parameters
        ----------
        frames : array
        positions : (n_spots, 2) array, optional
            Where the spots are, to half a pixel or so: x and y, px from each window's centre; all spots of
            the first frame, then of the next. Default: looked for.
        index : (n_spots,) array of int, optional
            Which PSF each spot has. Default: what the first PSF's own index says.

        Returns
        -------
        PSF
            As the attribute `psf`.

        Raises
        ------
        InputError
            For frames, positions or an index of the wrong shape.
        """
        if self.layout is None:
            stack = image_stack(frames, self.calibration)
        else:
            stack = frame_stack(frames, self.layout, self.calibration)
        n, ny, nx = stack.images.shape
        options = checked_options((ny, nx), _OVERSAMPLING)
        kinds = self._kinds(n, index)
        found = (
            None
            if positions is None
            else self._placed(stack, kinds, _checked_positions(positions, n), options)
        )
        state = replace(self._state, found=found)
        state = registered(stack, kinds, state, options)
        halves = self._rng.permutation(n) % 2 == 0
        sums, count = stacked(stack, kinds, state, halves, _DRAWS, options, self._rng)
        self._add(sums, count)
        self._updates += 1
        if self._updates % self.refit_every == 0:
            # The more is known, the freer the PSF may be: ask again when there is twice as much.
            choose = self._count.sum() > 2 * self._chosen_with
            state = refitted(self._sums, self._count, state, choose, options, self._rng)
            self._chosen_with = float(self._count.sum()) if choose else self._chosen_with
        self._state = state
        return self.psf

    def _add(self, sums: list[tuple[Sums, Sums]], count: NDArray[np.int64]) -> None:
        if self._sums:
            sums = [
                (old[0].combined(new[0], self.forgetting), old[1].combined(new[1], self.forgetting))
                for new, old in zip(sums, self._sums, strict=True)
            ]
        self._sums = sums
        self._count = self.forgetting * self._count + count

    def _kinds(self, n: int, index: ArrayLike | None) -> NDArray[np.int64]:
        """The PSF of every spot."""
        if index is not None:
            kinds = numbers_between("index", index, 0, len(self._count) - 1, integer=True)
        elif self._index is None:
            kinds = np.zeros(n, np.int64)
        else:
            kinds = np.tile(self._index, max(1, n // len(self._index)))
        if kinds.shape != (n,):
            raise InputError(f"index: expected one number for each of {n} spots, got shape {kinds.shape}")
        return kinds

    def _placed(
        self, stack: Stack, kinds: NDArray[np.int64], positions: Floats, options: LearningOptions
    ) -> Registered:
        """Spots at given positions, with the flux that the images' height tells."""
        psf = self._state.psf
        tables = Tables.of(psf, options.radius_px)
        found = start(stack, tables, kinds, psf.fwhm_px, options.search_px)
        return replace(found, positions=np.clip(positions, -options.search_px, options.search_px))


def _checked_positions(positions: ArrayLike, n: int) -> Floats:
    array = finite_array("positions", positions).astype(np.float64)
    if array.shape != (n, 2):
        raise InputError(f"positions: expected shape ({n}, 2), got {array.shape}")
    return array
