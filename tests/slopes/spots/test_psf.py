"""PSFs: analytic ones are those of the simulation, and what is saved comes back."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.refusals import assert_each_refused, refused

from faintspot.slopes.spots.psf import PSF
from faintspot.slopes.spots.shapes import spots

SHAPES: list[dict[str, Any]] = [
    {"profile": "diffraction"},
    {"profile": "diffraction", "size": 1.5},
    {"profile": "gaussian"},
    {"profile": "gaussian", "size": 1.3, "elongation": 2.0, "angle_deg": 30.0},
]


def analytic(options: dict[str, Any], **more: Any) -> PSF:
    """Return the PSF of `spots` with these options."""
    return PSF.analytic(options["profile"], **{k: v for k, v in options.items() if k != "profile"}, **more)


@pytest.mark.parametrize("options", SHAPES)
def test_images_are_those_of_the_simulation(options: dict[str, Any]) -> None:
    positions = np.random.default_rng(1).uniform(-3, 3, (40, 2))
    psf = analytic(options, radius_px=20)
    images, expected = (
        psf.images(positions, (16, 14), 1000.0),
        1000 * spots(positions, shape=(16, 14), **options),
    )
    # The PSF has all its flux within 20 px; sinc^2 wings leave 2 to 4 % of theirs outside.
    scale = images.sum() / expected.sum()
    assert scale == pytest.approx(1.0, abs=0.05)
    # Cubic splines on eight nodes per pixel.
    assert np.abs(images / scale - expected).max() < 2e-3 * expected.max()


def test_samples_are_normalised_and_not_mine() -> None:
    mine = np.ones((7, 9))
    psf = PSF(mine, 2)
    assert psf.samples.shape == (1, 7, 9)
    assert psf.samples.sum() == pytest.approx(4.0)
    assert mine.sum() == 63
    with pytest.raises(ValueError, match="read-only"):
        psf.samples[0, 0, 0] = 2.0


def test_widths_are_those_of_the_profile_and_its_pixel() -> None:
    psf = PSF.analytic("gaussian", size=[1.0, 2.0], elongation=[1.0, 1.5], index=[1, 0, 1])
    # FWHM 2 px x size along y; 1/12 px^2 of variance from the pixel.
    pixel = 2.3548**2 / 12
    assert psf.fwhm_px[:, 1] == pytest.approx(np.sqrt([4 + pixel, 16 + pixel]), rel=0.02)
    assert psf.fwhm_px[1, 0] == pytest.approx(np.sqrt(36 + pixel), rel=0.02)
    assert psf.index_of(3).tolist() == [1, 0, 1]
    assert PSF.analytic().index_of(4).tolist() == [0] * 4


def test_blurring_adds_its_variance() -> None:
    psf = PSF.analytic("gaussian", radius_px=12)
    wider = psf.blurred(1.0)
    before, after = (p.fwhm_px[0, 0] / 2.3548 for p in (psf, wider))
    assert after**2 - before**2 == pytest.approx(1.0, rel=0.03)
    assert np.allclose(psf.blurred(0.0).samples, psf.samples)


@pytest.mark.parametrize(("options", "rank"), [(SHAPES[0], 1), (SHAPES[2], 1), (SHAPES[3], 5)])
def test_separable_terms_reproduce_the_psf(options: dict[str, Any], rank: int) -> None:
    psf = analytic(options, radius_px=10)
    along_x, along_y = psf.separable_terms
    assert along_x.shape[1] == along_y.shape[1] <= rank
    assert rank == 1 or along_x.shape[1] > 1
    product = np.einsum("krc,krd->kcd", along_y, along_x)
    assert np.abs(product - psf.samples).max() < 2.1e-3 * psf.samples.max()


def test_saved_and_loaded(tmp_path: Path) -> None:
    psf = PSF.analytic("gaussian", size=[1.0, 2.0], index=[1, 0, 1], radius_px=6)
    psf.save(tmp_path / "psf.npz")
    back = PSF.load(tmp_path / "psf.npz")
    assert np.allclose(back.samples, psf.samples, rtol=1e-12)
    assert back.oversampling == psf.oversampling
    assert back.index.tolist() == [1, 0, 1]
    PSF.analytic(radius_px=6).save(tmp_path / "one.npz")
    assert PSF.load(tmp_path / "one.npz").index is None


def test_files_that_cannot_be_written(tmp_path: Path) -> None:
    with refused("psf.npz"):
        PSF.analytic(radius_px=4).save(tmp_path / "no" / "psf.npz")


def test_what_is_refused() -> None:
    ones = np.ones((7, 7))
    assert_each_refused(
        partial(PSF, samples=ones, oversampling=2),
        samples=[np.ones((4, 7)), np.ones((3, 7)), np.ones(7), -ones, ones * np.nan, 1e300 * ones],
        oversampling=[0],
    )
    with refused("psf.samples", "flux in a pixel"):
        PSF(np.eye(7) - np.eye(7)[::-1] + 1e-12, 2)
    assert_each_refused(partial(PSF, np.ones((2, 7, 7)), 2), index=[None, [0, 2], [[0, 1]]])
    psf = PSF.analytic(radius_px=4)
    assert_each_refused(psf.images, positions=[[[np.nan, 0]], [1.0, 2.0, 3.0]])
    assert_each_refused(partial(psf.images, [[0, 0]]), which=[1])
    assert_each_refused(psf.blurred, std_px=[-1.0])
    with refused("psf.index", "4 numbers, one per sub-aperture"):
        PSF(ones, 2, [0, 0, 0]).index_of(4)
