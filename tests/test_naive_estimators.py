"""The oracle itself: what theory says it must do, so that the kernels are compared with something right."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from tests import naive
from tests import naive_estimators as oracle
from tests.naive_estimators import Estimate, Task
from tests.naive_spots import spots_of

from faintspot.slopes.spots.psf import PSF

SHAPE = (11, 12)
N = 300


@cache
def known_spot(profile: str) -> Task:
    psf = PSF.analytic(profile, radius_px=10)
    return Task(spots_of(psf)[0], (psf.fwhm_px[0, 0], psf.fwhm_px[0, 1]))


def spot_task(profile: str = "gaussian", **changes: object) -> Task:
    return replace(known_spot(profile), **changes)  # type: ignore[arg-type]


def drawn(task: Task, flux: float, n: int = N) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Spots at random places with photon and read noise; their positions."""
    assert task.spot is not None
    rng = np.random.default_rng(5)
    places = rng.uniform(-1, 1, (n, 2))
    images = np.array([flux * task.spot.images(x, y, SHAPE)[0] for x, y in places])
    noisy = task.excess * rng.poisson(np.maximum(images, 0) / task.excess)
    return noisy + math.sqrt(task.variance) * rng.standard_normal(images.shape), places


class TestSpot:
    @pytest.mark.parametrize("profile", ["gaussian", "diffraction"])
    def test_is_the_psf(self, profile: str) -> None:
        """Rounding of two ways to evaluate one spline."""
        psf = PSF.analytic(profile, size=1.2, elongation=1.5, angle_deg=30.0, radius_px=10)
        value = spots_of(psf)[0].images(0.31, -1.27, SHAPE)[0]
        np.testing.assert_allclose(value, psf.images([[0.31, -1.27]], SHAPE)[0], atol=1e-12)


class TestStart:
    def test_finds_the_pixel_and_the_flux(self) -> None:
        task = spot_task()
        assert task.spot is not None
        found = oracle.start(500 * task.spot.images(1.5, -2.0, SHAPE)[0], task)
        assert (found.x, found.y) == (1.5, -2.0)
        # On a pixel a spot is brighter than elsewhere within it.
        assert found.flux == pytest.approx(500, rel=0.05)

    def test_range_and_reference(self) -> None:
        task = spot_task(search_range=(1.0, 2.0), reference=(-1.5, 1.0))
        assert task.spot is not None
        found = oracle.start(500 * task.spot.images(3.5, -4.0, SHAPE)[0], task)
        assert (found.x, found.y) == (-0.5, -1.0)


class TestLikelihood:
    @pytest.mark.parametrize(
        ("profile", "noise", "flux"), [("gaussian", 0.1, 200), ("diffraction", 2.0, 600)]
    )
    def test_reaches_the_bound(self, profile: str, noise: float, flux: float) -> None:
        """600 errors give their rms to 3 %; the bound is asymptotic: 4 of these standard errors."""
        task = spot_task(profile, variance=noise**2)
        images, places = drawn(task, flux)
        found = [oracle.fisher(image, task) for image in images]
        errors = np.array([[f.x, f.y] for f in found]) - places
        bound = np.array([oracle.cramer_rao_bound(x, y, flux, SHAPE, task) for x, y in places])
        assert np.std(errors / bound) == pytest.approx(1.0, abs=0.12)
        stated = np.array([[f.error_x, f.error_y] for f in found])
        assert np.std(errors / stated) == pytest.approx(1.0, abs=0.12)

    def test_matched_is_least_squares(self) -> None:
        from scipy.optimize import least_squares

        task = spot_task(variance=4.0, steps=40)
        image = drawn(task, 600, 1)[0][0]
        spot = task.spot
        assert spot is not None
        best = least_squares(
            lambda p: (p[2] * spot.images(p[0], p[1], SHAPE)[0] - image).ravel(), [0, 0, 600], xtol=1e-12
        )
        found = oracle.fisher(image, task, "matched")
        np.testing.assert_allclose([found.x, found.y, found.flux], best.x, rtol=1e-5, atol=1e-6)

    def test_prior_rules_where_there_is_no_flux(self) -> None:
        task = spot_task(variance=25.0, prior=(0.3, -0.2), prior_std=0.1, steps=20)
        found = oracle.fisher(drawn(task, 5, 1)[0][0], task, "map")
        assert math.hypot(found.x - 0.3, found.y + 0.2) < 0.05
        assert found.error_x == pytest.approx(0.1, rel=0.1)

    def test_whole_electrons(self) -> None:
        task = spot_task(variance=0.01, whole_electrons=True)
        image = np.rint(drawn(task, 100, 1)[0][0])
        noise = np.random.default_rng(1).uniform(-0.4, 0.4, SHAPE)
        assert oracle.fisher(image + noise, task) == oracle.fisher(image, task)


