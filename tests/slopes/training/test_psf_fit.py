"""Fits to sums of spots without noise."""

import numpy as np

from faintspot.slopes.training.psf_fit import Form, fit_psf
from faintspot.slopes.training.registration import Sums, offsets


def test_a_spot_at_an_angle_is_the_product_of_its_own_profiles() -> None:
    """Within 2 % of the peak, where it ends at 6 px."""
    u = offsets(121)
    y, x = np.meshgrid(u, u, indexing="ij")
    angle = np.radians(30.0)
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    spot = np.exp(-0.5 * ((along / 2.0) ** 2 + across**2))
    ones = np.ones_like(spot)
    sums = Sums(np.stack([ones, ones, spot]), float(ones.sum()), float(spot.sum()))
    fit = fit_psf(sums, Form(rotated=True, square=False, bend=0.3, deviation=0.0), 6.0)
    np.testing.assert_allclose(fit.plane / fit.plane.max(), spot, atol=0.02)
