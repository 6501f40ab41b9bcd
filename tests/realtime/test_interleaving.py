"""Arms: what their texts mean, and whose turn it is."""

from __future__ import annotations

import pytest
from tests.estimate.image_cases import refused

import faintspot as fs
from faintspot.realtime.interleaving import Interleaving


def test_texts() -> None:
    found = Interleaving.parse("none, tv,ml,noise_std=2+keep_brightest=20,set", 50)
    assert [(arm.changes, arm.denoises) for arm in found.arms] == [
        ({}, False),
        ({"estimator": "tv"}, True),
        ({"estimator": "ml"}, True),
        ({"noise_std": 2, "keep_brightest": 20}, True),
        ({}, True),
    ]
    assert found.labels == ["none", "tv", "ml", "noise_std=2+keep_brightest=20", "set"]


def test_what_arms_make_of_the_settings() -> None:
    settings = fs.Settings("tv", noise_std=2.0, keep_brightest=9, search_range_px=3.0)
    arms = Interleaving.parse("none,tv,ml,noise_std=3,set").arms
    assert [arm.of(settings) for arm in arms] == [
        fs.Settings("brightest", keep_brightest=9, search_range_px=3.0),
        settings,
        fs.Settings("ml", search_range_px=3.0),
        fs.Settings("tv", noise_std=3.0, keep_brightest=9, search_range_px=3.0),
        settings,
    ]


def test_none_needs_an_estimator_that_denoises() -> None:
    (arm,) = Interleaving.parse("none").arms
    with refused("interleave: 'none'", "'ml'", "does not denoise"):
        arm.of(fs.Settings("ml"))


def test_turns() -> None:
    found = Interleaving.parse("none,tv,ml", 2)
    assert [found.arm_of(count) for count in range(8)] == [0, 0, 1, 1, 2, 2, 0, 0]


@pytest.mark.parametrize("text", ["", "tvv", "none,,tv", "strength=2", "noise_std="])
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(fs.InputError):
        Interleaving.parse(text)


def test_every() -> None:
    with pytest.raises(fs.InputError, match="every = 0"):
        Interleaving.parse("none,tv", 0)