class TestPosterior:
    def test_equals_map_where_there_is_flux(self) -> None:
        """The posterior is a Gaussian then; the two likelihoods differ in second order."""
        task = spot_task(variance=1.0, prior_std=0.5, steps=10, weight_floor=0.0)
        image = drawn(task, 3000, 1)[0][0]
        found = oracle.fisher(image, task, "map")
        grid = np.linspace(-0.15, 0.15, 41)
        posterior = oracle.grid_posterior(image, task, 3000, found.x + grid, found.y + grid)
        assert posterior.x == pytest.approx(found.x, abs=0.2 * found.error_x)
        assert posterior.error_x == pytest.approx(found.error_x, rel=0.1)

    def test_is_the_prior_without_flux(self) -> None:
        task = spot_task(variance=100.0, prior=(0.2, 0.0), prior_std=0.4)
        grid = np.linspace(-3, 3, 31)
        found = oracle.grid_posterior(np.zeros(SHAPE), task, 0.01, grid, grid)
        assert (found.x, found.error_y) == pytest.approx((0.2, 0.4), abs=1e-3)


class TestGravity:
    def test_weighted_has_the_right_gain(self) -> None:
        """Exact for a Gaussian on fine pixels; here 2.1 px wide spots of whole pixels, ten iterations."""
        task = spot_task(spot_fwhm=2.1, weight_fwhm=3.0, steps=10)
        assert task.spot is not None
        found = oracle.weighted(task.spot.images(0.4, -0.3, SHAPE)[0], task)
        assert (found.x, found.y) == pytest.approx((0.4, -0.3), abs=5e-3)

    def test_error_is_the_scatter(self) -> None:
        """With a fixed set of pixels the formula is exact to first order; 2,000 draws give 2 %."""
        rng = np.random.default_rng(2)
        task = spot_task(variance=1.0)
        assert task.spot is not None
        mean = 2000 * task.spot.images(0.0, 0.0, SHAPE)[0]
        used = mean > 20
        places, errors = [], []
        for _ in range(2000):
            g = rng.poisson(np.maximum(mean, 0)) + rng.standard_normal(SHAPE)
            places.append(naive.centre_of_gravity(np.where(used, g, 0)))
            errors.append(oracle.gravity_error(np.where(used, g, 0), g, 1.0))
        np.testing.assert_allclose(np.std(places, axis=0), np.mean(errors, axis=0), rtol=0.07)


def test_trained_score_in_one_dimension() -> None:
    """psi = the pixel's offset makes one pass a centre of gravity over the flux expected."""
    nodes = np.arange(-40, 41) / 4
    tables = np.zeros((1, 2, 3, 2, 81, 81), np.float32)
    tables[..., 0, :, :], tables[..., 1, :, :] = nodes[None, :], nodes[:, None]
    score = SimpleNamespace(
        tables=tables,
        flux_e=np.array([10.0, 1000.0]),
        standard_error_px=np.full((1, 2, 2), 0.1),
        steps_per_px=4,
    )
    task = spot_task()
    assert task.spot is not None
    found = oracle.trained(500 * task.spot.images(0.4, -0.3, SHAPE)[0], score, 0, 500.0, Estimate(0, 0), task)
    assert (found.x, found.y) == pytest.approx((0.4, -0.3), abs=1e-4)
    assert found.error_x == pytest.approx(0.1)
