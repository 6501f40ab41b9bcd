"""Arms: what their texts mean, and whose turn it is."""

from __future__ import annotations

import pytest

import faintspot as fs
from faintspot.realtime.interleaving import Interleaving


def test_texts() -> None:
    found = Interleaving.parse("none, tv,ml,noise_std=2+keep_brightest=20,set", 50)
    assert [arm.changes for arm in found.arms] == [
        {"denoise": False},
        {"denoise": True},
        {"estimator": "ml"},
        {"noise_std": 2, "keep_brightest": 20},
        {},
    ]
    assert found.labels == ["none", "tv", "ml", "noise_std=2+keep_brightest=20", "set"]


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
