"""Camera and optics that a user states, as options."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from faintspot.base.arrays import Floats
from faintspot.base.checks import spawn
from faintspot.base.errors import InputError
from faintspot.base.options import Options, number, setting
from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.camera.detector import Detector
from faintspot.slopes.estimators.sensor import PIXEL_BLUR_PX2
from faintspot.slopes.sensor.window_checks import LARGEST_WINDOW, SMALLEST_WINDOW
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import FWHM_OF_SIZE_1_PX, spots
from faintspot.slopes.spots.speckled import LARGEST_D_OVER_R0, speckled_spots

PROFILES = tuple(FWHM_OF_SIZE_1_PX)
SPECKLED_ABOVE = 0.7
"""Side of a sub-aperture in r0 above which spots count as speckled."""
SEEING_WAVELENGTH_NM = 500.0
"""Wavelength at which r0 is given."""

_ARCSEC = math.pi / 180 / 3600

positive = {"low": 0.0, "low_open": True}
_SPOT: dict[str, Any] = {"group": "spot", **positive}
CAMERA = ("gain_e_per_adu", "em_gain", "read_noise_e", "background_e")
"""Numbers of a camera, as of `Calibration`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class StatedCamera(Options):
    """Camera, see `Question`."""

    read_noise_e: Any = number(
        None, 0.0, 1e6, "Read noise at the camera's output, before the EM gain.", unit="e-", group="camera"
    )
    pixels: Any = number(
        None, SMALLEST_WINDOW, LARGEST_WINDOW, "Side of a window [px].", whole=True, group="camera"
    )
    gain_e_per_adu: float = setting(
        1.0, "Electrons per ADU, unless measured in the frames.", unit="e-/ADU", group="camera", **positive
    )
    em_gain: float = setting(1.0, "Gain of the multiplication register of an EMCCD.", low=1.0, group="camera")
    background_e: float = number(
        0.0, 0.0, 1e9, "Electrons of sky and dark current per pixel and frame.", unit="e-", group="camera"
    )

    @property
    def camera(self) -> Calibration:
        """The camera without its maps."""
        return Calibration(**{name: getattr(self, name) for name in CAMERA})

    @property
    def detector(self) -> Detector:
        """The camera, for simulations; its gain does not matter, as its steps are left out."""
        return Detector(self.read_noise_e, background_e=self.background_e, em_gain=self.em_gain)

    @property
    def read_noise_photoelectrons(self) -> float:
        """Read noise divided by the multiplication gain."""
        return float(self.read_noise_e / self.em_gain)


@dataclass(frozen=True, eq=False, kw_only=True)
class StatedOptics(Options):
    """Optics of the spots, see `Question`."""

    fwhm_px: Any = setting(None, "Width (FWHM) of the optical spot.", unit="px", **_SPOT)
    profile: str = setting(
        "diffraction", "Shape of the spot; diffraction is sinc^2.", choices=PROFILES, group="spot"
    )
    subaperture_m: Any = setting(None, "Side of a sub-aperture in the telescope's pupil.", unit="m", **_SPOT)
    wavelength_nm: Any = setting(None, "Wavelength of the sensor.", unit="nm", **_SPOT)
    pixel_scale_arcsec: Any = setting(None, "Side of a pixel on the sky.", unit="arcsec", **_SPOT)
    r0_m: Any = setting(
        None, "Fried parameter at 500 nm: decides whether spots are speckled.", unit="m", **_SPOT
    )

    def width(self, psf: PSF | None, largest_px: float, fwhm_px: float | None) -> tuple[float, str]:
        """Return the optical spot's full width at half maximum, px, and its profile."""
        profile = self.profile
        if psf is not None and fwhm_px is None:
            # The PSF includes the pixel, which widens it; exact for Gaussian spots.
            widths = psf.fwhm_px.mean(axis=0)
            fwhm_px = math.sqrt(max(float(widths.prod()) - PIXEL_BLUR_PX2, 0.01))
        if fwhm_px is None:
            if None in (self.subaperture_m, self.wavelength_nm, self.pixel_scale_arcsec):
                raise InputError(
                    "spot: expected fwhm_px, or subaperture_m, wavelength_nm and pixel_scale_arcsec together"
                )
            width = self.wavelength_nm * 1e-9 / self.subaperture_m / (self.pixel_scale_arcsec * _ARCSEC)
            fwhm_px, profile = width * FWHM_OF_SIZE_1_PX["diffraction"] / 2, "diffraction"
        if not (low := 0.3) <= fwhm_px <= largest_px:
            raise InputError(
                f"expected {low:g} to {largest_px:g} px, the side of a window; check subaperture_m, "
                "wavelength_nm and pixel_scale_arcsec, or pixels",
                name="fwhm_px",
                value=float(f"{fwhm_px:.4g}"),
            )
        return fwhm_px, profile

    def d_over_r0(self, profile: str) -> float:
        """Return the sub-aperture's side over r0 at the sensor's wavelength, 0 if that makes no speckles."""
        if self.r0_m is None:
            return 0.0
        if self.subaperture_m is None or self.wavelength_nm is None:
            raise InputError("with it, expected subaperture_m and wavelength_nm as well", name="r0_m")
        ratio = float(self.subaperture_m / (self.r0_m * (self.wavelength_nm / SEEING_WAVELENGTH_NM) ** 1.2))
        if ratio <= SPECKLED_ABOVE:
            return 0.0
        if ratio > LARGEST_D_OVER_R0:
            expected = f"expected sub-apertures of at most {LARGEST_D_OVER_R0:g} r0, got {ratio:.3g}"
            raise InputError(expected, name="r0_m", value=self.r0_m)
        if profile != "diffraction":
            expected = f"expected 'diffraction', as spots are speckled (d / r0 = {ratio:.2g})"
            raise InputError(expected, name="profile", value=profile)
        return ratio


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
            n, d_over_r0=self.d_over_r0, shape=self.shape, size=self.size, positions=positions, rng=phase_rng
        )
        return images / flux, positions
