from functools import partial
from typing import Any

import pytest
from tests.refusals import assert_each_refused, refused

from faintspot.experiments import Question
from faintspot.slopes.sensor.layout import Layout
from faintspot.slopes.spots.psf import PSF

KNOWN: dict[str, Any] = {"read_noise_e": 3.0, "pixels": 16, "fwhm_px": 2.0, "flux_e": 100.0}
OPTICS: dict[str, Any] = {"subaperture_m": 0.5, "wavelength_nm": 600.0, "pixel_scale_arcsec": 0.125}
STAR: dict[str, Any] = {"subaperture_m": 0.5, "frame_rate_hz": 500.0, "magnitude": 10.0}


def without(name: str) -> dict[str, Any]:
    return {key: value for key, value in KNOWN.items() if key != name}


def test_width_follows_from_the_optics() -> None:
    """r0 tells whether spots are speckled; the width of a PSF is without the pixel."""
    question = Question(**without("fwhm_px"), **OPTICS)
    # lambda / d = 1.2e-6 rad = 0.2475 arcsec = 1.98 px
    assert question.spots.fwhm_px == pytest.approx(0.886 * 1.98, rel=1e-3)
    assert question.spots.size == pytest.approx(0.99, rel=1e-3)
    calm, rough = (Question(**without("fwhm_px"), **OPTICS, r0_m=r0_m) for r0_m in (1.0, 0.15))
    assert calm.spots.d_over_r0 == 0.0
    assert rough.spots.d_over_r0 == pytest.approx(0.5 / (0.15 * 1.2**1.2))
    of_psf = Question(**without("fwhm_px"), psf=PSF.analytic("gaussian"))
    assert of_psf.spots.fwhm_px == pytest.approx(2.0, rel=0.02)  # linear interpolation of the half maximum
    for fwhm_px, expected in ((1.5, 1.0), (4.0, 2.0)):
        assert Question(**without("fwhm_px"), fwhm_px=fwhm_px).spots.search_range_px == expected
    of_layout = Question(**without("pixels"), layout=Layout.grid((2, 2), pixels=(12, 10)))
    assert of_layout.spots.shape == (12, 10)


def test_magnitude_gives_electrons() -> None:
    question = Question(**without("flux_e"), **STAR)
    assert question.photometry is not None
    assert question.star_flux_e == pytest.approx(float(question.photometry.electrons(10.0)))
    by_hand = Question(**without("flux_e"), **STAR, zero_point=1e10, throughput=0.5, quantum_efficiency=0.8)
    assert by_hand.star_flux_e == pytest.approx(1e10 * 1e-4 * 0.5**2 / 500.0 * 0.5 * 0.8)


def test_what_estimators_know_of_an_emccd() -> None:
    camera = {"read_noise_e": 50.0, "em_gain": 100.0, "background_e": 0.2}
    scene = Question(**{**KNOWN, **camera, "search_range_px": 3.0}).scene(80.0)
    assert (scene.flux_e, scene.read_noise_e, scene.background_e) == (80.0, 0.5, 0.2)
    assert scene.excess_noise == pytest.approx(2.0, abs=0.02)
    assert (scene.window, scene.spot_fwhm_px, scene.position_range_px) == ((16, 16), 2.0, 3.0)
    assert scene.diffraction_px == pytest.approx(2.0 / 0.886, rel=2e-3)  # lambda / d


def test_budget_in_any_unit() -> None:
    budgets: Any = {"0.1": 0.1, 0.1: 0.1, "0.1 px": 0.1, "0.05arcsec": 0.4, "50mas": 0.4}
    for budget, expected in budgets.items():
        question = Question(**KNOWN, pixel_scale_arcsec=0.125, budget=budget)
        assert question.budget_px == pytest.approx(expected)


def test_what_cannot_be_is_named_in_one_line() -> None:
    assert_each_refused(
        partial(Question, **KNOWN),
        read_noise_e=[None],
        pixels=[None],
        fwhm_px=[None, 50.0],
        flux_e=[None, 1e-3],
        search_range_px=[9.0],
        budget=["0.1 furlong", "-0.1"],
    )
    for naming, changes in (
        ("expected one of them", {"magnitude": 10.0}),
        ("subaperture_m", {"flux_e": None, "magnitude": 10.0}),
        ("magnitude", {"flux_e": None, **STAR, "magnitude": 40.0}),
        ("subaperture_m", {"r0_m": 0.1}),
        ("r0_m", {**OPTICS, "r0_m": 0.01}),
        ("profile", {**OPTICS, "r0_m": 0.1, "profile": "gaussian"}),
        ("pixel_scale_arcsec", {"budget": "50mas"}),
        ("pixels", {"layout": Layout.grid((2, 2), pixels=12)}),
    ):
        with refused(naming):
            Question(**{**KNOWN, **changes})
