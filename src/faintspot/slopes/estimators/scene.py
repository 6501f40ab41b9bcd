"""Knowledge of spots and camera from which an estimator's options are chosen."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

PIXEL_BLUR_PX2 = 0.46
"""Increase of a Gaussian spot's squared FWHM due to integration over a pixel [px^2]."""


@dataclass(frozen=True)
class Scene:
    """Flux, camera and spots of a star.

    Parameters
    ----------
    flux_e : float
        Flux of a spot in a frame [photo-electrons].
    read_noise_e : float
        Read noise [photo-electrons].
    window : (int, int)
        Size of a sub-aperture window, ny and nx [px].
    spot_fwhm_px : float
        Full width at half maximum of the optical spot, without the blur of the pixels [px].
    position_range_px : float
        Largest distance of the spots from the reference position on each axis [px].
    elongation : float
        Ratio of the widths along the long and the short axis.
    excess_noise : float
        Factor on the variance of the photon noise: 2 for an EMCCD at high gain.
    background_e : float
        Background per pixel [photo-electrons], whose mean is subtracted and whose noise remains.
    d_over_r0 : float
        Side of a sub-aperture in Fried parameters at the sensor's wavelength, if the spots are speckled;
        otherwise 0.
    diffraction_px : float, optional
        lambda / d on the detector [px]. Default: that of a spot of this width.
    profile : str
        Spot profile, "diffraction" or "gaussian".
    learnt : bool
        Whether the PSF was learnt from frames.

    Examples
    --------
    >>> from faintspot.slopes.estimators import Scene
    >>> scene = Scene(flux_e=100.0, read_noise_e=1.0, window=(8, 8), spot_fwhm_px=1.8, position_range_px=1.0)
    >>> round(scene.seen_fwhm_px, 2)
    1.92
    """

    flux_e: float
    read_noise_e: float
    window: tuple[int, int]
    spot_fwhm_px: float
    position_range_px: float
    elongation: float = 1.0
    excess_noise: float = 1.0
    background_e: float = 0.0
    d_over_r0: float = 0.0
    diffraction_px: float | None = None
    profile: str = "diffraction"
    learnt: bool = False

    @property
    def pixels(self) -> int:
        """Number of pixels of a window."""
        return self.window[0] * self.window[1]

    @property
    def dark_noise_e(self) -> float:
        """Noise of a dark pixel, photo-electrons."""
        return math.sqrt(self.read_noise_e**2 + self.excess_noise * self.background_e)

    @property
    def seen_fwhm_px(self) -> float:
        """Width of the spots including the blur of the pixels."""
        return math.sqrt(self.spot_fwhm_px**2 + PIXEL_BLUR_PX2)

    @property
    def lambda_over_d_px(self) -> float:
        """Lambda / d, px."""
        return self.spot_fwhm_px / 0.886 if self.diffraction_px is None else self.diffraction_px

    @property
    def rule_arguments(self) -> dict[str, Any]:
        """Arguments of the automatic rules, see `faintspot.slopes.estimators.algorithms.automatic`."""
        return {
            "flux_e": self.flux_e,
            "read_noise_e": self.read_noise_e,
            "pixels": self.pixels,
            "spot_fwhm_px": self.spot_fwhm_px,
            "elongation": self.elongation,
            "excess_noise": self.excess_noise,
            "background_e": self.background_e,
            "position_range_px": self.position_range_px,
            "profile": self.profile,
        }
