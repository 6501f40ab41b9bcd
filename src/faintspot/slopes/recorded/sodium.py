"""Sodium profile of recorded frames: fitted to their mean."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintspot.io.frames import FrameSource
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.pipeline.images import measure_images
from faintspot.slopes.pipeline.settings import Settings
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.laser_spots import LaserSpots
from faintspot.slopes.training.psf_rounds import usable_subapertures
from faintspot.slopes.training.sodium import (
    IGNORED_E2,
    KnownSodium,
    MeanImages,
    calibrated_images,
    dark_variance_e2,
)

_BLOCK_FRAMES = 20
_FITS = 2  # the first one finds the shape, with which the spots are located for the second
_SEARCH_RANGE_PX = 3.0
_LIT = 0.3  # of the median flux
MOST_FRAMES = 2000


class SodiumOfFrames(NamedTuple):
    """Sodium profile of recorded frames, and where their spots are."""

    sodium: KnownSodium
    positions_px: NDArray[np.float64]
    """x and y of the spots' centres of gravity from the window centres, (n, 2)."""
    usable: NDArray[np.bool_]
    """Whether the sub-aperture was used, (n,)."""
    left_out: str
    """Line about the sub-apertures that were not used; empty if there are none."""

    def lattice_of(self, layout: Layout) -> Layout:
        """Return the layout with centres on the lattice of the spots' centres of gravity.

        A lattice of the brightest points, as `Layout.from_frame` finds it, has the focus and the tilt of a
        profile with several peaks.
        """
        before = np.column_stack([layout.centres, np.ones(len(layout))])
        flux = self.sodium.fit.flux_e
        lit = self.usable & (flux > _LIT * np.median(flux[self.usable]))
        spots = layout.centres - layout.offsets + self.positions_px
        moved = np.linalg.lstsq(before[lit], spots[lit], rcond=None)[0]
        return replace(layout, centres=before @ moved)


def sodium_of_frames(
    source: FrameSource,
    layout: Layout,
    calibration: Calibration,
    laser: LaserSpots,
    *,
    most_frames: int = MOST_FRAMES,
    progress: Callable[[int, int], None] | None = None,
) -> SodiumOfFrames:
    """Return the sodium profile and the width of the spot that the mean of recorded frames shows.

    Parameters
    ----------
    source : FrameSource
        Frames in which spots move by less than about their width, as those of a closed loop.
    layout : Layout
        With pixel_scale_arcsec, and subaperture_m or diameter_m.
    calibration : Calibration
    laser : LaserSpots
        Its profile is the first estimate.
    most_frames : int
        Number of frames to read, from the first on.
    progress : callable, optional
        Called with the number of finished steps, frames and fits, and that of all.

    Raises
    ------
    InputError
        If the frames do not fit the layout, or show no spots that a profile fits.
    """
    star, count = laser.star_of(layout), min(source.n_frames, most_frames)
    total: NDArray[np.float64] = np.zeros((len(layout), *layout.window))
    frame: NDArray[np.float64] = np.zeros(layout.frame_shape)
    for first, block in source.blocks(0, count, _BLOCK_FRAMES):
        images, _ = calibrated_images(block, layout, calibration)
        total += images.sum(axis=0, dtype=np.float64)
        frame += block.sum(axis=0, dtype=np.float64)
        if progress is not None:
            progress(min(first + _BLOCK_FRAMES, count), count + _FITS)
    images_e, dark = total / count, dark_variance_e2(layout, calibration)
    usable, left_out = usable_subapertures(frame / count, layout, calibration)
    images_e[~usable], dark[~usable] = 0.0, IGNORED_E2
    positions, profile = _centres_of_gravity(images_e), star.focused(laser.profile)
    for fits in range(1, _FITS + 1):
        mean = MeanImages(images_e, positions, frames=count)
        sodium = KnownSodium.learnt(mean, star, profile, dark)
        located = measure_images(
            images_e.astype(np.float32),
            Settings("ml", search_range_px=_SEARCH_RANGE_PX),
            calibration=Calibration(read_noise_e=float(np.sqrt(np.median(dark[usable]))), dark=0.0),
            psf=sodium.psf(layout.window),
        )
        positions, profile = np.stack([located.x, located.y], axis=1).astype(np.float64), sodium.fit.profile
        if progress is not None:
            progress(count + fits, count + _FITS)
    return SodiumOfFrames(sodium, positions, usable, left_out)


def _centres_of_gravity(images: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x and y of mean images from their centres, (n, 2); 0 without flux."""
    rows, columns = (np.arange(side) - 0.5 * (side - 1) for side in images.shape[1:])
    lit = np.maximum(images, 0.0)
    flux = lit.sum(axis=(1, 2))
    moments = np.stack([(lit * columns).sum(axis=(1, 2)), (lit * rows[:, None]).sum(axis=(1, 2))], axis=1)
    centres = np.zeros_like(moments)
    np.divide(moments, flux[:, None], out=centres, where=flux[:, None] > 0)
    return centres
