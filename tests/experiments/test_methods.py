"""Methods: estimators made for a scene, by their own word."""

import pytest

from faintspot import PSF
from faintspot.experiments.methods import Knowledge, method_for_scene, tuned_options
from faintspot.slopes.estimators import Scene, estimators

SCENE = Scene(flux_e=123.456, read_noise_e=3.0, window=(12, 12), spot_fwhm_px=1.77, position_range_px=1.0)
WITHOUT_OPTIONS = ("centroid",)


@pytest.mark.parametrize("name", list(estimators()))
def test_every_estimator_is_made_for_a_scene(name: str) -> None:
    kind = estimators()[name]
    method = method_for_scene(kind, SCENE, psf=PSF.analytic())
    assert (method.name, method.label) == (name, kind.label)
    assert method.settings.search_range_px == 1.0
    assert (method.psf is None) == (Knowledge.of(method.estimator) < Knowledge.SPOT)
    options = tuned_options(method, SCENE)
    for option, values in options.items():
        changed = method.with_options({option: values[-1]})
        assert getattr(changed.settings, option) == values[-1]
        assert all(float(f"{value:.3g}") == value for value in values if isinstance(value, float))
    assert not any(isinstance(value, str) and value == "auto" for value in method.settings.chosen().values())


def test_knowledge_follows_from_the_needs() -> None:
    found = {name: Knowledge.of(kind) for name, kind in estimators().items()}
    assert [name for name, knowledge in found.items() if knowledge is Knowledge.SPOT] == [
        "matched",
        "ml",
        "map",
    ]
    assert [name for name, knowledge in found.items() if knowledge is Knowledge.WIDTH] == [
        "window",
        "weighted",
    ]


def test_speckled_spots_are_blurred_or_doubted() -> None:
    speckled = Scene(**{**vars(SCENE), "d_over_r0": 2.0})
    method = method_for_scene(estimators()["ml"], speckled)
    assert set(tuned_options(method, speckled)) == {"blur_px", "model_error"}
    assert tuned_options(method, SCENE) == {}
