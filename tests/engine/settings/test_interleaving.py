"""Methods: what their texts mean, and whose turn it is."""

from typing import Any

import pytest
from tests.refusals import refused

import faintspot as fs
from faintspot.engine.settings.interleaving import Interleaving, methods_after, short_names


@pytest.mark.parametrize(
    ("text", "changes", "denoises", "control"),
    [
        ("none", {}, False, None),
        ("tv", {"estimator": "tv"}, True, None),
        ("noise_std=2+keep_brightest=20", {"noise_std": 2, "keep_brightest": 20}, True, None),
        ("set", {}, True, None),
        ("tv:0.6", {"estimator": "tv", "noise_std": 0.6}, True, None),
        ("smoothed:0.9", {"estimator": "smoothed", "smoothing_px": 0.9}, True, None),
        ("tv:2+kalman", {"estimator": "tv", "noise_std": 2}, True, "kalman"),
        ("set+kalman", {}, True, "kalman"),
        ("none+search_range_px=3+integrator", {"search_range_px": 3}, False, "integrator"),
    ],
)
def test_texts_are_read_as_methods(
    text: str, changes: dict[str, Any], denoises: bool, control: str | None
) -> None:
    found = Interleaving.parse(f"none, {text},set", 50)
    method = found.methods[1]
    assert found.labels == ["none", text, "set"]
    assert (method.changes, method.denoises, method.control) == (changes, denoises, control)


def test_short_names_leave_out_values_unless_two_methods_would_share_one() -> None:
    window = "window+window_fwhm_px=5.3+centroid_gain=0.3"
    assert short_names(["none", "tv:0.6", window, "map+prior_std_px=1+kalman", "noise_std=2", window]) == [
        *("none", "tv:0.6", "window", "map+kalman", "noise_std=2", "window")
    ]
    assert short_names(["tv+noise_std=2", "tv+noise_std=3"]) == ["tv+noise_std=2", "tv+noise_std=3"]


def test_what_methods_make_of_the_settings() -> None:
    settings = fs.Settings("tv", noise_std=2.0, keep_brightest=9, search_range_px=3.0)
    methods = Interleaving.parse("none,tv,ml,noise_std=3,set,tv:0.6").methods
    assert [method.of(settings) for method in methods] == [
        fs.Settings("brightest", keep_brightest=9, search_range_px=3.0),
        settings,
        fs.Settings("ml", search_range_px=3.0),
        fs.Settings("tv", noise_std=3.0, keep_brightest=9, search_range_px=3.0),
        settings,
        fs.Settings("tv", noise_std=0.6, keep_brightest=9, search_range_px=3.0),
    ]


def test_none_needs_an_estimator_that_denoises() -> None:
    (method,) = Interleaving.parse("none").methods
    with refused("interleave: 'none'", "'ml'", "does not denoise"):
        method.of(fs.Settings("ml"))


def test_methods_take_turns() -> None:
    found = Interleaving.parse("none,tv,ml", 2)
    assert [found.method_of(count) for count in range(8)] == [0, 0, 1, 1, 2, 2, 0, 0]


def test_methods_of_later_interleavings_have_numbers_of_their_own() -> None:
    changes: list[dict[str, Any]] = [
        {"changes": {"noise_std": 2.0}},
        {"changes": {"methods": ["ml", "set"], "first_method": 2, "every": 5}},
        {"changes": {"loop": "open"}},
        {"changes": {"methods": ["set"], "first_method": 4, "every": 5}},
    ]
    assert methods_after(["none", "tv"], changes[:1]) == (["none", "tv"], 0)
    assert methods_after(["none", "tv"], changes) == (["none", "tv", "ml", "set", "set"], 4)
    # Of a recording, whose methods are all of them already.
    assert methods_after(["a", "b", "c", "d", "e"], changes[:2]) == (["a", "b", "ml", "set", "e"], 2)
    garbage: list[dict[str, Any]] = [{}, {"changes": {"methods": "x", "first_method": 0}}]
    garbage += [{"changes": {"methods": ["x"], "first_method": number}} for number in (-1, 9, "0", None)]
    assert methods_after(["none", "tv"], garbage) == (["none", "tv"], 0)
