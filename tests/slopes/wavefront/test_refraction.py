from dataclasses import replace

import numpy as np
import pytest

from faintspot import InputError, Layout
from faintspot.base.flags import SubapertureFlag
from faintspot.slopes.pipeline.slopes import Slopes
from faintspot.slopes.wavefront.fit import Wavefront, fit_wavefront
from faintspot.slopes.wavefront.refraction import refraction, refraction_error

SCALE_ARCSEC = 40.0
LAYOUT = Layout.grid((9, 9), pixels=8, outer_radius=4.5, pixel_scale_arcsec=SCALE_ARCSEC, diameter_m=6e-3)


def slopes_of(x: np.ndarray, y: np.ndarray, error: float = np.inf) -> Slopes:
    x = np.atleast_2d(x).astype(np.float32)
    zeros, whole = np.zeros_like(x), np.zeros(x.shape, np.int32)
    flags = np.full(x.shape, int(SubapertureFlag(0)), np.uint8)
    errors = np.full_like(x, error)
    return Slopes(x, np.atleast_2d(y).astype(np.float32), zeros, flags, whole, whole, errors, errors, zeros)


def eye(sphere: float, cylinder: float, axis_deg: float, error: float = np.inf) -> Wavefront:
    """Return the wavefront of an eye that this lens corrects, from rays.

    The power of a thin lens along a meridian at an angle from the axis is sphere + cylinder sin^2: the lens
    turns a ray at a point p by minus its power matrix times p. The eye's rays are turned the other way.
    """
    axis = np.deg2rad(axis_deg)
    across = np.array([-np.sin(axis), np.cos(axis)])
    power = sphere * np.eye(2) + cylinder * np.outer(across, across)
    metres_per_px = 6e-3 / 72
    points = (LAYOUT.centres - 35.5) * metres_per_px
    angles = points @ power / np.deg2rad(1 / 3600)  # the lens would add minus these, arcsec
    x, y = (angles / SCALE_ARCSEC).T
    return fit_wavefront(slopes_of(x, y, error), LAYOUT, modes=9)


@pytest.mark.parametrize(
    ("sphere", "cylinder", "axis"),
    [(-3.0, 0.0, None), (2.0, -1.0, 0.0), (-1.0, -0.5, 30.0), (0.25, -2.0, 135.0)],
)
def test_the_lens_that_corrects_is_found(sphere: float, cylinder: float, axis: float | None) -> None:
    wavefront = eye(sphere, cylinder, axis or 0.0)
    lens = refraction(wavefront, wavefront.mean)
    assert lens.sphere_d == pytest.approx(sphere, abs=1e-4)
    assert lens.cylinder_d == pytest.approx(cylinder, abs=1e-4)
    assert lens.spherical_equivalent_d == pytest.approx(sphere + cylinder / 2, abs=1e-4)
    if axis is not None:
        assert (lens.axis_deg - axis + 90) % 180 - 90 == pytest.approx(0, abs=0.01)


def test_short_sight_has_negative_defocus_and_sphere() -> None:
    wavefront = eye(-3.0, 0.0, 0.0)
    assert wavefront.mean[2] < 0  # spots move inwards: the light converges
    # Thibos et al. 2004: |M| = 4 sqrt(3) c / r^2, um and mm.
    assert 4 * np.sqrt(3) * abs(wavefront.in_unit("um").mean[2]) / 3**2 == pytest.approx(3, rel=1e-4)


def test_errors_are_the_scatter_of_many_draws() -> None:
    wavefront = eye(-1.0, -0.75, 20.0, error=0.02)
    errors = refraction_error(wavefront).values
    rng = np.random.default_rng(1)
    draws = wavefront.mean + wavefront.mean_standard_error * rng.normal(size=(4000, len(wavefront.modes)))
    scatter = refraction(wavefront, draws).values
    for name, error in errors.items():  # 4000 draws: 1.1 % of the scatter
        assert np.std(scatter[name]) == pytest.approx(error, rel=0.05), name


def test_units_and_what_is_refused() -> None:
    wavefront = eye(-1.0, 0.0, 0.0)
    waves = wavefront.in_unit("waves", 500.0)
    np.testing.assert_allclose(waves.mean * 500, wavefront.mean)
    np.testing.assert_allclose(waves.in_unit("nm").coefficients, wavefront.coefficients)
    assert refraction(waves, waves.mean).sphere_d == pytest.approx(
        refraction(wavefront, wavefront.mean).sphere_d
    )
    for unit, wavelength in (("waves", None), ("nm", 500.0), ("waves", -1.0), ("mm", None)):
        with pytest.raises(InputError):
            wavefront.in_unit(unit, wavelength)
    with pytest.raises(InputError, match="at least 5"):
        refraction(replace(wavefront, modes=wavefront.modes[:4]), wavefront.mean[:4])
    pixels = replace(wavefront, unit="px × sub-aperture")
    with pytest.raises(InputError, match="pixel_scale_arcsec"):
        refraction(pixels, pixels.mean)
