"""Spots that a question is about: their shape, and simulated images of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.base.generators import spawn
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX, spots
from faintspot.slopes.spots.speckled import speckled_spots

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Spots:
    """Spots in windows, of a profile or of a PSF."""

    shape: tuple[int, int]
    """Rows and columns of a window."""
    fwhm_px: float
    """Width of the optical spot, without the pixels' own blur."""
    profile: str
    psf: PSF | None
    """PSF instead of the profile."""
    d_over_r0: float
    """Side of the sub-aperture over r0 at the sensor's wavelength, 0 where that makes no speckles."""
    search_range_px: float
    """Spots are within plus and minus this of the reference on each axis, and all estimators know it."""
    relative_flux: Floats | None
    """(n,): flux of sub-apertures in units of their mean; None: all have the same."""

    @property
    def size(self) -> float:
        """Size of the profile, see `faintspot.slopes.spots.shapes`."""
        return float(self.fwhm_px / FWHM_OF_SIZE_1_PX[self.profile])

    @property
    def form(self) -> dict[str, Any]:
        """Shape of a spot by the names that simulations and bounds give it."""
        of_spot = {"profile": self.profile, "size": self.size} if self.psf is None else {"psf": self.psf}
        return {"shape": self.shape, **of_spot}

    def known_psf(self, radius_px: float) -> PSF:
        """Return the PSF, or that of the profile as far as a radius."""
        if self.psf is not None:
            return self.psf
        return PSF.analytic(self.profile, size=self.size, radius_px=radius_px)

    def simulated(self, n: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return images (n, ny, nx) of spots and their positions (n, 2), px.

        A spot that is not speckled and in the middle of its window leaves 1 e- in it, on average where
        sub-apertures differ in their flux.
        """
        images, positions = self._even(n, rng)
        if self.relative_flux is not None:
            images = images * spawn(rng, 1)[0].choice(self.relative_flux, n)[:, None, None]
        return images, positions

    def _even(self, n: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Return such spots, all of the same flux."""
        position_rng, phase_rng = spawn(rng, 2)
        positions = position_rng.uniform(-self.search_range_px, self.search_range_px, (n, 2))
        middle = np.zeros((1, 2))
        if self.psf is not None:
            index = phase_rng.integers(0, len(self.psf.samples), n)
            images = self.psf.images(positions, self.shape, which=index)
            flux = self.psf.images(np.repeat(middle, n, axis=0), self.shape, which=index).sum(axis=(1, 2))
            # A learnt PSF's wings may be a little negative; light is not.
            return np.maximum(images / flux[:, None, None], 0.0), positions
        flux = spots(middle, **self.form).sum()
        if not self.d_over_r0:
            return spots(positions, **self.form) / flux, positions
        images, _ = speckled_spots(
            n,
            d_over_r0=self.d_over_r0,
            shape=self.shape,
            size=self.size,
            positions=positions,
            rng=phase_rng,
        )
        return images / flux, positions
