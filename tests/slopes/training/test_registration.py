"""Registration: unbiased, with honest errors, and deaf to bad pixels."""

from typing import Any

import numpy as np
import pytest
from tests.slopes.training.psf_cases import SHAPES, simulated, true_psf

from faintspot.slopes.camera.calibration import Calibration
from faintspot.slopes.training.psf_learning import image_stack
from faintspot.slopes.training.registration import PSFTables, register, start


def registered(psf: Any, images: Any, read_noise_e: Any, bad: Any = None) -> Any:
    images = images.copy()
    if bad is not None:
        images[bad] = np.nan
    stack = image_stack(images, Calibration(read_noise_e=read_noise_e))
    index = np.zeros(len(images), np.int64)
    tables = PSFTables.of(psf, 10)
    return register(stack, tables, index, start(stack, tables, index, psf.fwhm_px, 8.0), 8.0, 5)


@pytest.mark.parametrize("shape", SHAPES)
def test_noiseless_spots_are_found_exactly(shape: Any) -> None:
    psf = true_psf(shape)
    positions = np.random.default_rng(1).uniform(-3, 3, (50, 2))
    images = psf.images(positions, (16, 16), 1000.0)
    found = registered(psf, images.astype(np.float32), 1.0)
    # The table's slopes are differences over a quarter of a pixel: the steps end a little short.
    assert np.abs(found.positions - positions).max() < 2e-3
    assert np.abs(found.flux_e / 1000 - 1).max() < 2e-3


@pytest.mark.parametrize(("flux", "read_noise"), [(100.0, 0.1), (300.0, 3.0)])
def test_the_covariance_is_the_actual_one(flux: Any, read_noise: Any) -> None:
    psf = true_psf("elongated")
    images, positions = simulated(np.random.default_rng(2), psf, 3000, flux, read_noise)
    found = registered(psf, images, read_noise)
    actual, told = np.cov((found.positions - positions).T), found.covariance.mean(axis=0)
    # 3000 spots tell a variance to 2.6 %; the asymptotic one is some per cent too small.
    assert np.abs(actual / told - 1).max() < 0.2


def test_bad_pixels_count_for_nothing() -> None:
    psf = true_psf("gaussian")
    images, positions = simulated(np.random.default_rng(3), psf, 200, 1000.0, 1.0, 1.0)
    bad = np.zeros(images.shape, bool)
    bad[:, 5, 9] = bad[:, 12, 3] = True
    found = registered(psf, images, 1.0, bad)
    error = np.abs(found.positions - positions)
    assert error.mean() < 1.3 * np.abs(registered(psf, images, 1.0).positions - positions).mean()


def test_spots_outside_their_window_do_no_harm() -> None:
    psf = true_psf("gaussian")
    found = registered(psf, np.zeros((3, 16, 16), np.float32), 0.1)
    assert np.all(np.isfinite(found.positions))
    assert np.all(np.abs(found.positions) <= 8)
