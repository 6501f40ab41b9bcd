"""Simulated spots for the tests of learning a PSF, and the error of maximum likelihood with one."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.training.psf_learning import image_stack
from faintspot.slopes.training.registration import PSFTables, register, start

SHAPES: dict[str, dict[str, Any]] = {
    "diffraction": {"profile": "diffraction"},
    "gaussian": {"profile": "gaussian"},
    "elongated": {"profile": "gaussian", "elongation": 2.0, "angle_deg": 30.0},
}
WIDEST_PX = 10


def true_psf(shape: str) -> PSF:
    """Return the PSF that the images of `simulated` have."""
    options = dict(SHAPES[shape])
    return PSF.analytic(options.pop("profile"), radius_px=WIDEST_PX, **options)


def simulated(
    rng: np.random.Generator, psf: PSF, n: int, flux_e: float, read_noise_e: float, range_px: float = 2.0
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return images and true positions."""
    positions = rng.uniform(-range_px, range_px, (n, 2))
    images = rng.poisson(np.maximum(psf.images(positions, (16, 16), flux_e), 0)).astype(np.float32)
    images += read_noise_e * rng.standard_normal(images.shape).astype(np.float32)
    return images, positions


def slope_error(psf: PSF, images: Any, positions: Any, read_noise_e: float, index: Any = None) -> float:
    """Return the error R of maximum likelihood with a PSF."""
    stack = image_stack(images, Calibration(read_noise_e=read_noise_e))
    kinds = np.zeros(len(images), np.int64) if index is None else index
    tables = PSFTables.of(psf, WIDEST_PX)
    found = register(stack, tables, kinds, start(stack, tables, kinds, psf.fwhm_px, 8.0), 8.0, 4)
    return float(np.abs(found.positions - positions).mean())
